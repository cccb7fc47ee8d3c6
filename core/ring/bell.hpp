// SPDX-License-Identifier: Apache-2.0
//
// The bell: a word in shared memory through which a writer wakes the threads that wait for samples
// of its stream. Readers cannot write to the ring, so the word is in a page of its own, which all
// programs that use the stream map writable. A hostile reader can clear it, or take sleepers off
// the kernel's queue (FUTEX_REQUEUE), so sleepers also check the ring by themselves (SleepTimes).
//
// Protocol (docs/ring-layout.md "Bell page"): bit 0 of `word` means that a thread sleeps, the other
// bits count notifications. A sleeper sets bit 0, checks the ring again, and waits in the kernel
// for the word to change. A writer that finds bit 0 set after publishing adds 1, which clears the
// bit and changes the count, and wakes all. A sleeper that dies causes at most one needless
// wake-up.
#pragma once

#include <algorithm>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <memory>
#include <span>
#include <string>

#include "core/base/sealed_memory.hpp"
#include "core/ring/layout.hpp"

namespace dssm::ring {

// How long a thread that waits for samples sleeps before it checks the ring by itself: two cycles
// of the stream at first, later as long as it has waited already, up to kMaxSleep. While samples
// come, a writer wakes it before that. It depends on the time, not on the number of sleeps, because
// a program that suppresses wake-ups can also end sleeps early.
class SleepTimes {
 public:
  static constexpr Duration kMaxSleep = std::chrono::seconds(1);
  static constexpr Duration kMinSleep = std::chrono::milliseconds(2);

  // cycle: of the stream, or the shortest of several
  explicit SleepTimes(Duration cycle) noexcept
      : least_(2 * std::clamp(cycle, kMinSleep / 2, kMaxSleep / 2)) {}

  Duration next(MonoTime now) noexcept {
    if (begin_ == MonoTime{}) begin_ = now;
    return std::clamp<Duration>(now - begin_, least_, kMaxSleep);
  }

 private:
  Duration least_;
  MonoTime begin_{};
};

// Creates the memory file of a bell page: size sealed, mode 0600.
//   label  RingIdentity::label() of its ring
Result<UniqueFd> create_bell(const std::string& label);

// A mapped bell page. Shared by shared_ptr; thread-safe.
class Bell {
 public:
  // Fails with `protocol` when `fd` is not a sealed memory file of the right size. Does not keep
  // `fd`.
  static Result<std::shared_ptr<Bell>> open_untrusted(int fd);

  Bell(const Bell&) = delete;
  Bell& operator=(const Bell&) = delete;

  // --- writers, after publishing

  // Before: starts to fetch the line that notify() loads. A sleeper wrote to it, so it comes
  // from another processor, and can do so while the payload is copied.
  void prefetch() const noexcept { __builtin_prefetch(mapping_.base()); }

  // Wakes all sleepers; without any, one load of a line that is in this processor's cache.
  void notify() noexcept {
    if (page().word.load(std::memory_order_seq_cst) & kSleeper) notify_slow();
  }

  // --- sleepers

  // Announces a sleeper; returns the value to pass to sleep(). Check the ring between the two.
  std::uint32_t announce() noexcept {
    return page().word.fetch_or(kSleeper, std::memory_order_seq_cst) | kSleeper;
  }

  // Sleeps until the word differs from `announced`, or `deadline`. Returns `ready` after `at_most`,
  // and may do so without cause.
  WaitStatus sleep(std::uint32_t announced, MonoTime deadline,
                   Duration at_most = SleepTimes::kMaxSleep) noexcept;

  // Sleeps until one of several bells is notified; at most 128 of them. announced[i] belongs to
  // bells[i]. On a kernel without futex_waitv (before 5.16) it polls every millisecond instead.
  static WaitStatus sleep_any(std::span<Bell* const> bells,
                              std::span<const std::uint32_t> announced, MonoTime deadline,
                              Duration at_most = SleepTimes::kMaxSleep) noexcept;

 private:
  static constexpr std::uint32_t kSleeper = 1;
  explicit Bell(SharedMapping mapping) noexcept : mapping_(std::move(mapping)) {}
  BellPage& page() const noexcept { return mapping_.as<BellPage>(); }
  void notify_slow() noexcept;
  SharedMapping mapping_;
};

}  // namespace dssm::ring
