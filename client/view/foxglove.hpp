// SPDX-License-Identifier: Apache-2.0
//
// Foxglove's WebSocket protocol, for Foxglove and other programs that speak it
// (https://github.com/foxglove/ws-protocol/blob/main/docs/spec.md): each stream is a channel, whose
// samples are CDR with a ROS 2 schema, as in recordings (docs/recording.md).
//
// Samples are sent as they come. Of those that the other end does not take in time none waits here
// beyond a budget: they are left out, and it is told how many. A recording is played to each client
// as that asks for it ("playback control"), at the client's pace; so is what the rings hold to one
// that connects at kHoldPath, while the vehicle goes on.
#pragma once

#include <cstdint>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <functional>
#include <map>
#include <memory>
#include <optional>
#include <set>
#include <string>
#include <string_view>
#include <variant>
#include <vector>

#include "client/view/server.hpp"
#include "client/view/state.hpp"
#include "client/view/streams.hpp"

namespace dssm::view {

class FoxgloveConnection;

// All clients. In the server's thread.
class FoxgloveClients {
 public:
  // `streams` outlives it.
  //   name      of the host or of the recording
  //   want_all  called when a client wants to know the programs: the next state is to have them
  //   played    the vehicle's clock, or the recording
  FoxgloveClients(std::string name, Streams& streams, std::function<void()> want_all,
                  std::variant<PlaybackClock, Recording> played);

  std::unique_ptr<Connection> connect(Peer& peer);

  // What there is now; called about once a second.
  void on_state(const VehicleState& state);

  // Sends the samples that have come since the last call; to be called each kSendPeriod.
  void send_samples();
  static constexpr Duration kSendPeriod = std::chrono::milliseconds(10);

  static constexpr std::string_view kHoldPath = "/hold";

 private:
  friend class FoxgloveConnection;
  struct Channel {
    std::string stream, topic;
    std::uint64_t incarnation = 0;
    TypeInfo type;
    std::string advertisement;  // JSON
  };

  const std::string name_;
  Streams& streams_;
  const std::function<void()> want_all_;
  std::variant<PlaybackClock, Recording> played_;
  std::map<std::uint32_t, Channel> channels_;  // by their ids
  std::uint32_t last_channel_ = 0;
  std::string graph_;               // the message about programs and streams
  std::optional<TimeRange> range_;  // of all samples
  const std::string session_id_;
  std::set<FoxgloveConnection*> connections_;
};

}  // namespace dssm::view
