// SPDX-License-Identifier: Apache-2.0
//
// The bell: how a writer wakes those who sleep on its stream. Readers cannot write to the ring, so
// the word they sleep on stands in a page of its own that all users of the stream map writable. The
// worst that a hostile reader can do with it is to disturb the wake-ups of this one stream, and
// sleepers look up by themselves every kMaxSleep.
//
// Protocol (docs/ring-layout.md "Bell page"): bit 0 of `word` means "somebody sleeps", the other
// bits count the rings. A sleeper sets bit 0, looks at the ring once more, and waits in the kernel
// for the word to change. A writer that finds bit 0 set after publishing adds 1, which clears it
// and changes the count, and wakes all. A sleeper that dies leaves at most one needless wake-up.
#pragma once

#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <memory>
#include <span>

#include "core/base/sealed_memory.hpp"
#include "core/ring/layout.hpp"

namespace dssm::ring {

inline constexpr Duration kMaxSleep = std::chrono::seconds(1);

// Creates the memfd of a bell page, sealed like a ring, mode 0600.
Result<UniqueFd> create_bell();

// A mapped bell page. Shared by shared_ptr; thread-safe.
class Bell {
 public:
  // Fails with `protocol` when `fd` is not a sealed memory file of the right size. Does not keep `fd`.
  static Result<std::shared_ptr<Bell>> open_untrusted(int fd);

  Bell(const Bell&) = delete;
  Bell& operator=(const Bell&) = delete;

  // --- writers, after publishing

  // Before: a sleeper or dssmd wrote to the line that ring() looks at, so it has to come from
  // another processor, and may do so while the payload is copied.
  void expect_ring() const noexcept { __builtin_prefetch(mapping_.base()); }

  // Wakes all sleepers; without any, one load of a line that nobody writes.
  void ring() noexcept {
    if (page().word.load(std::memory_order_seq_cst) & kSleeper) ring_slowly();
  }

  // Whether dssmd wants to be rung through the stream's eventfd.
  bool doorbell_armed() const noexcept {
    return page().doorbell_armed.load(std::memory_order_seq_cst) != 0;
  }

  // --- dssmd
  void arm_doorbell(bool armed) noexcept {
    page().doorbell_armed.store(armed ? 1 : 0, std::memory_order_seq_cst);
  }

  // --- sleepers

  // Announces a sleeper; returns the value to hand to sleep(). Look at the ring between the two.
  std::uint32_t announce() noexcept {
    return page().word.fetch_or(kSleeper, std::memory_order_seq_cst) | kSleeper;
  }

  // Sleeps until the word differs from `announced`, or `deadline`. May also return `ready` without
  // cause.
  WaitStatus sleep(std::uint32_t announced, MonoTime deadline) noexcept;

  // Sleeps until one of several bells rings; at most 128 of them. announced[i] belongs to bells[i].
  // On a kernel without futex_waitv (before 5.16) it looks every millisecond instead.
  static WaitStatus sleep_any(std::span<Bell* const> bells,
                              std::span<const std::uint32_t> announced, MonoTime deadline) noexcept;

 private:
  static constexpr std::uint32_t kSleeper = 1;
  explicit Bell(SharedMapping mapping) noexcept : mapping_(std::move(mapping)) {}
  BellPage& page() const noexcept { return mapping_.as<BellPage>(); }
  void ring_slowly() noexcept;
  SharedMapping mapping_;
};

}  // namespace dssm::ring
