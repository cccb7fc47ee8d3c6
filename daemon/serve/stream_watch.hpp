// SPDX-License-Identifier: Apache-2.0
//
// One control connection that watches the streams of this host: first all that are there, then the
// answer to Watch, then what changes. What was there at first goes out as fast as the peer takes
// it, so that thousands of streams need no memory to wait in.
#pragma once

#include <cstdint>
#include <deque>
#include <memory>

#include "daemon/link/frame_connection.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

class StreamWatch {
 public:
  // Streams told in a row before others get their turn.
  static constexpr int kStreamsPerTurn = 64;

  // All outlive it.
  StreamWatch(const Registry& registry, const OpenTable& opens, FrameConnection& link,
              std::uint64_t serial);

  // Goes on telling while the link takes it. True when others should have their turn and work()
  // be called again; else nothing is left, or on_output_empty() comes.
  bool work();

  void on_stream_added(const Stream& stream);
  void on_stream_removed(const Stream& stream);

 private:
  void tell(const Stream& stream);

  const OpenTable& opens_;
  FrameConnection& link_;
  std::uint64_t serial_;  // of Watch; 0: answered
  std::deque<std::weak_ptr<const Stream>> untold_;
};

}  // namespace dssm::daemon
