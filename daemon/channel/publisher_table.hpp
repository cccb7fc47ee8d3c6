// SPDX-License-Identifier: Apache-2.0
//
// Where the remote writers of one stream stopped, so that each of their samples is written once,
// however often their connection breaks: a publisher is a number that stays the same over
// reconnects, and it numbers its samples. Lives as long as the stream and this dssmd.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>
#include <list>

namespace dssm::daemon {

class PublisherTable {
 public:
  // More publishers of one stream at a time than anybody has, and few enough to search one by one.
  // The one that wrote longest ago is forgotten for a new one.
  static constexpr std::size_t kMaxPublishers = 64;

  struct Entry {
    std::uint64_t publisher = 0;
    std::int64_t last = -1;  // number of the last sample that was written; -1: none
    Tid last_tid = kNoTid;   // its tid in the stream
  };

  // The entry of `publisher`, a new one if there was none; it counts as used now.
  Entry get(std::uint64_t publisher) { return use(publisher); }

  // Sample `number` of `publisher` was written as sample `tid` of the stream.
  void written(std::uint64_t publisher, std::int64_t number, Tid tid) {
    Entry& entry = use(publisher);
    entry.last = number;
    entry.last_tid = tid;
  }

 private:
  Entry& use(std::uint64_t publisher);
  std::list<Entry> entries_;  // the one that was used last comes first
};

}  // namespace dssm::daemon
