// SPDX-License-Identifier: Apache-2.0
//
// What is known of a PC's clock, and of the distance of two PCs' clocks. docs/clocks.md explains
// the words and the numbers.
#pragma once

#include <cstdint>
#include <dssm/time.hpp>
#include <string>
#include <string_view>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

enum class ClockStatus : std::uint8_t {
  unknown,        // chronyd has not answered yet
  synchronized,   // the bound is within the limit
  holdover,       // the same, but chronyd has not measured its sources for some time
  out_of_bounds,  // the bound is beyond the limit, or there is none: see ClockReason
};

// Why a clock is out of bounds.
enum class ClockReason : std::uint8_t {
  none,
  no_chronyd,      // nothing listens at chronyd's address
  silent,          // chronyd does not answer
  unsynchronized,  // chronyd answers that it does not know the time
  stepped,         // the clock was set, and chronyd has not measured it since
  too_far,         // the bound is beyond the limit
};

// What the bound is a distance from.
enum class ClockBasis : std::uint8_t {
  nothing,    // there is no bound
  root,       // UTC, or the time that the root of the clocks has
  reference,  // the clock of the fleet's reference PC
  own,        // this PC is the reference: right by definition
};

// What happens to samples of a clock that is not known well enough.
enum class ClockPolicy : std::uint8_t {
  enforce,  // streams are not opened, reads by time return clock_out_of_bounds
  mark,     // all samples are delivered; clock_in_bounds() says which are good
  off,      // all samples are delivered and count as good
};

// How far a clock is from the root of its time, in the terms of RFC 5905; both >= 0.
struct RootDistance {
  Duration dispersion{};
  Duration delay{};

  friend bool operator==(const RootDistance& a, const RootDistance& b) = default;
};

// All values known of a clock at one time. The one list of these fields: dssmd keeps it for this
// PC, states it on the shared page and in its report to other hosts, and programs get it in
// HostInfo. On the page as it is here (core/clock/clock_page.hpp), so a change raises the page's
// version.
struct ClockSnapshot {
  Duration bound = kUnknownClockError;  // of its samples' times, against what `basis` names
  std::int64_t ageing_ppb = 0;          // what bound and root_bound grow by, ns per second
  ClockStatus status = ClockStatus::unknown;
  ClockReason reason = ClockReason::none;
  ClockBasis basis = ClockBasis::nothing;
  std::uint8_t reserved = 0;
  std::uint32_t stratum = 0;
  Duration root_bound = kUnknownClockError;  // distance from UTC
  RootDistance root;
  Duration offset{};           // this clock minus chronyd's estimate of the right time
  Duration update_interval{};  // between two measurements of chronyd
  Duration age{};              // since chronyd last learned something from its sources

  friend bool operator==(const ClockSnapshot& a, const ClockSnapshot& b) = default;
};

// What a bound on the distance of two clocks follows from.
enum class DistanceBasis : std::uint8_t {
  nothing,    // there is no bound
  chain,      // what chronyd states on both hosts
  measured,   // heartbeats between both hosts
  one_clock,  // both have the same kernel
};

// What one host, the reader, states of the samples of another one, their owner. All of it holds at
// the time of the request, for a sample that is written then. Bounds are >= 0; kUnknownClockError:
// unknown.
struct ClockPair {
  std::string reader;  // the host that reads
  std::string owner;   // the host whose samples are read; empty: `error` is about all of them
  // Why the times of the owner's samples are not good for the reader, in a sentence, for people;
  // empty: they are, or its clock_policy is off. Streams for which clock_streams has another policy
  // or limit may differ.
  std::string reason;
  bool refused = false;  // for `reason`, the reader refuses reads by time
  // How far the times of the samples may be from the reader's clock: the lesser of `chain` and
  // `measured`, unknown when these exclude each other, 0 for one clock.
  Duration bound = kUnknownClockError;
  DistanceBasis basis = DistanceBasis::nothing;  // what `bound` follows from
  Duration chain = kUnknownClockError;  // by what chronyd states on both; unknown for one clock
  // By heartbeats, the greatest of the last seconds; unknown for one clock.
  Duration measured = kUnknownClockError;
  Duration round_trip{};  // the shortest of the reader's heartbeats in 64 s; 0: not measured
  Duration limit{};       // clock_limit of the reader, the greatest good `bound`
  std::string error;      // why none of this is known, in a sentence, for people; empty: it is

  friend bool operator==(const ClockPair&, const ClockPair&) = default;
};

// "synchronized", "out of bounds", "no chronyd", "reference", "enforce", "one clock" ...; static
// storage.
std::string_view name_of(ClockStatus status) noexcept;
std::string_view name_of(ClockReason reason) noexcept;
std::string_view name_of(ClockBasis basis) noexcept;
std::string_view name_of(ClockPolicy policy) noexcept;
std::string_view name_of(DistanceBasis basis) noexcept;

}  // namespace dssm
#pragma GCC visibility pop
