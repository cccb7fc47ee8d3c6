// SPDX-License-Identifier: Apache-2.0
//
// Publishes what programs of this PC write into one stream of another host: one local ring, however
// many programs write to it, and one channel to the owner.
//
//   ring     programs write to it without waiting for anybody; what the link does not carry at the
//            moment stays there, and what it no longer holds when its turn comes is counted and
//            told in the log
//   once     samples are numbered by their local tids, and the owner notes in its ring how far we
//            are by it, so that it can say, after a cut, where to go on
//   end      when the programs have closed it and everything is published, at most kDrainTimeout
//            later
//   removed  a stream that somebody removes at its owner stays removed until somebody creates it
//            again; then it gets what the ring still holds. But an owner that comes back without
//            its ring gets the stream created again
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "daemon/base/rate_limiter.hpp"
#include "daemon/link/sample_pump.hpp"
#include "daemon/link/sample_sender.hpp"
#include "daemon/link/stream_feed.hpp"
#include "daemon/remote/lender.hpp"
#include "daemon/remote/outgoing_ring.hpp"
#include "daemon/remote/owner_connection.hpp"
#include "daemon/remote/remote_writer_keeper.hpp"

namespace dssm::daemon {

class RemoteWriter final : private OwnerConnection::Observer,
                           private StreamFeed::Observer,
                           private SamplePump::Observer {
 public:
  // How long a program that opens it waits for the owner to answer.
  static constexpr Duration kOwnerTimeout = std::chrono::seconds(2);
  static constexpr Duration kDrainTimeout = std::chrono::seconds(10);

  class Keeper {
   public:
    // A remote writer is done(). Destroy it later, not here.
    virtual void on_remote_writer_done() = 0;

   protected:
    ~Keeper() = default;
  };
  using Then = RemoteWriterKeeper::Then;

  // id: with its owner's host. parts and keeper outlive it.
  RemoteWriter(const ChannelParts& parts, Keeper& keeper, StreamId id, RingQuota room);
  RemoteWriter(const RemoteWriter&) = delete;
  RemoteWriter& operator=(const RemoteWriter&) = delete;
  ~RemoteWriter() { stop_publishing(); }  // before its link goes

  // --- for ChannelTable
  const StreamId& id() const noexcept { return id_; }
  OwnerConnection& channel() noexcept { return channel_; }
  void on_stream_there();
  bool has_use() const noexcept { return ring_ || !waiting_.empty(); }
  bool done() const noexcept { return done_; }

  // --- for programs

  // Borrows the ring, as RemoteWriterKeeper::open(). After channel().connect().
  void open(const CreatePlan* plan, Then then);
  // Takes a ring that a program held while dssmd was away. Another offer of the same ring gives the
  // same stream; with another ring it fails with conflict, and `files` stay as they are.
  Result<std::shared_ptr<Stream>> adopt_untrusted(OfferedFiles&& files);

 private:
  enum class Step { none, opening, starting, publishing };  // of the connection
  struct Waiting {
    Then then;
    std::optional<CreatePlan> plan;
    MonoTime deadline;
  };

  // OwnerConnection::Observer
  void on_up(FrameConnection& link, const wire::Greeting& them) override;
  Result<void> on_frame(net::Frame& frame) override;
  void on_output_empty() override { publish(); }
  void on_down(const Error& why) override;
  void on_reopen() override;
  // StreamFeed::Observer, SamplePump::Observer
  void on_news() override { publish(); }
  void on_gap(Tid first, std::uint64_t count) override;

  void ask();
  Result<void> on_opened_untrusted(const proto::Opened& opened);
  Result<void> follow(const StreamInfo& theirs);
  Result<void> take_ring(std::unique_ptr<OutgoingRing> ring);
  Result<void> on_publishing_untrusted(const net::Publishing& publishing);
  Result<void> on_published_untrusted(const net::Published& published);
  Result<void> note_published_untrusted(Tid last);
  void start_publishing();
  void publish();
  void stop_publishing() noexcept;
  void on_refused(const Error& why);

  OpenedRing lend(bool created);
  Result<void> check_plan(const CreatePlan* plan);
  void answer_waiting(bool created);
  void fail_waiting(const Error& why);
  void arm_wait_timer();
  void on_wait_timer();
  void on_drain_timer();
  void end();
  void log_error(const Error& why);
  LogFields log_fields() const;

  const ChannelParts& parts_;
  Keeper& keeper_;
  const StreamId id_;
  const RingQuota room_;
  const std::string name_;  // for messages

  Step step_ = Step::none;
  bool creates_ = false;  // a program wants the stream to be there
  bool removed_ = false;  // by somebody, and not created again
  History history_;       // of the owner's ring
  std::optional<Error> trouble_;
  bool told_ = false;  // the log knows of it
  std::uint64_t lost_samples_ = 0;
  RateLimiter loss_lines_{1, std::chrono::seconds(10)};

  std::unique_ptr<OutgoingRing> ring_;
  std::shared_ptr<StreamFeed> feed_;
  bool may_tear_ = false;  // the owner has the feature "torn"
  std::optional<SampleSender> sender_;
  std::optional<SamplePump> pump_;

  bool done_ = false;
  Lender lender_;
  std::vector<Waiting> waiting_;
  MonoTime drain_ends_{};
  EventSource wait_timer_, drain_timer_, turn_timer_;
  OwnerConnection channel_;  // last: ends first
};

}  // namespace dssm::daemon
