// SPDX-License-Identifier: Apache-2.0
//
// A program's channel: one connection to the dssmd that owns a stream, kept up from within the
// calls. This is what is behind a PConnector.
//
// A connection is set up by greeting, Open or Create, and what had been going on when the last one
// broke: Subscribe from the sample that is due, StartPublishing and all that is not acknowledged.
// While it is down, each call tries again as soon as the pause since the last attempt is over;
// calls that may wait do so until their deadline, the others (next(), post()) take what steps can
// be taken at once.
#pragma once

#include <dssm/pconnector.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>

#include "client/src/network_connection.hpp"
#include "client/src/outbox.hpp"
#include "client/src/read_request.hpp"
#include "client/src/readiness.hpp"
#include "client/src/subscriber.hpp"

namespace dssm::detail {

// A resource with one owner; one thread at a time.
class Channel final : private wire::FrameDelegate {
 public:
  // Which stream, and what it is created as where it shall be created.
  struct Goal {
    StreamId id;
    std::optional<TypeInfo> type = {};
    History history = {};
  };

  // Connects and opens or creates. One attempt, at each of the host's addresses.
  static Result<std::unique_ptr<Channel>> open(Goal goal, PConnectorOptions options);
  Channel(const Channel&) = delete;
  Channel& operator=(const Channel&) = delete;
  ~Channel();

  // --- requests, which wait for their answer

  // The answer to `request`; a Failure comes as its error.
  //   fails  besides: unavailable, protocol, and what opening the channel anew fails with
  Result<net::Frame> ask(net::Frame request);
  // The same for Read, whose answer is a sample or NoSample.
  Result<ReadStatus> read(const ReadRequest& request, std::span<std::byte> payload,
                          SampleInfo& info);

  // --- as PConnector

  Result<void> subscribe(const Subscription& what);
  Result<void> unsubscribe();
  Result<ReadStatus> next(std::span<std::byte> payload, SampleInfo& info);
  WaitStatus wait(MonoTime deadline);
  std::uint64_t lost() const noexcept { return subscriber_->lost(); }
  std::uint64_t restarts() const noexcept { return restarts_; }
  int fd() noexcept;

  Result<void> post(std::span<const std::byte> payload, Time time, Duration clock_error);
  Result<Tid> flush(MonoTime deadline);
  std::uint64_t dropped() const noexcept { return outbox_->dropped(); }

  const StreamInfo& stream() const noexcept { return stream_; }
  bool is_connected() const noexcept { return was_up_; }
  const std::string& address() const noexcept { return link_.address(); }
  Duration request_timeout() const noexcept { return options_.request_timeout; }
  PConnector::Counters counters() const noexcept;

 private:
  Channel(Goal goal, PConnectorOptions options);

  enum class Patience : bool { none, some };  // some: may look names up

  // Set up, and no answer about subscription or publishing is due.
  bool is_up() const noexcept;

  void advance(Patience patience);
  Result<void> begin_connecting(Patience patience);
  void set_up();
  void note_up();
  void went_down(Error why);
  void forget_connection();
  Result<void> send_all();
  bool receive();
  bool may_wait_in_receive() const noexcept;
  wire::IoStatus receive_waiting();
  wire::IoStatus receive_watching();
  wire::IoStatus on_received(const Result<wire::IoStatus>& received);
  template <class Done>
  WaitStatus run(MonoTime deadline, bool interruptible, Done done);
  // Waits until the channel is up.
  Result<void> get_up(MonoTime deadline);
  // Sends what queue(serial) queues, again after each reconnect, until it is answered.
  template <class Queue>
  Result<void> exchange(Queue queue);
  bool is_hopeless_since(std::uint64_t failed_before) const noexcept;
  Error away(const std::string& how) const;
  std::string what(const char* verb) const;
  MonoTime next_step() const noexcept;

  void request_subscription();
  void start_publishing();
  bool has_more_to_send() const noexcept;
  Result<ReadStatus> take_next(std::span<std::byte> payload, SampleInfo& info);

  Result<void> on_frame(net::Frame& frame) override;
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  Result<void> on_event(const net::Frame& frame);
  Result<void> on_opened(const net::Frame& frame);

  const Goal goal_;
  const PConnectorOptions options_;
  const int owner_pid_;  // a forked child must not speak on our connection
  std::optional<wire::Address> host_;
  std::vector<wire::SocketAddress> addresses_;  // of the host, when looked up last

  NetworkConnection link_;
  bool set_up_sent_ = false;  // on this connection
  bool opened_ = false;       // on this connection
  bool was_up_ = false;       // this connection
  bool useful_ = false;       // it brought something
  MonoTime set_up_deadline_ = kNever;
  MonoTime retry_at_ = MonoTime::min();
  Duration pause_{};
  std::optional<Error> why_down_;
  std::uint64_t failed_attempts_ = 0;  // to set up a connection
  std::uint64_t connections_ = 0;      // that were up

  StreamInfo stream_;
  std::uint64_t restarts_ = 0;
  bool restart_untold_ = false;  // to those who read by request

  std::uint64_t next_serial_ = 1;
  // Of what is under way on this connection; 0: nothing.
  std::uint64_t open_serial_ = 0, subscribe_serial_ = 0, publishing_serial_ = 0, ask_serial_ = 0;
  bool answered_ = false;  // the request of ask_serial_, by a frame or by a sample
  net::Frame answer_;
  std::byte* read_target_ = nullptr;
  std::optional<SampleInfo> read_info_;  // of the sample that came into read_target_
  bool read_torn_ = false;
  std::optional<Error> subscription_refused_;

  bool held_ = false;                       // a sample waits in the input buffer
  std::unique_ptr<Subscriber> subscriber_;  // made when the stream's size is known, as is outbox_
  std::unique_ptr<Outbox> outbox_;
  bool publishes_ = false;    // this channel ever did
  bool may_publish_ = false;  // on this connection
  unsigned posts_since_receive_ = 0;
  const std::uint64_t publisher_;
  std::optional<Readiness> readiness_;
};

}  // namespace dssm::detail
