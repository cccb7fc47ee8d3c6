// SPDX-License-Identifier: Apache-2.0
//
// Samples that can be checked by whoever reads them: time, clock error and every word of the
// payload follow from the stream, the life of its writer, and the tid.
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
  Duration cycle{};   // between two samples, but for the jitter
  Duration jitter{};  // times differ by at most so much from the regular ones; above the cycle they
                      // run backwards now and then
  std::uint64_t number = 0;  // differs between the streams of a test

  TypeInfo type() const { return {"", payload_bytes, 8, {}}; }
  History history() const { return {depth, cycle}; }

  // The stamps of sample `tid`.
  SampleInfo info(Tid tid) const;
  // Its payload: word 0 is `life`, a number that differs between two writers of one stream of which
  // the second begins anew; the other words follow from stream, life and tid, and all differ.
  void fill(std::span<std::byte> payload, std::uint64_t life, Tid tid) const;

  static std::uint64_t life(std::span<const std::byte> payload);

  // What is wrong with a sample that was read; empty when nothing is.
  std::string fault(std::span<const std::byte> payload, const SampleInfo& info,
                    std::uint64_t life) const;
};

}  // namespace dssm::test
