// SPDX-License-Identifier: Apache-2.0
//
// The copy of one stream of another host: one channel to its owner, one ring here, however many
// programs read it. The ring is filled with the owner's history first and kept up to date from then
// on; after a cut the channel goes on with the sample it stopped at.
//
//   ring     has the owner's type, depth, cycle and incarnation. When the owner comes back with
//            another incarnation there is a new ring, and readers of the old one are told
//   trouble  while the owner is away, or has removed the stream, the ring stays as it is for its
//            readers, and the channel is tried anew for ever
//   end      when nobody has borrowed the ring for mirror_linger
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <vector>

#include "common.pb.h"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limiter.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/remote/lender.hpp"
#include "daemon/remote/mirror_clock.hpp"
#include "daemon/remote/mirror_ring.hpp"
#include "daemon/remote/owner_connection.hpp"

namespace dssm::daemon {

class Mirror final : private OwnerConnection::Observer, private FrameConnection::SampleDelegate {
 public:
  // How long a program that opens the mirror waits for the owner to answer, and then for the
  // history: what has come by then is there to read, the rest follows.
  static constexpr Duration kOwnerTimeout = std::chrono::seconds(2);
  static constexpr Duration kFillTimeout = std::chrono::seconds(1);

  class Keeper {
   public:
    virtual void on_ring_replaced(const Stream& old) = 0;
    // A mirror is done(). Destroy it later, not here.
    virtual void on_mirror_done() = 0;

   protected:
    ~Keeper() = default;
  };
  using Then = std::function<void(Result<std::shared_ptr<Stream>>)>;

  // id: with its owner's host. parts, keeper and linger outlive it.
  Mirror(const ChannelParts& parts, Keeper& keeper, StreamId id, const Duration& linger,
         RingQuota room);
  Mirror(const Mirror&) = delete;
  Mirror& operator=(const Mirror&) = delete;

  const StreamId& id() const noexcept { return id_; }
  // Whether there is a ring, or somebody who waits for one.
  bool has_use() const noexcept { return ring_ || !waiting_.empty(); }
  // Whether it may be destroyed.
  bool done() const noexcept { return done_; }

  // Where the keeper says what the catalog knows of the owner.
  OwnerConnection& channel() noexcept { return channel_; }
  // The owner has such a stream, or a new ring of it.
  void on_stream_there();
  // The owner has removed the ring of that incarnation. The channel tells so, too, behind the last
  // samples.
  void on_stream_gone(std::uint64_t incarnation);
  // The owner reported its clock; this PC's clock was read again.
  void on_owner_clock(MirrorClock::Report report);
  void on_clock() { assess(); }

  // --- for programs

  // Borrows the ring, as MirrorKeeper::open(). After channel().connect().
  void open(Then then);
  // Takes a ring that a program held while dssmd was away. Another offer of the same ring gives the
  // same stream.
  Result<std::shared_ptr<Stream>> adopt_untrusted(OfferedFiles files);
  // The ring as it is; nullptr: none yet.
  std::shared_ptr<Stream> borrow();
  void describe(proto::Mirror& out) const;

 private:
  enum class State { connecting, filling, live, owner_unavailable, removed };
  enum class Step { none, opening, subscribing, subscribed };  // of the connection
  struct Waiting {
    Then then;
    MonoTime deadline;
  };
  struct Totals {
    std::uint64_t gap_samples = 0, received_samples = 0, received_bytes = 0;
  };

  // OwnerConnection::Observer
  void on_up(FrameConnection& link, const wire::Greeting& them) override;
  Result<void> on_frame(net::Frame& frame) override;
  void on_down(const Error& why) override;
  void on_reopen() override;
  // FrameConnection::SampleDelegate
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  void on_batch_end() override;

  Result<void> on_opened_untrusted(const proto::Opened& opened);
  Result<void> on_subscribed_untrusted(const net::Subscribed& subscribed);
  void on_caught_up();
  Result<void> on_gap_untrusted(const net::Gap& gap);
  void on_removed(const Error& why);
  void on_refused(const Error& why);
  Result<void> follow_untrusted(const StreamInfo& theirs);
  void take_ring(std::unique_ptr<MirrorRing> ring);

  void assess();
  std::shared_ptr<Stream> lend();
  void lend_to(const Then& then);
  void answer_waiting();
  void fail_waiting(const Error& why);
  void leave_if_alone(bool somebody_left);
  void arm_wait_timer();
  void on_wait_timer();
  void notify_replaced();
  void on_linger_timer();
  void log_error();
  void log_gaps(std::uint64_t samples);
  Error away() const;
  LogFields log_fields() const;

  const ChannelParts& parts_;
  Keeper& keeper_;
  const StreamId id_;
  const Duration& linger_;  // its keeper's, which may change
  const RingQuota room_;

  MirrorClock clock_;
  State state_ = State::connecting;
  Step step_ = Step::none;
  bool ending_ = false;           // the stream was removed; the channel is still to tell so
  std::optional<Error> trouble_;  // why it is not live
  bool told_ = false;             // the log knows of the present trouble
  std::unique_ptr<MirrorRing> ring_;
  std::vector<std::shared_ptr<Stream>> replaced_;  // whose readers have not been told
  bool subscribed_before_ = false;
  std::uint64_t reconnects_ = 0, restarts_ = 0;
  Totals before_;  // of the rings that were replaced
  RateLimiter gap_lines_{1, std::chrono::seconds(10)};

  bool done_ = false;
  Lender lender_;
  std::vector<Waiting> waiting_;
  MonoTime patience_ends_{};  // with the filling that is under way
  EventSource wait_timer_, linger_timer_;
  const std::string name_;   // for messages
  OwnerConnection channel_;  // last: ends first
};

}  // namespace dssm::daemon
