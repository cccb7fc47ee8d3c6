// SPDX-License-Identifier: Apache-2.0
//
// What this PC's dssmd states about the times in a mirror, or in an own stream that other hosts
// write to: how far they may be from this PC's clock, and which of them reads by time may deliver.
// It is in the ring's header, where readers find it with each read by time. dssmd stores it again
// about once a second. docs/clocks.md "Assessing another host's samples".
//
// In a ring that only this PC writes to nothing is stored; it is read as a ClockAssessment().
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/sample.hpp>
#include <dssm/time.hpp>

namespace dssm::ring {

//   off size field          unit  (docs/ring-layout.md "Clock")
//     0    1 policy         -     dssm::ClockPolicy; without effect where same_clock is not 0
//     1    1 same_clock     -     not 0: stamped by this PC's own clock
//     2    2 reserved       -     zero
//     4    4 ageing_ppb     ns/s  what `added` grows by
//     8    8 added          ns    to a sample's clock error: its distance from this PC's clock
//    16    8 limit          ns    greatest distance at which a sample is good
//    24    8 assessed       ns    CLOCK_MONOTONIC, when this was stated
//    32   16 suspect_first, suspect_last  tids of the samples whose clock errors cannot be trusted,
//                                 because the writer's clock was being set
//    48    8 measured       ns    distance of the writer's clock from this PC's, measured between
//                                 both, whatever the clock error of a sample
//    56    8 measured_from  ns    of samples with this time or a later one
//    64    4 measured_ageing_ppb  ns/s  what `measured` grows by
//    68    4 reserved       -     zero
//    72    8 recent         ns    the same for later samples; grows as `measured`
//    80    8 recent_from    ns    of samples with this time or a later one: the last seconds
//    88    8 measured_first_tid   `measured` and `recent` are of this sample and later ones;
//                                 earlier ones may have been stamped before the writer's clock
//                                 was set back, or before its PC booted
struct ClockAssessment {
  ClockPolicy policy = ClockPolicy::off;
  std::uint8_t same_clock = 1;
  std::uint16_t reserved = 0;
  std::uint32_t ageing_ppb = 0;
  Duration added{};
  Duration limit = kUnknownClockError;
  MonoTime assessed{};
  Tid suspect_first = 0;
  Tid suspect_last = kNoTid;
  Duration measured = kUnknownClockError;
  Time measured_from{};
  std::uint32_t measured_ageing_ppb = 0;
  std::uint32_t reserved1 = 0;
  Duration recent = kUnknownClockError;
  Time recent_from{};
  Tid measured_first_tid = 0;

  // An older assessment counts as unknown: dssmd states one a second, and restarts in less.
  static constexpr Duration kValidFor = std::chrono::seconds(3);

  // A greater ageing counts as this one: a bound that doubles in less than its own time.
  static constexpr std::uint32_t kMaxAgeingPpb = 1'000'000'000;

  // So many bytes hold the policy and whether it has an effect.
  static constexpr std::size_t kPolicyBytes = 8;

  // Another clock, of which nothing is known: no sample is good, unless `policy` is off.
  static ClockAssessment unknown_clock(ClockPolicy policy) noexcept;

  // How far the sample's time may be from this PC's clock: by its clock error or as measured,
  // whichever is less.
  Duration distance(const SampleInfo& info, MonoTime now) const noexcept;
  // Whether it is good. A time of a foreign clock is, unless this PC's own clock was being set at
  // that time: then it is not known which clock it was.
  bool is_good(const SampleInfo& info, MonoTime now) const noexcept;
  // Whether a sample without a clock error would be good, or a new one is by the measurement.
  bool can_be_good() const noexcept;

 private:
  bool is_suspect(const SampleInfo& info) const noexcept;
};
static_assert(sizeof(ClockAssessment) == 96);

}  // namespace dssm::ring
