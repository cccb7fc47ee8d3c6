// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_page.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <map>
#include <mutex>
#include <utility>

namespace dssm::clock {
namespace {

constexpr std::size_t kBootIdBytes = 36;

bool is_clock_page(const ClockPage& page) noexcept {
  return page.magic == ClockPage::kMagic && page.layout_version == ClockPage::kLayoutVersion;
}

// Works on a record for as long as it takes to see one that was not written to meanwhile. Only two
// whole updates during the work lead to another round, and dssmd writes some times a second.
template <class Work>
auto with_record(const ClockPage& page, const Work& work) {
  for (;;) {
    const std::uint64_t generation = page.generation.load(std::memory_order_acquire);
    auto result = work(page.records[generation % 2], generation);
    if (page.generation.load(std::memory_order_relaxed) == generation) return result;
  }
}

// Acquire: what follows is not read earlier; pairs with the release stores of set().
template <class T>
T get(const std::atomic<T>& field) noexcept {
  return field.load(std::memory_order_acquire);
}

// Release: a reader that sees any of these sees the generation that was current before them, and
// tries again.
template <class T>
void set(std::atomic<T>& field, T value) noexcept {
  field.store(value, std::memory_order_release);
}

Result<ClockPage*> map_page(int fd, int protection) {
  struct stat file {};
  if (::fstat(fd, &file) || !S_ISREG(file.st_mode) || file.st_size != sizeof(ClockPage)) {
    return Error{Errc::protocol, "this is no clock page: no file of one page"};
  }
  void* memory = ::mmap(nullptr, sizeof(ClockPage), protection, MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) return os_error("map the clock page");
  auto* page = static_cast<ClockPage*>(memory);
  if (is_clock_page(*page)) return page;
  ::munmap(memory, sizeof(ClockPage));
  return Error{Errc::protocol, "this is no clock page of layout version 1"};
}

// The page in the file, when it is one of this boot.
ClockPage* map_existing(const std::string& path, const std::string& boot) {
  const UniqueFd file(::open(path.c_str(), O_RDWR | O_CLOEXEC | O_NOFOLLOW));
  if (!file) return nullptr;
  const Result<ClockPage*> page = map_page(file.get(), PROT_READ | PROT_WRITE);
  if (!page) return nullptr;
  if (!boot.empty() && std::string_view((*page)->boot_id, kBootIdBytes) == boot) return *page;
  ::munmap(*page, sizeof(ClockPage));
  return nullptr;
}

}  // namespace

std::string boot_id() {
  const UniqueFd file(::open("/proc/sys/kernel/random/boot_id", O_RDONLY | O_CLOEXEC));
  std::string id(kBootIdBytes, '\0');
  if (!file || ::read(file.get(), id.data(), id.size()) != static_cast<ssize_t>(id.size())) {
    return {};
  }
  return id;
}

StatedBound stated_bound(const ClockPage& page) noexcept {
  return with_record(page, [](const ClockPage::Record& record, std::uint64_t generation) noexcept {
    return StatedBound{generation,
                       get(record.wall_ns),
                       get(record.bound_ns),
                       get(record.ageing_ppb),
                       get(record.earlier_from_ns),
                       get(record.earlier_bound_ns)};
  });
}

std::optional<Duration> error_at(const ClockPage& page, Time t) noexcept {
  const StatedBound seen = stated_bound(page);
  const std::int64_t time = to_ns(t);
  if (time < seen.wall_ns) {
    if (time < seen.earlier_from_ns) return std::nullopt;
    return Duration(seen.earlier_bound_ns);
  }
  // Unsigned: the two may be further apart than 2^63 ns.
  const std::uint64_t age =
      static_cast<std::uint64_t>(time) - static_cast<std::uint64_t>(seen.wall_ns);
  if (age > static_cast<std::uint64_t>(to_ns(kLongestUse))) return std::nullopt;
  if (seen.bound_ns == INT64_MAX) return kUnknownClockError;
  // At most 3.5e9 * 10^6 here, so it does not overflow; the division rounds up.
  const std::uint64_t growth =
      (age * static_cast<std::uint64_t>(seen.ageing_ppb) + 999'999'999) / 1'000'000'000;
  return sum(Duration(seen.bound_ns), Duration(static_cast<std::int64_t>(growth)));
}

ClockStatus status_of(const ClockPage& page) noexcept {
  struct Seen {
    std::int64_t mono;
    std::uint32_t status;
  };
  const Seen seen = with_record(page, [](const ClockPage::Record& record, std::uint64_t) noexcept {
    return Seen{get(record.mono_ns), get(record.status)};
  });
  const Duration age = MonoClock::now() - MonoTime(Duration(seen.mono));
  return age > kLongestUse ? ClockStatus::unknown : static_cast<ClockStatus>(seen.status);
}

ClockRecord load(const ClockPage& page) {
  return with_record(page, [](const ClockPage::Record& record, std::uint64_t) {
    ClockRecord out;
    out.wall = time_from_ns(get(record.wall_ns));
    out.mono = MonoTime(Duration(get(record.mono_ns)));
    out.state.status = static_cast<ClockStatus>(get(record.status));
    out.state.trouble = static_cast<ClockReason>(get(record.trouble));
    out.state.basis = static_cast<ClockBasis>(get(record.basis));
    out.state.stratum = static_cast<std::uint16_t>(get(record.stratum));
    out.state.reference_id = get(record.reference_id);
    out.state.bound = Duration(get(record.bound_ns));
    out.state.ageing = get(record.ageing_ppb);
    out.state.offset = Duration(get(record.offset_ns));
    out.state.read = MonoTime(Duration(get(record.read_mono_ns)));
    out.state.updated = MonoTime(Duration(get(record.updated_mono_ns)));
    out.state.root = {Duration(get(record.root_dispersion_ns)),
                      Duration(get(record.root_delay_ns))};
    out.earlier_from = time_from_ns(get(record.earlier_from_ns));
    out.earlier_bound = Duration(get(record.earlier_bound_ns));
    out.limit = Duration(get(record.limit_ns));
    out.base = {MonoTime(Duration(get(record.base_mono_ns))),
                time_from_ns(get(record.base_wall_ns)), Duration(get(record.base_width_ns))};
    for (const std::atomic<char>& c : record.reference) {
      if (get(c) == '\0') break;
      out.reference.push_back(get(c));
    }
    return out;
  });
}

Result<const ClockPage*> map_clock_page_untrusted(int fd) {
  static std::mutex mutex;
  static std::map<std::pair<dev_t, ino_t>, const ClockPage*> pages;
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("look at the clock page");
  const std::lock_guard guard(mutex);
  const std::pair key(file.st_dev, file.st_ino);
  if (const auto known = pages.find(key); known != pages.end()) return known->second;
  const Result<ClockPage*> page = map_page(fd, PROT_READ);
  if (!page) return page.error();
  pages.emplace(key, *page);
  return static_cast<const ClockPage*>(*page);
}

Result<ClockPageWriter> ClockPageWriter::open(const std::string& path) {
  const std::string boot = boot_id();
  if (ClockPage* page = map_existing(path, boot)) return ClockPageWriter(path, page, true);
  // Beside it, and renamed when it is whole: whoever has the old one mapped keeps it.
  const std::string what = "make the clock page '" + path + "'";
  const std::string fresh = path + ".new";
  ::unlink(fresh.c_str());
  const UniqueFd file(::open(fresh.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0644));
  if (!file || ::ftruncate(file.get(), sizeof(ClockPage))) return os_error(what);
  void* memory =
      ::mmap(nullptr, sizeof(ClockPage), PROT_READ | PROT_WRITE, MAP_SHARED, file.get(), 0);
  if (memory == MAP_FAILED) return os_error(what);
  auto* page = static_cast<ClockPage*>(memory);
  ClockPageWriter writer(path, page, false);
  boot.copy(page->boot_id, kBootIdBytes);
  writer.store({});
  page->layout_version = ClockPage::kLayoutVersion;
  page->magic = ClockPage::kMagic;
  if (::rename(fresh.c_str(), path.c_str())) return os_error(what);
  return writer;
}

ClockPageWriter::ClockPageWriter(ClockPageWriter&& other) noexcept
    : path_(std::move(other.path_)),
      page_(std::exchange(other.page_, nullptr)),
      has_history_(other.has_history_) {}

ClockPageWriter::~ClockPageWriter() {
  if (page_) ::munmap(page_, sizeof(ClockPage));
}

void ClockPageWriter::store(const ClockRecord& record) noexcept {
  const std::uint64_t next = page_->generation.load(std::memory_order_relaxed) + 1;
  ClockPage::Record& out = page_->records[next % 2];
  set(out.wall_ns, to_ns(record.wall));
  set(out.bound_ns, to_ns(record.state.bound));
  set(out.ageing_ppb, record.state.ageing);
  set(out.earlier_from_ns, to_ns(record.earlier_from));
  set(out.earlier_bound_ns, to_ns(record.earlier_bound));
  set(out.limit_ns, to_ns(record.limit));
  set(out.mono_ns, to_ns(record.mono.time_since_epoch()));
  set(out.status, static_cast<std::uint32_t>(record.state.status));
  set(out.trouble, static_cast<std::uint32_t>(record.state.trouble));
  set(out.basis, static_cast<std::uint32_t>(record.state.basis));
  set(out.stratum, static_cast<std::uint32_t>(record.state.stratum));
  set(out.reference_id, record.state.reference_id);
  set(out.offset_ns, to_ns(record.state.offset));
  set(out.read_mono_ns, to_ns(record.state.read.time_since_epoch()));
  set(out.updated_mono_ns, to_ns(record.state.updated.time_since_epoch()));
  set(out.root_dispersion_ns, to_ns(record.state.root.dispersion));
  set(out.root_delay_ns, to_ns(record.state.root.delay));
  set(out.base_mono_ns, to_ns(record.base.mono.time_since_epoch()));
  set(out.base_wall_ns, to_ns(record.base.wall));
  set(out.base_width_ns, to_ns(record.base.width));
  for (std::size_t i = 0; i < out.reference.size(); ++i) {
    const bool inside = i < record.reference.size() && i + 1 < out.reference.size();
    set(out.reference[i], inside ? record.reference[i] : '\0');
  }
  page_->generation.store(next, std::memory_order_release);
}

Result<UniqueFd> ClockPageWriter::for_reading() const {
  UniqueFd file(::open(path_.c_str(), O_RDONLY | O_CLOEXEC));
  if (!file) return os_error("open the clock page '" + path_ + "'");
  return file;
}

}  // namespace dssm::clock
