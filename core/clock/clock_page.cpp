// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_page.hpp"

#include <fcntl.h>
#include <fmt/core.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <map>
#include <mutex>
#include <utility>

#include "core/base/time.hpp"
#include "core/base/try.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::clock {

namespace {

constexpr std::size_t kBootIdBytes = 36;

}  // namespace

std::string boot_id() {
  const UniqueFd file(::open("/proc/sys/kernel/random/boot_id", O_RDONLY | O_CLOEXEC));
  std::string id(kBootIdBytes, '\0');
  if (!file || ::read(file.get(), id.data(), id.size()) != static_cast<ssize_t>(id.size())) {
    return {};
  }
  return id;
}

std::optional<Duration> clock_error_at(const ClockPage& page, Time t) noexcept {
  // A time after the latest statement is usually found in a ClockErrorCache.
  ClockPageState state;
  page.state.load<ClockPageState::kEarlierBytes>(state);
  if (t >= state.wall) page.state.load<ClockPageState::kStampBytes>(state);
  if (t < state.wall) {
    if (t < state.earlier_from) return std::nullopt;
    return state.earlier_bound;
  }
  // Unsigned: the two may be further apart than 2^63 ns.
  const std::uint64_t age =
      static_cast<std::uint64_t>(to_ns(t)) - static_cast<std::uint64_t>(to_ns(state.wall));
  if (age > static_cast<std::uint64_t>(to_ns(kMaxUse))) return std::nullopt;
  if (state.clock.bound == kUnknownClockError) return kUnknownClockError;
  // At most 3.5e9 * 10^6, so it does not overflow; the division rounds up.
  const std::uint64_t growth =
      (age * static_cast<std::uint64_t>(state.clock.ageing_ppb) + 999'999'999) / 1'000'000'000;
  return sum(state.clock.bound, Duration(static_cast<std::int64_t>(growth)));
}

ClockStatus status_of(const ClockPage& page) noexcept {
  ClockPageState state;
  page.state.load<ClockPageState::kStampBytes>(state);
  return MonoClock::now() - state.mono > kMaxUse ? ClockStatus::unknown : state.clock.status;
}

Result<ClockPage*> map_page_untrusted(int fd, int protection) {
  struct stat file {};
  if (::fstat(fd, &file) || !S_ISREG(file.st_mode) || file.st_size != sizeof(ClockPage)) {
    return Error{Errc::protocol, "this is not a clock page: not a file of one page"};
  }
  void* memory = ::mmap(nullptr, sizeof(ClockPage), protection, MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) return os_error("map the clock page");
  auto* page = static_cast<ClockPage*>(memory);
  if (page->magic == ClockPage::kMagic && page->layout_version == ClockPage::kLayoutVersion) {
    return page;
  }
  ::munmap(memory, sizeof(ClockPage));
  return Error{Errc::protocol, fmt::format("this is not a clock page of layout version {}",
                                           ClockPage::kLayoutVersion)};
}

Result<const ClockPage*> map_clock_page_untrusted(int fd) {
  static std::mutex mutex;
  static std::map<std::pair<dev_t, ino_t>, const ClockPage*> pages;
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("get the status of the clock page");
  const std::lock_guard guard(mutex);
  const std::pair key(file.st_dev, file.st_ino);
  if (const auto known = pages.find(key); known != pages.end()) return known->second;
  const ClockPage* page = DSSM_TRY(map_page_untrusted(fd, PROT_READ));
  pages.emplace(key, page);
  return page;
}

namespace {

constexpr std::uint64_t kBillion = 1'000'000'000;
// A greater bound does not grow, so that the sum does not overflow.
constexpr std::int64_t kMaxGrowingNs = INT64_MAX - (std::int64_t{1} << 32);

}  // namespace

void ClockErrorCache::refresh(const ClockPage& page) noexcept {
  ClockPageState state;
  generation_ = page.state.load<ClockPageState::kStampBytes>(state);
  page_ = &page;
  wall_ns_ = to_ns(state.wall);
  const bool grows = to_ns(state.clock.bound) <= kMaxGrowingNs;
  bound_ns_ = grows ? to_ns(state.clock.bound) : INT64_MAX;
  // At most 10^6 * 2^32, and in find() 3.5e9 * 4.3e6, so neither overflows; rounds up.
  const auto ageing = static_cast<std::uint64_t>(grows ? state.clock.ageing_ppb : 0);
  growth_ = ((ageing << 32) + kBillion - 1) / kBillion;
}

}  // namespace dssm::clock
