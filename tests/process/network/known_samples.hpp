// SPDX-License-Identifier: Apache-2.0
//
// Samples that every reader can check: time, clock error and every word of the payload are computed
// from the stream, the life of its writer, and the tid.
#pragma once

#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <span>
#include <string>
#include <vector>

namespace dssm::test {

// A stream of known samples. A value; its functions may be called from any thread.
struct KnownStream {
  StreamId id;                      // with the owner's host
  std::uint64_t payload_bytes = 0;  // a multiple of 8, at least 16
  std::uint64_t depth = 0;
  Duration cycle{};  // between two samples, without jitter
  Duration
      jitter{};  // greatest difference from the regular times; above the cycle, times sometimes
                 // decrease
  std::uint64_t number = 0;  // differs between the streams of a test
  // Its samples are played from a recording of the stream, in any order, with times and payloads of
  // the original ones and tids of their own: the original tid is computed from the time. The jitter
  // must be less than half of the cycle.
  bool is_played = false;

  TypeInfo type() const { return {"", payload_bytes, 8, {}}; }
  History history() const { return {depth, cycle}; }

  // The stamps of sample `tid`.
  SampleInfo info(Tid tid) const;
  // Its payload: word 0 is `life`, a number that increases when a writer recreates the stream. The
  // other words are computed from stream, life and tid, and all differ.
  void fill(std::span<std::byte> payload, std::uint64_t life, Tid tid) const;

  static std::uint64_t life(std::span<const std::byte> payload);

  // The error of a sample that was read; empty if it is correct.
  std::string fault(std::span<const std::byte> payload, const SampleInfo& info,
                    std::uint64_t life) const;
};

}  // namespace dssm::test
