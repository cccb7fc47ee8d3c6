// SPDX-License-Identifier: Apache-2.0
//
// What this PC's dssmd thinks of the times in a mirror, or in an own stream that other hosts write
// to: how far they may be from this PC's clock, and which of them are good. It stands in the ring's
// header, where readers look at it with each read by time; docs/clocks.md "Judging another host's
// samples".
//
// dssmd is the only writer, and writes anew about once a second.
#pragma once

#include <atomic>
#include <cstdint>
#include <dssm/sample.hpp>
#include <dssm/time.hpp>

namespace dssm::ring {

enum class ClockRule : std::uint32_t {
  none = 0,        // nobody judges: a stream that only this PC writes to
  same_clock = 1,  // another host, but this PC's kernel: no distance, and all is good
  off = 2,         // all is good
  mark = 3,        // what is not good is delivered and can be told from the rest
  enforce = 4,     // reads by time do not deliver it
};

// The judgement as a value.
struct ClockVerdict {
  ClockRule rule = ClockRule::none;
  Duration added = kUnknownClockError;    // to a sample's clock error: its distance from this
                                          // PC's clock
  Duration allowed = kUnknownClockError;  // clock error that is good; below 0: none is
  std::uint32_t ageing_ppb = 0;           // what `added` grows by, ns per second
  MonoTime judged{};                      // when this was so
  Tid doubtful_first = 0;                 // samples whose stamps are not to be believed, because
  Tid doubtful_last = kNoTid;             // the writer's clock was being set

  // A verdict that is older counts as unknown: dssmd gives one a second, and is restarted in less.
  static constexpr Duration kHolds = std::chrono::seconds(3);

  // How far the sample's time may be from this PC's clock.
  Duration distance(const SampleInfo& info, MonoTime now) const noexcept;
  // Whether it is good. One that is stamped by a foreign clock is, unless this PC's own clock was
  // being set: then nobody knows which clock it was.
  bool is_good(const SampleInfo& info, MonoTime now) const noexcept;

 private:
  bool is_doubtful(const SampleInfo& info) const noexcept;
  bool is_believed(const SampleInfo& info, MonoTime now) const noexcept;
  Duration grown_by(MonoTime now) const noexcept;
};

// In the ring's header, all zero when nobody judges. A value is whole when `sequence` is even and
// the same before and after.
struct ClockGate {
  std::atomic<std::uint64_t> sequence;
  std::atomic<std::uint32_t> rule;
  std::atomic<std::uint32_t> ageing_ppb;
  std::atomic<std::int64_t> added_ns, allowed_ns;
  std::atomic<std::int64_t> judged_ns;  // monotonic
  std::atomic<std::int64_t> doubtful_first, doubtful_last;
};
static_assert(sizeof(ClockGate) == 56);

// Whether there ever was a verdict.
inline bool is_judged(const ClockGate& gate) noexcept {
  return gate.sequence.load(std::memory_order_relaxed) != 0;
}

void store(ClockGate& gate, const ClockVerdict& verdict) noexcept;

// Never waits: what cannot be read because dssmd stopped in the middle of writing it counts as a
// verdict by which nothing is good.
ClockVerdict load(const ClockGate& gate) noexcept;

}  // namespace dssm::ring
