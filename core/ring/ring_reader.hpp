// SPDX-License-Identifier: Apache-2.0
//
// Reading from a mapped ring. No locks, no system calls, no trust: every number that comes from the
// mapping is checked before it becomes an address, and every sample is validated by its sequence,
// so that a hostile writer can make a read fail or return nonsense, but not fault or hang.
//
// The tids oldest(top) ... top are readable: depth - 1 samples, because the slot of the next sample
// may be written at any moment.
#pragma once

#include <dssm/sample.hpp>
#include <span>

#include "core/ring/ring_memory.hpp"

namespace dssm::ring {

// A value: a pointer and a few numbers. The mapping outlives it.
//   threads  all functions are const and may run in any number of threads
class RingReader {
 public:
  explicit RingReader(const RingMapping& mapping) noexcept
      : header_(&mapping.header()), slots_(mapping) {}

  Tid newest() const noexcept { return header_->top.load(std::memory_order_acquire); }
  Tid oldest() const noexcept { return slots_.oldest_for(newest()); }
  // What is still to come to a mirror, before its newest samples.
  TidRange hole() const noexcept { return hole_of(*header_); }
  // Whether a read of sample `tid` has a result for good: it is here, or will never be.
  bool is_settled(Tid tid) const noexcept;
  // The first sample from `tid` on that is not known to be lost; a tid after the newest: itself.
  Tid skip_lost(Tid tid) const noexcept;

  // Copies sample `tid` into `payload`: at most the stream's payload_bytes long; a longer sample is
  // cut. What follows info.payload_bytes in it, and all of it unless ok, is unspecified.
  //   returns  ok | not_yet | arriving | lost | too_old
  ReadStatus read(Tid tid, std::span<std::byte> payload, SampleInfo& info) const noexcept;

  // Copies the newest sample. Retries up to kMaxRetries times when the writer laps it.
  //   returns  ok | not_yet | lapped
  ReadStatus read_newest(std::span<std::byte> payload, SampleInfo& info) const noexcept;

  // The stamps of sample `tid`.
  //   returns  ok | not_yet | arriving | lost | too_old
  ReadStatus stamp(Tid tid, SampleInfo& info) const noexcept;

  // What this PC's dssmd states about the times in this ring. One load where it states nothing:
  // where only this PC writes. What a hostile writer keeps changing counts as an unknown clock.
  ClockAssessment clock() const noexcept {
    if (!header_->clock.is_set()) return {};
    ClockAssessment assessment = ClockAssessment::unknown_clock(ClockPolicy::enforce);
    header_->clock.load(assessment);
    return assessment;
  }

  // Whether clock().is_good() decides which samples reads by time return. Loads the policy alone:
  // to copy the whole assessment for each read made reads of mirrors a tenth slower.
  bool enforces_clock() const noexcept {
    ClockAssessment stated;
    // As in clock(), what a hostile writer keeps changing counts as an unknown clock.
    if (header_->clock.load<ClockAssessment::kPolicyBytes>(stated) == 0) {
      return header_->clock.is_set();
    }
    return stated.policy == ClockPolicy::enforce && stated.same_clock == 0;
  }

  // Tid of the newest sample with time <= `t`; kNoTid with too_old when all lie after it.
  //   attempts  how often it is looked for, while the writer overtakes the search
  //   returns  ok | not_yet (empty) | arriving (it may be in the hole or before) | too_old | lapped
  ReadStatus find(Time t, Tid& tid, int attempts = kMaxRetries) const noexcept;

  // The payload of sample `tid` in place, info.payload_bytes long. It was that sample's if
  // `sequence` still holds `expected` after the last access: see still_valid().
  struct Place {
    const std::byte* payload;
    const std::atomic<std::uint64_t>* sequence;
    std::uint64_t expected;
  };
  ReadStatus locate(Tid tid, Place& place, SampleInfo& info) const noexcept;

  // Whether the sample was not overwritten since locate(). The caller's loads of the payload are
  // ordered before the load of the sequence.
  static bool still_valid(const std::atomic<std::uint64_t>& sequence,
                          std::uint64_t expected) noexcept;

  static constexpr int kMaxRetries = 1000;  // a reader that is lapped more often cannot keep up

 private:
  ReadStatus status_of_absent(Tid tid) const noexcept;

  const RingHeader* header_;
  SlotTable slots_;
};

}  // namespace dssm::ring
