// SPDX-License-Identifier: Apache-2.0
//
// A connection that carries the network protocol's frames, in dssmd's loop: decodes the bytes that
// arrive, queues those that the peer does not take at once. It does not interpret frames: that is
// DataCommunicator's task at the server end, and that of the Dialer's observers at the client end.
//
// Bounds: at most max_queued_bytes wait to be sent, then the connection closes itself (a peer that
// sends requests and never reads). Samples are not queued here: they stay in their ring until the
// peer takes them (SamplePump). An error costs this connection only, and so does a failure to get
// memory for what it receives or sends.
#pragma once

#include <algorithm>
#include <cstddef>
#include <deque>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <variant>

#include "core/wire/frame_decoder.hpp"
#include "core/wire/tcp.hpp"
#include "core/wire/transport.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/base/turn_queue.hpp"
#include "daemon/link/history_pace.hpp"

namespace dssm::daemon {

// Bytes on the heap that are not filled with zeros first: for large ones the system need not even
// provide memory before it is written to. One owner; may be moved.
class RawBytes {
 public:
  RawBytes() = default;
  explicit RawBytes(std::size_t size)
      : bytes_(std::make_unique_for_overwrite<std::byte[]>(size)), size_(size) {}

  // A copy of `bytes`.
  static RawBytes copy_of(std::span<const std::byte> bytes) {
    RawBytes copy(bytes.size());
    std::copy(bytes.begin(), bytes.end(), copy.bytes_.get());
    return copy;
  }

  std::span<std::byte> span() noexcept { return {bytes_.get(), size_}; }
  std::span<const std::byte> span() const noexcept { return {bytes_.get(), size_}; }
  std::byte* data() noexcept { return bytes_.get(); }
  std::size_t size() const noexcept { return size_; }

 private:
  std::unique_ptr<std::byte[]> bytes_;
  std::size_t size_ = 0;
};

class FrameConnection final : private wire::FrameDelegate {
 public:
  // Received in one turn, before other connections get theirs.
  static constexpr int kReceivesPerTurn = 16;
  static constexpr std::size_t kBytesPerTurn = 1U << 20;
  static constexpr std::uint64_t kSamplesPerTurn = 1024;

  // An error returned from a handler closes the connection with a final failure. Handlers may send
  // on the connection, pause it and close it, but not destroy it.
  class Observer {
   public:
    virtual Result<void> on_frame(net::Frame& frame) = 0;
    // The queue is empty, or the socket takes bytes again: samples may follow.
    virtual void on_output_empty() {}
    // The connection has ended, by itself or by an error; called once, as the last handler, from
    // the loop and never from within a call of the observer's own. Destroy the connection later.
    virtual void on_closed(const Error& why) = 0;

   protected:
    ~Observer() = default;
  };

  // Takes samples. Not a part of Observer, because each step of a sample's path costs time. The
  // same rules as for the observer's handlers.
  class SampleDelegate {
   public:
    // As wire::FrameDelegate. When the connection is paused within on_sample_begin(), `out` is not
    // used, and the call is repeated for the same sample after resume().
    virtual Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) = 0;
    virtual Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) = 0;
    // All bytes that have arrived are handled: time to wake readers and to acknowledge.
    virtual void on_batch_end() {}

   protected:
    ~SampleDelegate() = default;
  };

  // observer and loop outlive the connection.
  FrameConnection(const EventLoop& loop, std::unique_ptr<wire::Transport> transport,
                  Observer& observer, std::size_t max_queued_bytes);
  FrameConnection(const FrameConnection&) = delete;
  FrameConnection& operator=(const FrameConnection&) = delete;
  ~FrameConnection();

  // From now on samples of this size are received and go to `delegate`, which outlives the
  // connection. Before, a sample is an error of the peer.
  void take_samples(std::size_t payload_bytes, SampleDelegate& delegate) noexcept;

  // From now on all is received only in this client's turns, of which each calls take_turn(): for
  // those that send samples. Both outlive the connection's use of them.
  void set_turn(TurnQueue::Turn& turn, TurnQueue& turns) noexcept {
    turn_ = &turn;
    turns_ = &turns;
  }
  // Receives, if there was something to receive and it was not this client's turn.
  void take_turn();

  // Frames that wait to be sent, and a long frame that is being received, are charged to `budget`,
  // which outlives the connection; when it is used up, the connection closes itself.
  void set_budget(MemoryBudget& budget) noexcept { budget_ = &budget; }

  // The other end may only send requests and samples (FrameDecoder).
  void take_requests_only() noexcept { decoder_.take_requests_only(); }

  // From now on the connection closes itself when the peer takes nothing of what waits for it for
  // `timeout`, and at most twice as long. Zero: TCP decides (30 s, core/wire/tcp.hpp).
  void set_output_timeout(Duration timeout) noexcept { output_timeout_ = timeout; }

  // What is sent counts there, and history follows it; it outlives the connection. Without it,
  // history is sent as fast as the connection takes it.
  void set_pace(HistoryPace& pace) noexcept { pace_ = &pace; }
  // Of what the network carries, this much at most is this connection's history.
  void set_history_share(double share) noexcept { share_.set(share); }
  // As wire::Transport.
  void set_priority(wire::Priority priority) noexcept {
    if (!closed_) transport_->set_priority(priority);
  }

  // Sends a frame, or queues the bytes that the socket does not take. Nothing after the end.
  void send(const net::Frame& frame);

  // --- for SamplePump

  // Whether nothing waits to be sent: only then send_now() may be used.
  bool output_empty() const noexcept { return output_.queue.empty(); }
  // Sends without queueing; returns the bytes sent, 0 when the socket is full or the connection is
  // closed. A caller that sent a part of a frame queues the rest at once, or calls set_mid_frame().
  std::size_t send_now(std::span<const iovec> parts);
  // Queues bytes that complete a frame that send_now() began; not counted against
  // max_queued_bytes. When they are sent, `share` of the budget is released and on_output_empty()
  // follows.
  void queue_rest(RawBytes bytes, MemoryShare share = {});
  // While true, a frame is sent by several send_now() with other work between them: the frames of
  // send() wait after it, and send_now() may be used although the queue is not empty.
  void set_mid_frame(bool mid_frame);
  // Asks for on_output_empty() when the socket takes bytes again, after send_now() took none.
  void want_output();

  // How many bytes of history may be sent now. 0: none before history_due().
  std::size_t history_allowance();
  MonoTime history_due() const noexcept {
    return pace_ ? std::max(pace_->due(), share_.due()) : MonoTime();
  }
  // What was sent or queued (queue_rest()) since so many bytes had been sent is history.
  //   is_full  the socket took less than history_allowance()
  void on_history_sent(std::uint64_t since_sent_bytes, bool is_full);
  std::uint64_t sent_bytes() const noexcept { return sent_bytes_; }

  // --- flow and end

  // Stops receiving and handling frames until resume(): what the peer sends waits in the kernel and
  // slows the peer down. The frame whose handler calls this counts as handled (but see
  // on_sample_begin()).
  void pause();
  void resume();
  bool is_paused() const noexcept { return input_.paused; }

  // The peer does not answer: its end gives up what waits for it.
  void discard_output_at_close() noexcept {
    if (!closed_) wire::discard_output_at_close(transport_->fd());
  }
  // Closes with a final failure for the peer (a Failure with serial 0), as far as the socket takes
  // it at once. on_closed() follows from the loop.
  void close_with(const Error& why);
  bool is_open() const noexcept { return !closed_; }

  // When bytes arrived last, to some milliseconds; for heartbeats.
  MonoTime last_heard() const noexcept { return last_heard_; }
  // As wire::Transport. While a frame is handled, arrived() is never before the frame was sent.
  void stamp_arrivals() noexcept {
    if (!closed_) transport_->stamp_arrivals();
  }
  std::optional<Time> arrived() const noexcept {
    return closed_ ? std::nullopt : transport_->arrived();
  }
  // As wire::Transport. Unless it is 0, progress_when_writable() says how the connection was when
  // it took bytes again, before it got some: of several times since the last call, when least
  // waited.
  void limit_unsent(std::size_t bytes) noexcept {
    if (!closed_) transport_->limit_unsent(bytes);
    limits_unsent_ = bytes > 0;
  }
  std::optional<wire::Progress> progress_when_writable() noexcept {
    return std::exchange(when_writable_, std::nullopt);
  }
  std::optional<wire::Progress> progress() const noexcept {
    return closed_ ? std::nullopt : transport_->progress();
  }
  const wire::DecoderCounters& counters() const noexcept { return decoder_.counters(); }
  // As wire::Transport; none after the end.
  const wire::CertifiedPeer* peer() const noexcept {
    return closed_ ? nullptr : transport_->peer();
  }

 private:
  struct Outgoing {
    std::variant<std::string, RawBytes> bytes;  // a frame; the rest of one
    std::size_t sent = 0;
    bool counted = false;  // against max_queued_bytes_
    MemoryShare share;
    bool is_history = false;  // on_history_sent() has counted it

    std::span<const std::byte> unsent() const noexcept;
  };
  struct Input {
    MemoryShare share;  // of a long frame that is being received
    bool paused = false;
    bool decoding = false;
    bool decoder_held = false;  // pause() stopped the decoder, which may have more bytes
  };
  struct Output {
    std::deque<Outgoing> queue;
    std::size_t queued_bytes = 0;
    bool mid_frame = false;
    bool lost = false;     // the peer takes no more bytes; what it has sent is still to be received
    bool awaited = false;  // something waits until the socket takes bytes again
    bool watched = false;  // on_output_timeout() will come; then more should have been taken than:
    std::uint64_t taken_bytes = 0;
  };

  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  Result<void> on_frame(net::Frame& frame) override;

  template <class Work>
  void guarded(Work work);
  void on_readable();
  bool may_receive();
  void receive();
  void on_writable();
  void continue_receiving();
  void continue_soon();
  bool decode(std::size_t bytes);
  bool charge_input();
  void receive_more();
  std::size_t transmit(std::span<const iovec> parts);
  bool flush_transport();
  bool flush();
  void await_output();
  std::uint64_t taken_bytes() const noexcept;
  void watch_output();
  void on_output_timeout();
  void on_output_end(const Error* why);
  void enqueue(Outgoing outgoing);
  void lose_output();
  void drop_queue();
  void close(Error why);

  const EventLoop& loop_;
  std::unique_ptr<wire::Transport> transport_;
  Observer& observer_;
  SampleDelegate* samples_ = nullptr;
  const std::size_t max_queued_bytes_;
  MemoryBudget* budget_ = nullptr;
  HistoryPace* pace_ = nullptr;
  HistoryShare share_;
  Duration output_timeout_{};
  std::uint64_t sent_bytes_ = 0;
  TurnQueue::Turn* turn_ = nullptr;
  TurnQueue* turns_ = nullptr;
  bool awaits_turn_ = false;  // to receive
  bool limits_unsent_ = false;
  std::optional<wire::Progress> when_writable_;
  wire::FrameDecoder decoder_;
  Output output_;
  Input input_;
  bool closed_ = false;
  Error last_error_;
  MonoTime last_heard_ = loop_.now();
  EventSource readable_, writable_, next_turn_, output_timer_, ended_;
};

}  // namespace dssm::daemon
