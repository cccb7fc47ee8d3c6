// SPDX-License-Identifier: Apache-2.0
//
// A program's connection to the network port of a dssmd: connects, greets, sends frames, and splits
// what arrives into frames, whose meaning it does not know. It never waits by itself: its owner
// polls fd() for events() until next_step(), then calls advance() and receive(). Which address is
// tried next, and how long the pauses are, is ConnectPlan's.
//
// Any failure closes the connection and is returned; from next_step() on, start() connects again.
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "client/src/credentials.hpp"
#include "client/src/spin_budget.hpp"
#include "core/base/unique_fd.hpp"
#include "core/channel/connect_plan.hpp"
#include "core/wire/address.hpp"
#include "core/wire/frame_decoder.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/tls.hpp"
#include "core/wire/transport.hpp"

namespace dssm::detail {

// A resource with one owner; one thread.
class NetworkConnection final : private wire::FrameDelegate {
 public:
  // What arrives after the greeting goes to `delegate`, during receive() and resume(). The greeting
  // may take `greeting_timeout`.
  NetworkConnection(wire::FrameDelegate& delegate, std::string program, Duration greeting_timeout,
                    ClientCredentials credentials);
  NetworkConnection(const NetworkConnection&) = delete;
  NetworkConnection& operator=(const NetworkConnection&) = delete;

  // Begins to connect to one of `addresses` (at least one), tried in turn; only while it is down.
  //   fails  they were not found, or connecting to each failed at once
  Result<void> start(Result<std::vector<wire::SocketAddress>> addresses);
  void close();
  // start() may be called at once.
  void end_pause() noexcept { step_at_ = MonoTime::min(); }
  // The other side did what it was connected for: the next pause is short.
  void mark_useful() noexcept { plan_.reset_pause(); }

  bool is_down() const noexcept { return phase_ == Phase::down; }
  bool is_up() const noexcept { return phase_ == Phase::up; }

  // Takes the steps of connecting and greeting that need no waiting.
  //   fails  when no address is left (the last one's error), or the greeting failed
  Result<void> advance();
  // The error of a caller that stops waiting: which answer is missing.
  Error no_answer_error() const;

  // --- once up

  // Queues a frame, for send_queued().
  void queue(const net::Frame& frame);
  void queue(std::span<const std::byte> encoded);
  bool has_queued() const noexcept {
    return queued_from_ < queued_.size() || (transport_ && transport_->has_unsent_output());
  }
  Result<void> send_queued();
  // Sends bytes directly; returns how many. Nothing may be queued.
  Result<std::size_t> send_some(std::span<const std::byte> bytes);

  // Receives once. Not while a sample is held back.
  //   returns  ok | would_block (nothing was there)
  //   fails    besides: what `delegate` returned
  Result<wire::IoStatus> receive();
  // The same, waiting as Transport::receive_waiting() does.
  //   returns  besides: interrupted
  Result<wire::IoStatus> receive_waiting();
  // The same, after a spin where that pays (spin_budget.hpp), which a signal does not interrupt.
  Result<wire::IoStatus> receive_spinning();
  // Continues with what was received, after the delegate held a sample back.
  Result<void> resume();

  void set_payload_bytes(std::size_t bytes) noexcept { decoder_->set_payload_bytes(bytes); }
  wire::FrameDecoder& decoder() noexcept { return *decoder_; }

  // Of this connection and all before it.
  wire::DecoderCounters counters() const noexcept;

  // Whether receive() has something at once that fd() does not show: to be checked before waiting.
  bool has_buffered_input() const noexcept {
    return transport_ && transport_->has_buffered_input();
  }
  // Who the other side is, by its certificate; nullptr: it is not encrypted, or down.
  const wire::CertifiedPeer* peer() const noexcept {
    return transport_ ? transport_->peer() : nullptr;
  }
  // Whether there is something to receive. To be checked before a timeout is declared: after a
  // stall of this program, the answer may have arrived long ago.
  bool has_arrived() const noexcept;

  // --- waiting

  int fd() const noexcept;  // -1 while down
  short events(bool more_to_send) const noexcept;
  // When advance() has to be called at the latest; while it is down: when start() may be called.
  MonoTime next_step() const noexcept { return step_at_; }

  // One descriptor for poll() and event libraries that covers this connection across reconnects:
  // readable when its socket is ready for events(more_to_send), or at the time `at`. Owned by this
  // object; fd(), when none can be made.
  int ready_fd(bool more_to_send, MonoTime at) noexcept;

  // "10.0.0.2:13776": what it is connected to, or tried last; empty before the first start().
  const std::string& address() const noexcept { return address_; }

 private:
  enum class Phase : unsigned char { down, connecting, securing, greeting, up };

  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  Result<void> on_frame(net::Frame& frame) override;
  Result<void> connect();
  Result<void> connect_next(Error why);
  Result<void> begin();
  Result<void> secure();
  Result<void> greet(std::unique_ptr<wire::Transport> transport);
  Result<wire::IoStatus> on_received(const Result<wire::IoResult>& received);
  bool make_epoll() noexcept;
  Error fail(Error why);
  Error closed_error() const;

  wire::FrameDelegate& delegate_;
  const std::string program_;
  const Duration greeting_timeout_;
  const std::uint64_t instance_id_;

  Phase phase_ = Phase::down;
  MonoTime step_at_ = MonoTime::min();
  channel::ConnectPlan plan_;
  std::string address_;
  ClientCredentials credentials_;
  wire::TlsTicket ticket_;
  UniqueFd connecting_;
  std::optional<wire::TlsHandshake> handshake_;
  std::unique_ptr<wire::Transport> transport_;
  std::unique_ptr<wire::FrameDecoder> decoder_;
  wire::DecoderCounters earlier_;
  SpinBudget spin_budget_;
  std::string queued_;
  std::size_t queued_from_ = 0;
  UniqueFd epoll_, timer_;  // of ready_fd(); made when it is first called
};

}  // namespace dssm::detail
