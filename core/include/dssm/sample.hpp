// SPDX-License-Identifier: Apache-2.0
//
// What each sample has besides its payload, and the outcomes of reading one.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <dssm/time.hpp>
#include <span>
#include <string_view>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// The number of a sample in its stream: 0, 1, 2 ... in write order.
using Tid = std::int64_t;

// No sample, e.g. the newest tid of a stream without samples.
inline constexpr Tid kNoTid = -1;

struct SampleInfo {
  Tid tid = kNoTid;
  Time time{};                                // when it was measured, by the writer's clock
  Duration clock_error = kUnknownClockError;  // >= 0 [ns]: bound on the error of `time`
  std::uint64_t payload_bytes = 0;            // of this sample: at most those of the stream
};

// Sets the bytes of `payload` that a sample does not have, because it is shorter, to 0.
inline void zero_rest(std::span<std::byte> payload, const SampleInfo& info) noexcept {
  if (info.payload_bytes >= payload.size()) return;
  std::ranges::fill(payload.subspan(info.payload_bytes), std::byte{0});
}

// Outcomes of a read: part of normal work, without a text.
enum class [[nodiscard]] ReadStatus : std::uint8_t{
    ok,
    not_yet,    // the stream is empty, or that sample is not written yet
    too_old,    // the ring no longer holds it
    lapped,     // the writer overtook the reader 1,000 times in a row
    restarted,  // the stream has a new ring with new tids; the reader uses it now: call again
    clock_out_of_bounds,  // reads by time: the clocks of this PC and of the owner may differ
                          // by more than dssmd's key clock_limit
    arriving,  // of another host's stream: the sample is still there only, or it is not known yet
               // which one it is; from now on it is on its way
    lost,      // of another host's stream: the network could not carry it, and it will never come
    stale,     // reads by time with a maximum age: the sample is older
};

// Outcomes of a wait.
enum class [[nodiscard]] WaitStatus : std::uint8_t{
    ready,
    timeout,      // the deadline passed
    interrupted,  // a signal handler ran
};

// "ok", "not_yet" ...; static storage.
std::string_view name_of(ReadStatus status) noexcept;

}  // namespace dssm
#pragma GCC visibility pop
