// SPDX-License-Identifier: Apache-2.0
#include "client/src/lockstep.hpp"

#include <fcntl.h>
#include <linux/futex.h>
#include <signal.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <charconv>
#include <climits>
#include <cstdlib>
#include <dssm/playback_clock.hpp>
#include <new>
#include <string_view>

#include "core/base/time.hpp"

namespace dssm::detail {
namespace {

using clock::LockstepPage;
using clock::LockstepPlace;

std::int32_t thread_id() noexcept { return static_cast<std::int32_t>(::syscall(SYS_gettid)); }

// The place of a thread, until the thread ends. A forked child takes one of its own.
struct ThreadPlace {
  LockstepPlace* place = nullptr;
  ThreadPlace() = default;
  ThreadPlace(const ThreadPlace&) = delete;
  ThreadPlace& operator=(const ThreadPlace&) = delete;
  ~ThreadPlace() {
    if (place && place->thread.load() == thread_id()) place->state.store(LockstepPlace::unused);
  }
};
thread_local ThreadPlace own;

UniqueFd duplicated(int fd) noexcept { return UniqueFd(::fcntl(fd, F_DUPFD_CLOEXEC, 3)); }

}  // namespace

Lockstep* Lockstep::of_process() noexcept {
  // Never destroyed: other threads may still wait while the program exits.
  static Lockstep* const lockstep = from_environment().release();
  return lockstep;
}

std::unique_ptr<Lockstep> Lockstep::from_environment() noexcept {
  const char* const value = ::secure_getenv(LockstepPage::kVariable);
  if (!value) return nullptr;
  const std::string_view text(value);
  int memory = -1, player = -1;
  const auto [comma, error] = std::from_chars(text.begin(), text.end(), memory);
  if (error != std::errc() || comma == text.end() || *comma != ',') return nullptr;
  if (std::from_chars(comma + 1, text.end(), player).ec != std::errc()) return nullptr;
  Result<SharedMapping> mapping =
      SharedMapping::map_sealed_untrusted(memory, LockstepPage::kBytes, "lockstep page");
  if (!mapping) return nullptr;
  const auto& page = mapping->as<LockstepPage>();
  if (page.magic != LockstepPage::kMagic || page.layout_version != LockstepPage::kLayoutVersion) {
    return nullptr;
  }
  // The descriptors themselves stay open for programs that this one starts.
  return std::unique_ptr<Lockstep>(new (std::nothrow)
                                       Lockstep(*std::move(mapping), duplicated(player)));
}

LockstepPlace* Lockstep::own_place() noexcept {
  const std::int32_t thread = thread_id();
  if (own.place && own.place->thread.load() == thread) return own.place;
  for (LockstepPlace& place : page().places) {
    std::uint32_t unused = LockstepPlace::unused;
    if (!place.state.compare_exchange_strong(unused, LockstepPlace::running)) continue;
    place.process = ::getpid();
    place.thread = thread;
    return own.place = &place;
  }
  page().too_many = 1;
  return nullptr;
}

bool Lockstep::await_turn(LockstepPlace& place) noexcept {
  while (place.state.load() == LockstepPlace::waiting && !has_ended()) {
    constexpr timespec kCheckPeriod{1, 0};  // for a player that was killed
    if (::syscall(SYS_futex, &place.state, FUTEX_WAIT, LockstepPlace::waiting, &kCheckPeriod,
                  nullptr, 0) != 0 &&
        errno == EINTR) {
      return false;
    }
  }
  return true;
}

bool Lockstep::has_ended() const noexcept {
  if (page().ended.load()) return true;
  if (::kill(page().player, 0) == 0 || errno != ESRCH) return false;
  page().ended = 1;
  return true;
}

void Lockstep::recheck() noexcept {
  for (LockstepPlace& place : page().places) {
    std::uint32_t waiting = LockstepPlace::waiting;
    if (place.process.load() != ::getpid() ||
        !place.state.compare_exchange_strong(waiting, LockstepPlace::running)) {
      continue;
    }
    ::syscall(SYS_futex, &place.state, FUTEX_WAKE, INT_MAX, nullptr, nullptr, 0);
  }
}

Lockstep::Request::Request() noexcept {
  if (Lockstep* const lockstep = of_process()) lockstep->page().requests_begun.fetch_add(1);
}

Lockstep::Request::~Request() {
  if (Lockstep* const lockstep = of_process()) lockstep->page().requests_ended.fetch_add(1);
}

std::optional<WaitStatus> Lockstep::wait_until(MonoTime deadline,
                                               const std::function<bool()>& ready) noexcept {
  if (deadline == kNever) return wait_for(Duration::max(), ready);
  using Milliseconds = std::chrono::duration<std::int64_t, std::milli>;
  return wait_for(std::chrono::ceil<Milliseconds>(deadline - MonoClock::now()), ready);
}

std::optional<WaitStatus> Lockstep::wait_for(Duration time,
                                             const std::function<bool()>& ready) noexcept {
  if (ready()) return WaitStatus::ready;
  LockstepPlace* const place = has_ended() ? nullptr : own_place();
  if (!place) return std::nullopt;
  const std::int64_t begin_ns = page().now_ns.load();
  const std::int64_t time_ns = to_ns(time);
  const std::int64_t until_ns =
      time_ns > LockstepPlace::kForever - std::max<std::int64_t>(begin_ns, 0)
          ? LockstepPlace::kForever
          : begin_ns + time_ns;
  const auto returns = [&](WaitStatus status) {
    place->taken.fetch_add(1);
    return status;
  };
  for (;;) {
    if (page().now_ns.load() >= until_ns) return returns(WaitStatus::timeout);
    place->until_ns.store(until_ns);
    place->state.store(LockstepPlace::waiting);
    const std::uint64_t one = 1;
    [[maybe_unused]] const ssize_t written = ::write(player_.get(), &one, sizeof one);
    const bool interrupted = !await_turn(*place);
    place->state.store(LockstepPlace::running);  // after a signal, too
    if (has_ended()) return std::nullopt;
    if (ready()) return returns(WaitStatus::ready);
    if (interrupted) return returns(WaitStatus::interrupted);
  }
}

}  // namespace dssm::detail

namespace dssm {

std::optional<WaitStatus> sleep_in_lockstep(Duration playback_time) noexcept {
  detail::Lockstep* const lockstep = detail::Lockstep::of_process();
  if (!lockstep) return std::nullopt;
  return lockstep->wait_for(playback_time, [] { return false; });
}

}  // namespace dssm
