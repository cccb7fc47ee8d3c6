// SPDX-License-Identifier: Apache-2.0
//
// How far each publisher (a writer on another PC) has got with a stream, so that each of its
// samples is written exactly once, however often a connection ends or this PC's dssmd is restarted.
// The cursors are in the ring's header and live as long as the ring. A publisher is identified by a
// number that stays the same over reconnects, and it numbers its samples.
//
// A cursor is advanced before the sample's `top` is set. A dssmd that is killed in between leaves a
// cursor beyond `top`; then its earlier position counts, and the next holder of the lock restores
// that. docs/ring-layout.md "Publishers".
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

// A value; the ring outlives it, and is mapped for writing where advance() or recover() is called.
class PublisherCursors {
 public:
  explicit PublisherCursors(RingHeader& header) noexcept : header_(&header) {}

  struct Last {
    std::int64_t number = -1;  // -1: no sample of that publisher is known to be written
    Tid tid = kNoTid;          // its tid in the stream
  };
  // The newest sample of `publisher`. Without the lock, in dssmd's thread. Programs can write
  // nonsense there; the tid is one of the ring's, or kNoTid.
  Last last_untrusted(std::uint64_t publisher) const noexcept;

  // `sample` is about to become `tid`, which follows the newest one. With the lock. A new publisher
  // gets the cursor of the one that wrote longest ago when all are in use.
  void advance(const PublishedSample& sample, Tid tid) const noexcept;

  // Restores cursors that a writer advanced before it died without publishing. With the lock.
  void recover() const noexcept;

 private:
  PublisherCursor& cursor_of(std::uint64_t publisher) const noexcept;
  std::uint64_t end() const noexcept;

  RingHeader* header_;
};

}  // namespace dssm::ring
