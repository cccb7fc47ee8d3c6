// SPDX-License-Identifier: Apache-2.0
//
// Publishes what programs of this PC write into one stream of another host: one local ring, for any
// number of programs that write to it, and one channel to the owner.
//
//   ring     programs write to it and never wait. Samples that the network does not carry at once
//            stay in it; those that it no longer holds when their turn comes are counted and logged
//   once     samples are numbered by their local tids, and the owner stores in its ring which of
//            them it has, so that it can report, after a reconnect, where to continue
//   end      when the programs have closed it and all samples are published, at most kDrainTimeout
//            after the last one closed it
//   removed  a stream that is removed at its owner stays removed until a program creates it again;
//            then it gets what the ring still holds. But when an owner comes back without its ring,
//            the remote writer creates the stream again
//
// The states are drawn in remote_stream.hpp. Open is sent, or Create if a program created the
// stream. When the owner refuses what one program that waits asks for, the next one's
// request is sent on the same channel.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>

#include "daemon/link/sample_pump.hpp"
#include "daemon/link/sample_sender.hpp"
#include "daemon/link/stream_feed.hpp"
#include "daemon/remote/outgoing_ring.hpp"
#include "daemon/remote/remote_stream.hpp"

namespace dssm::daemon {

class RemoteWriter final : public RemoteStream,
                           private StreamFeed::Observer,
                           private SamplePump::Observer {
 public:
  static constexpr Duration kDrainTimeout = std::chrono::seconds(10);
  static constexpr bool kSeveralRings = true;

  RemoteWriter(const ChannelParts& parts, StreamId id, RingQuota quota,
               std::function<void()> on_done);
  ~RemoteWriter() override { stop_publishing(); }

 private:
  // ChannelClient::Delegate
  Result<void> on_opened(StreamInfo stream, bool created) override;
  Result<void> on_published_untrusted(std::int64_t last, Tid last_tid, bool begins) override;
  Result<void> on_refused(channel::ChannelClient::Request request, const Error& why) override;
  // StreamFeed::Observer, SamplePump::Observer
  void on_sample_available() override { publish(); }
  void on_gap(Tid, std::uint64_t count) override { log_gap(count); }
  // RemoteStream
  std::shared_ptr<Stream> stream() const noexcept override;
  Result<void> check_open(const CreatePlan* plan) override;
  Result<void> use_offered(std::shared_ptr<Stream> stream) override;
  // Perhaps the program only opened it: then it gets its stream back too.
  void allow_create() override { creates_ = true; }
  void on_unused() override { drain_timer_.enable_in(Duration::zero()); }

  void on_connected(const wire::Greeting& them) override;
  void on_output_empty() override { publish(); }
  void on_channel_end() override { stop_publishing(); }

  void open_at_owner();
  Result<void> follow(const StreamInfo& theirs);
  Result<void> use_ring(std::unique_ptr<OutgoingRing> ring);
  void start_publishing();
  void publish();
  void pump();
  void stop_publishing() noexcept;
  void on_drain_timer();

  // A program that has the ring, or had it last, may have the stream created, not only opened.
  bool creates_ = false;
  History history_;  // of the owner's ring
  std::unique_ptr<OutgoingRing> ring_;
  std::shared_ptr<StreamFeed> feed_;
  bool may_tear_ = false;  // the owner has the feature "torn"
  std::optional<SampleSender> sender_;
  std::optional<SamplePump> pump_;
  EventSource drain_timer_, turn_timer_;
};

}  // namespace dssm::daemon
