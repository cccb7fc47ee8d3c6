// SPDX-License-Identifier: Apache-2.0
//
// The client end of one remote stream, in a program: a connection to the dssmd that owns the
// stream, kept up by the calls that use it. A PConnector is a handle of it. The protocol's steps
// are ChannelClient's; here are the calls that wait for them, the requests, and who needs which
// bytes.
//
// A connection is set up by the greeting, Open or Create, and then what was in progress when the
// last one ended: Subscribe from the next sample, StartPublishing and all samples that are not
// acknowledged. While there is none, each call makes an attempt as soon as the pause since the last
// attempt is over. Calls that may wait do so until their deadline; the others (next(), post()) take
// only the steps that need no waiting.
#pragma once

#include <dssm/pconnector.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "client/src/network_connection.hpp"
#include "client/src/outbox.hpp"
#include "client/src/subscriber.hpp"
#include "core/channel/channel_client.hpp"
#include "core/wire/sample_frame.hpp"

namespace dssm::detail {

// A resource with one owner; one thread at a time.
class StreamClient final : private wire::FrameDelegate, private channel::ChannelClient::Delegate {
 public:
  // Which stream; with a plan, it is created if it does not exist.
  struct Goal {
    StreamId id;
    std::optional<channel::CreatePlan> plan = {};
  };

  // Connects and opens or creates. One attempt, at each of the host's addresses.
  static Result<std::unique_ptr<StreamClient>> open(Goal goal, PConnectorOptions options);
  StreamClient(const StreamClient&) = delete;
  StreamClient& operator=(const StreamClient&) = delete;
  ~StreamClient();

  // --- requests, which wait for their answer

  // The answer to `request`; a Failure is returned as its error.
  //   fails  also: unavailable, protocol, and as open()
  Result<net::Frame> ask(net::Frame request);
  // The same for Read, whose answer is a sample or NoSample.
  Result<ReadStatus> read(const wire::ReadRequest& request, std::span<std::byte> payload,
                          SampleInfo& info);

  // --- as PConnector

  Result<void> subscribe(const Subscription& what);
  Result<void> unsubscribe();
  Result<ReadStatus> next(std::span<std::byte> payload, SampleInfo& info);
  WaitStatus wait(MonoTime deadline);
  std::uint64_t lost() const noexcept { return subscriber_->lost(); }
  std::uint64_t restarts() const noexcept { return restart_.count; }
  int ready_fd() noexcept;

  Result<void> post(std::span<const std::byte> payload, Time time, Duration clock_error);
  Result<Tid> flush(MonoTime deadline);
  std::uint64_t dropped() const noexcept { return outbox_->dropped(); }

  const StreamInfo& stream() const noexcept { return stream_; }
  bool is_connected() const noexcept { return setup_.was_up; }
  const std::string& address() const noexcept { return connection_.address(); }
  Duration request_timeout() const noexcept { return options_.request_timeout; }
  PConnector::Counters counters() const noexcept;

 private:
  StreamClient(Goal goal, PConnectorOptions options, ClientCredentials credentials);

  enum class LookUp : bool { no, yes };  // whether host names may be looked up, which may wait

  // --- connection
  // Set up, and no answer to Subscribe or StartPublishing is due.
  bool is_up() const noexcept;
  void advance(LookUp look_up);
  Result<void> start_connecting(LookUp look_up);
  void check_up();
  void on_disconnected(Error error);
  void forget_connection();
  Result<void> wait_until_up(MonoTime deadline);
  bool has_failed_since(std::uint64_t failed_before) const noexcept;
  Error unavailable_error(const std::string& reason) const;
  std::string what(const char* verb) const;
  MonoTime next_step() const noexcept;

  // --- bytes
  Result<void> send_all();
  bool has_more_to_send() const noexcept;
  bool receive();
  bool may_wait_in_receive() const noexcept;
  wire::IoStatus receive_waiting();
  wire::IoStatus receive_spinning();
  wire::IoStatus on_received(const Result<wire::IoStatus>& received);
  template <class Done>
  WaitStatus run(MonoTime deadline, bool interruptible, Done done);

  // --- protocol steps
  Result<void> on_frame(net::Frame& frame) override;
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  void send(const net::Frame& frame) override { connection_.queue(frame); }
  Result<void> on_opened(StreamInfo stream, bool created) override;
  Result<void> on_subscribed_untrusted(Tid first, bool newest_first, Tid oldest,
                                       Tid newest) override;
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count) override;
  Result<void> on_published_untrusted(std::int64_t last, Tid last_tid, bool begins) override;
  Result<void> on_refused(channel::ChannelClient::Request request, const Error& why) override;
  Result<void> on_ended(const Error& why) override { return why; }
  Result<void> on_other_frame(net::Frame& frame) override;
  // Sends what queue(serial) queues, again after each reconnect, until it is answered.
  template <class Queue>
  Result<void> exchange(Queue queue);
  void request_subscription();
  void start_publishing();
  Error size_error(const char* verb, std::size_t bytes) const;
  Result<ReadStatus> take_next(std::span<std::byte> payload, SampleInfo& info);

  struct Host {
    std::optional<wire::Address> name;
    std::vector<wire::SocketAddress> addresses;  // from the last look-up
  };
  // This connection's set-up.
  struct Setup {
    bool was_up = false;
    MonoTime deadline = kNever;
  };
  // Attempts to set up a connection.
  struct Attempts {
    std::optional<Error> last_error;
    std::uint64_t failed = 0, succeeded = 0;
  };
  struct Restart {
    std::uint64_t count = 0;
    bool pending = false;  // not yet reported by read()
  };
  // The request that a call waits for.
  struct PendingRequest {
    std::uint64_t serial = 0;  // 0: none is in progress on this connection
    bool answered = false;     // by a frame or by a sample
    net::Frame answer;
    std::byte* target = nullptr;     // where a sample's payload goes
    std::optional<SampleInfo> info;  // of the sample that arrived there
    bool torn = false;
  };
  struct Publishing {
    std::uint64_t publisher = 0;  // random id
    bool started = false;         // by the program
    bool allowed = false;         // samples may be sent on this connection
    unsigned posts_since_receive = 0;
  };

  const Goal goal_;
  const PConnectorOptions options_;
  const int owner_pid_;  // a forked child must not use our connection
  Host host_;
  NetworkConnection connection_;
  Setup setup_;
  Attempts attempts_;
  StreamInfo stream_;
  Restart restart_;
  channel::ChannelClient channel_{*this};
  PendingRequest request_;
  std::optional<Error> subscription_refused_;
  bool sample_waits_ = false;               // in the input buffer, until it has a place
  std::unique_ptr<Subscriber> subscriber_;  // both made when the payload's size is known
  std::unique_ptr<Outbox> outbox_;
  Publishing publishing_;
};

}  // namespace dssm::detail
