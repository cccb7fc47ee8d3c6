// SPDX-License-Identifier: Apache-2.0
//
// One control connection that watches the streams of this host: first an event for each existing
// stream, then the response to Watch, then changes. The first events are sent as fast as the peer
// receives them, so that thousands of streams need no memory for a queue.
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
  // Events sent in a row before others get their turn.
  static constexpr int kStreamsPerTurn = 64;

  // All outlive it.
  StreamWatch(const Registry& registry, const OpenTable& opens, FrameConnection& link,
              std::uint64_t serial);

  // Sends events while the link takes them. True when others should have their turn and work() be
  // called again; else nothing is left, or on_output_empty() comes.
  bool work();

  void on_stream_added(const Stream& stream);
  void on_stream_removed(const Stream& stream);

 private:
  void send_added(const Stream& stream);

  const OpenTable& opens_;
  FrameConnection& link_;
  std::uint64_t serial_;  // of Watch; 0: answered
  std::deque<std::weak_ptr<const Stream>> pending_;
};

}  // namespace dssm::daemon
