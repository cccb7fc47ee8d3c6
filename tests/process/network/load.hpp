// SPDX-License-Identifier: Apache-2.0
//
// The load of the long tests: fifteen streams of known samples, from 10 Hz to 1 kHz and from 64 B
// to 1 MiB, and their writer.
#pragma once

#include <atomic>
#include <dssm/dssm.hpp>
#include <vector>

#include "tests/process/network/known_samples.hpp"

namespace dssm::test {

// The fifteen streams of `host`. They are written at `percent` of their full rates, which come to
// 30 MB and 6000 samples a second; their rings take 120 MB. Some rings hold many seconds, others
// less than one.
std::vector<KnownStream> load_of(int host, std::uint64_t percent);

// Writes streams at their rates.
class LoadWriter {
 public:
  // Creates the streams. Existing streams are continued, with the life of their samples.
  LoadWriter(Session session, const std::vector<KnownStream>& streams, std::uint64_t life);

  void write_until(const std::atomic<bool>& stop);

  // `stream` is an index into the list.
  Tid newest(std::size_t stream) const { return streams_[stream].writer.newest_tid(); }

 private:
  struct Written {
    KnownStream known;
    RawWriter writer;
    std::uint64_t life;
    std::uint64_t written = 0;  // by this object

    void write_next();
  };
  std::vector<Written> streams_;
};

// Four streams of pc1 that another host writes. Their rings hold more than a minute, which is
// longer than any cut of a cable.
std::vector<KnownStream> published_load(std::uint64_t percent);

// A stream of pc1, 256 B at 1 kHz. Its ring holds a minute, so that readers lose nothing.
KnownStream steady_stream();

}  // namespace dssm::test
