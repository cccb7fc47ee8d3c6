// SPDX-License-Identifier: Apache-2.0
//
// Where those stopped who publish into a stream from other PCs, so that each of their samples is
// written once, however often a connection breaks or this PC's dssmd is restarted: the notes stand
// in the ring's header and live as long as the ring. A publisher is a number that stays the same
// over reconnects, and it numbers its samples.
//
// A note is made before the sample's top is set. A dssmd that is killed in between leaves the note
// of a sample that is not there; then what was noted before it counts, and the next holder of the
// lock puts that back. docs/ring-layout.md "Publishers".
#pragma once

#include <cstdint>
#include <dssm/sample.hpp>

#include "core/ring/layout.hpp"

namespace dssm::ring {

// A sample as its publisher names it.
struct PublishedSample {
  std::uint64_t publisher = 0;
  std::int64_t number = -1;  // -1: none
};

// A value; the ring, mapped for writing by who notes and recovers, outlives it.
class PublisherCursors {
 public:
  explicit PublisherCursors(RingHeader& header) noexcept : header_(&header) {}

  struct Last {
    std::int64_t number = -1;  // -1: nothing of that publisher is known to be written
    Tid tid = kNoTid;          // its tid in the stream
  };
  // What `publisher` wrote last. Without the lock, in dssmd's thread. Programs can write nonsense
  // there; the tid is one of the ring's, or kNoTid.
  Last last_untrusted(std::uint64_t publisher) const noexcept;

  // `sample` is about to become `tid`, which follows the newest one. With the lock. The publisher
  // that wrote longest ago is forgotten for a new one.
  void note(const PublishedSample& sample, Tid tid) const noexcept;

  // Takes back what a writer noted that died before its sample was there. With the lock.
  void recover() const noexcept;

 private:
  PublisherCursor& place_for(std::uint64_t publisher) const noexcept;
  std::uint64_t end() const noexcept;

  RingHeader* header_;
};

}  // namespace dssm::ring
