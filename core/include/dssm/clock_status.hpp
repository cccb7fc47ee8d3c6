// SPDX-License-Identifier: Apache-2.0
//
// What is known of a PC's clock, in words. docs/clocks.md explains them.
#pragma once

#include <cstdint>
#include <string_view>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

enum class ClockStatus : std::uint8_t {
  unknown,        // chronyd has not been heard of yet
  synchronized,   // the bound is within the limit
  holdover,       // so far, but chronyd has not heard from its sources for some time
  out_of_bounds,  // beyond the limit, or there is no bound: see ClockReason
};

// Why a clock is out of bounds.
enum class ClockReason : std::uint8_t {
  none,
  no_chronyd,      // nothing listens where it should
  silent,          // it does not answer
  unsynchronized,  // it answers that it does not know the time
  stepped,         // the clock was set; chronyd has not measured it anew
  too_far,         // the bound is beyond the limit
};

// What the bound is a distance from.
enum class ClockBasis : std::uint8_t {
  nothing,    // there is no bound
  root,       // UTC, or whatever the root of the clocks has
  reference,  // the clock of the fleet's reference PC
  own,        // this PC is the reference: right by definition
};

// What happens to samples of a clock that is not known well enough.
enum class ClockPolicy : std::uint8_t {
  enforce,  // streams are not opened, reads by time return clock_out_of_bounds
  mark,     // all samples are delivered; clock_in_bounds() says which are good
  off,      // all samples are delivered and count as good
};

// "synchronized", "out of bounds", "no chronyd", "reference", "enforce" ...; static storage.
std::string_view name_of(ClockStatus status) noexcept;
std::string_view name_of(ClockReason trouble) noexcept;
std::string_view name_of(ClockBasis basis) noexcept;
std::string_view name_of(ClockPolicy policy) noexcept;

}  // namespace dssm
#pragma GCC visibility pop
