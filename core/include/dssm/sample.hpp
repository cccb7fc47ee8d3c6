// SPDX-License-Identifier: Apache-2.0
//
// What every sample carries beside its payload, and the outcomes of reading one.
#pragma once

#include <cstdint>
#include <dssm/time.hpp>
#include <string_view>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// The number of a sample in its stream: 0, 1, 2 ... in write order.
using Tid = std::int64_t;

// "No sample": the newest tid of a stream that nobody has written to yet.
inline constexpr Tid kNoTid = -1;

struct SampleInfo {
  Tid tid = kNoTid;
  Time time{};                                // when it was measured, by the writer's clock
  Duration clock_error = kUnknownClockError;  // >= 0: how far `time` may be from the truth
};

// Outcomes of a read: part of normal work, no text, nothing allocated.
enum class [[nodiscard]] ReadStatus : std::uint8_t{
    ok,
    not_yet,    // nothing is there yet: an empty stream, or a tid that is not written yet
    too_old,    // the ring no longer holds it
    lapped,     // the writer overtook this reader again and again; nothing torn was returned
    restarted,  // the stream began anew, with a new ring and new tids: the reader is on it now,
                // call again
    clock_out_of_bounds,  // reads by time: the clocks of this PC and the stream's host may be
                          // further apart than is allowed (key clock_limit)
};

// Outcomes of a wait.
enum class [[nodiscard]] WaitStatus : std::uint8_t{
    ready,
    timeout,      // the deadline passed
    interrupted,  // a signal handler ran; wait again or leave
};

// "ok", "not_yet" ...; static storage.
std::string_view name_of(ReadStatus status) noexcept;

}  // namespace dssm
#pragma GCC visibility pop
