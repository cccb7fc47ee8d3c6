// SPDX-License-Identifier: Apache-2.0
//
// What this dssmd keeps for one stream of another host. RemoteStream is what mirrors and remote
// writers have in common: the connection to the owner, the programs that wait for the ring, and how
// many use it.
//
//   RemoteStreams<Mirror>         one entry per stream, found by its name (remote_streams.hpp)
//     Mirror, RemoteWriter        one stream
//       RemoteStream              this file
//         ChannelClient           core/channel: the protocol's steps, with a drawing of its states
//         OwnerConnection         this file; connects, reconnects, checks who answers
//       MirrorRing, OutgoingRing  the ring's memory
//
// A program's open() is answered at once when there is a ring that it may use. Otherwise it waits,
// at most for kOwnerTimeout, until the derived class answers or fails it.
//
// The states, and what leads from one to the next; there may be a ring in each of them. They are
// kept by channel_ (ChannelClient), where subscribing and starting are `asked`, publishing is
// `granted`:
//
//          connected         Opened                Subscribed         CaughtUp
//   closed --------> opening ------> subscribing ------------> filling ------> live      Mirror
//                            ------> starting --------------> publishing           RemoteWriter
//                                                 Publishing
//
//   the connection ends   any state -> closed; it is retried after a pause
//   Failure, Ended        any state -> closed; retried after kRetryPause, or at once when the
//                         catalog has the stream again or a program opens it. But when the owner
//                         refuses Open to a remote writer and another program waits, that one's
//                         request is sent on the same channel
//   is_removed_           set by Ended, by the Failure not_found (not for a remote writer that
//                         creates the stream) and, for a mirror, no_permission, cleared by Opened
//                         and other Failures. While it is set, programs do not get the ring that is
//                         still here: their open() waits for the owner's answer
#pragma once

#include <fmt/core.h>

#include <cstdint>
#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/channel/channel_client.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/rate_limiter.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/clock_assessor.hpp"
#include "daemon/link/dialer.hpp"
#include "daemon/link/resolver.hpp"
#include "daemon/service/config_values.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

// What the channels of this dssmd to other hosts have in common; all of it outlives them.
struct ChannelParts {
  const EventLoop& loop;
  Resolver& resolver;
  Registry& registry;  // for memory and quotas
  Logger& logger;
  wire::Greeting self;
  ClockAssessor* clock = nullptr;  // nullptr: the clock is not watched
  // How long a mirror stays after its last reader closed it. May change.
  Duration mirror_linger{};
  // What mirrors ask of their owners. May change: Mirror::on_new_demand().
  MirrorDemands mirrors = {};
  // How what is written here is sent to owners. May change, for connections from then on.
  SendingDemands sending = {};
  // Readers of this ring, a mirror's, shall reopen the stream: it has a new ring.
  std::function<void(const Stream&)> on_ring_replaced = {};
  // Which programs use the rings, for the owners. nullptr: they are not notified.
  const OpenTable* opens = nullptr;
  HandshakeBudget* handshakes = nullptr;  // as in Dialer::Options
};

// The connection of a mirror or a remote writer to the dssmd that owns its stream: follows the host
// to the address that the catalog knows, checks that it is this host that answers, and always
// reconnects while that host is up.
class OwnerConnection final : private Dialer::Observer {
 public:
  // Between two attempts to open a stream that was removed or refused.
  static constexpr Duration kRetryPause = std::chrono::seconds(2);

  // stream: its name, for messages. All outlive it.
  OwnerConnection(const ChannelParts& parts, const std::string& stream, Dialer::Observer& observer);
  OwnerConnection(const OwnerConnection&) = delete;
  OwnerConnection& operator=(const OwnerConnection&) = delete;

  // The host that owns the stream, after the first connect().
  const std::optional<wire::HostId>& owner() const noexcept { return owner_; }
  const wire::Address& address() const noexcept { return address_; }
  void on_new_credentials() {
    if (dialer_) dialer_->on_new_credentials();
  }
  FrameConnection* frames() noexcept { return dialer_ ? dialer_->connection() : nullptr; }

  // The owner answers at that address. Another host than before has taken over the name.
  void connect(const KnownHost& host);
  // The owner does not answer: this connection has ended too, even if TCP has not noticed it. No
  // attempts until connect(): the control connection finds out when the owner is back.
  void on_owner_down(const Error& why);

  // Opens the stream again, on a new connection: the present one belongs to a stream that was
  // removed or refused. At once, or after kRetryPause.
  void reopen();
  void reopen_later() { retry_timer_.enable_in(kRetryPause); }
  // In on_down(): the connection ends because of reopen().
  bool is_reopening() const noexcept { return reopening_; }

 private:
  void on_up(FrameConnection& connection, const wire::Greeting& them) override;
  Result<void> on_frame(net::Frame& frame) override { return observer_.on_frame(frame); }
  void on_output_empty() override { observer_.on_output_empty(); }
  void on_down(const Error& why) override;

  const ChannelParts& parts_;
  const std::string& stream_;
  Dialer::Observer& observer_;
  std::optional<wire::HostId> owner_;
  wire::Address address_;
  bool reopening_ = false;  // the connection is about to end because of reopen()
  EventSource retry_timer_;
  std::unique_ptr<Dialer> dialer_;
};

// How many programs use a ring. A program (mostly: its entry in the OpenTable) holds the stream
// that acquire() returned, as any other stream, and releases it by dropping it.
class UseCount {
 public:
  // on_change: called when it is acquired or released, from inside any code that does so, so it may
  // only set a timer. Not called after the UseCount is destroyed; acquired streams may outlive it.
  explicit UseCount(std::function<void()> on_change)
      : state_(std::make_shared<State>(State{std::move(on_change)})) {}

  std::shared_ptr<Stream> acquire(const std::shared_ptr<Stream>& stream) {
    ++state_->users;
    state_->on_change();
    return {stream.get(), [stream, weak = std::weak_ptr<State>(state_)](Stream*) {
              const std::shared_ptr<State> state = weak.lock();
              if (!state) return;
              --state->users;
              state->on_change();
            }};
  }
  bool in_use() const noexcept { return state_->users > 0; }

 private:
  struct State {
    std::function<void()> on_change;
    std::size_t users = 0;
  };
  std::shared_ptr<State> state_;
};

class RemoteStream : private Dialer::Observer, protected channel::ChannelClient::Delegate {
 public:
  // How long a program's open() waits for the owner to answer.
  static constexpr Duration kOwnerTimeout = std::chrono::seconds(2);
  static constexpr Duration kGapLinePeriod = std::chrono::seconds(10);

  // Called once, from the loop, or at once from within open(); not after this is destroyed. When it
  // throws bad_alloc from the loop, it is called once more, with no_memory.
  using Then = std::function<void(Result<OpenedRing>)>;

  RemoteStream(const RemoteStream&) = delete;
  RemoteStream& operator=(const RemoteStream&) = delete;
  virtual ~RemoteStream() = default;

  const StreamId& id() const noexcept { return id_; }  // with its owner's host
  OwnerConnection& connection() noexcept { return connection_; }
  // Whether there is a ring, or an open that waits for one.
  bool is_needed() const noexcept { return stream() || !pending_.empty(); }
  // Whether it may be destroyed.
  bool done() const noexcept { return done_; }

  // Acquires the ring for a program, as RemoteStreams::open(). After connection().connect().
  void open(const CreatePlan* plan, Then then, bool waits_for_history = true);
  // Takes a ring that a program held while dssmd was not running. Another offer of the same ring
  // gives the same stream; with another ring it fails with conflict, and `files` stay as they are.
  Result<std::shared_ptr<Stream>> adopt_untrusted(OfferedFiles&& files);
  // The ring as it is; nullptr: none yet.
  std::shared_ptr<Stream> acquire();

  // --- what the catalog knows of the owner

  // It has such a stream, or a new ring of it.
  virtual void on_stream_added(const StreamInfo& theirs);
  // It has removed the ring of that incarnation. The channel reports this too, after the last
  // samples.
  virtual void on_stream_removed(std::uint64_t /*incarnation*/) {}
  // It has sent new values of its clock.
  virtual void on_owner_clock(std::shared_ptr<const wire::ClockReport> /*report*/) {}

 protected:
  // Constant for all streams of a kind.
  struct Kind {
    Purpose purpose;
    std::string_view message_id;  // of its log lines
    std::string_view gap_reason;  // why samples are lost, and what to do
    // What becomes of the ring while the owner does not answer; {} is the stream.
    fmt::format_string<const std::string&> stopped;
  };

  // parts outlives it. on_done: called when it is done(); destroy it later, not there.
  RemoteStream(const ChannelParts& parts, Kind kind, StreamId id, RingQuota quota,
               std::function<void()> on_done);

  // --- what the derived class knows

  virtual std::shared_ptr<Stream> stream() const noexcept = 0;  // of the ring; nullptr: none
  // Whether open() may be answered at once.
  virtual bool can_open_now(bool /*waits_for_history*/) const noexcept {
    return stream() && !is_removed_;
  }
  virtual Duration open_timeout() const noexcept { return kOwnerTimeout; }
  // Whether a program that asks for this may have the ring.
  virtual Result<void> check_open(const CreatePlan* plan) = 0;
  // Takes the ring of a program.
  virtual Result<void> use_offered(std::shared_ptr<Stream> stream) = 0;
  // A program that offered the ring has the right to create the stream at its owner.
  virtual void allow_create() {}
  // There is a ring, and no program uses it or waits for it.
  virtual void on_unused() = 0;

  // --- the channel

  // The connection is up: follow with channel_.open().
  virtual void on_connected(const wire::Greeting& them) = 0;
  virtual void on_output_empty() override {}
  // The channel is closed.
  virtual void on_channel_end() = 0;
  // Ends the channel, for which the owner, or this host, has no stream; reopens it later.
  void stop(const Error& why, bool removed);
  void send(const net::Frame& frame) override { connection_.frames()->send(frame); }
  Result<void> on_ended(const Error& why) override;
  Result<void> on_other_frame(net::Frame& frame) override;

  // --- programs that use the ring

  // The channel is open: notifies the owner of them, then and whenever they change.
  void begin_users() { users_timer_.enable_in(Duration::zero()); }

  // --- programs that wait

  bool is_unused() const noexcept { return !use_count_.in_use() && pending_.empty(); }
  MonoTime unused_since() const noexcept { return unused_since_; }
  const std::optional<CreatePlan>* first_pending() const noexcept;  // nullptr: none waits
  void set_pending_deadline(MonoTime deadline);
  void answer_pending(bool created);
  void answer_ready();  // those of the pending ones for which can_open_now()
  void fail_pending(const Error& why);
  void fail_first_pending(const Error& why);
  void finish();

  // --- the log

  LogFields log_fields() const;
  // The stream is live. Returns whether an error had been logged.
  bool clear_error();
  // `samples` more will never be in the ring. At most one line in kGapLinePeriod: a connection that
  // is too slow for its stream loses samples all the time.
  //   reason  why, and what to do; empty: the one of this kind
  void log_gap(std::uint64_t samples, std::string_view reason = {});

  // Who is charged for its ring.
  const std::string& account() const noexcept { return quota_.account(); }

  const ChannelParts& parts_;
  const StreamId id_;
  const std::string name_;           // for messages
  std::optional<Error> last_error_;  // why it is not live
  bool is_removed_ = false;          // the owner has no such stream, or not for this host
  channel::ChannelClient channel_{*this};

 private:
  // Dialer::Observer, of connection_
  void on_up(FrameConnection&, const wire::Greeting& them) override {
    wants_users_ = parts_.opens && them.has_feature(wire::kFeatureUsers);
    on_connected(them);
  }
  Result<void> on_frame(net::Frame& frame) override { return channel_.on_frame(frame); }
  void on_down(const Error& why) override;

  struct PendingOpen {
    Then then;
    std::optional<CreatePlan> plan;
    MonoTime deadline;
    bool waits_for_history;
  };
  void end_channel();
  void send_users();
  void log_stopped();
  Result<OpenedRing> opened(const CreatePlan* plan);
  // Takes out those that meet it.
  template <typename Condition>
  std::vector<PendingOpen> take_pending(Condition condition);
  void after_pending();
  void arm_pending_timer();
  void on_pending_timer();

  const Kind kind_;
  const RingQuota quota_;
  const std::function<void()> on_done_;
  bool done_ = false;
  bool error_logged_ = false;
  std::uint64_t gap_samples_ = 0;
  RateLimiter gap_lines_{1, kGapLinePeriod};
  std::vector<PendingOpen> pending_;
  EventSource pending_timer_;
  MonoTime unused_since_{};
  bool wants_users_ = false;        // the owner has the feature "users"
  net::SetUsers stated_users_;      // what it was notified of on this channel
  std::uint64_t users_serial_ = 0;  // of the SetUsers that waits for its answer; 0: none
  EventSource users_timer_;
  UseCount use_count_;

 protected:
  OwnerConnection connection_;
};

}  // namespace dssm::daemon
