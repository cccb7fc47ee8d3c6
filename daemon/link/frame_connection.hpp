// SPDX-License-Identifier: Apache-2.0
//
// A connection that speaks the network protocol's frames, in dssmd's loop: decodes what arrives,
// queues what the peer does not take at once. Knows nothing of what the frames mean: that is
// DataCommunicator's at the server end, Dialer's users' at the client end.
//
// Bounds: what waits to be sent is at most max_queued_bytes, then the link closes itself (a peer
// that asks and never reads); samples are not queued here but stay in their ring until the peer
// takes them (SamplePump). Whatever goes wrong costs this link only.
#pragma once

#include <cstddef>
#include <deque>
#include <memory>
#include <span>
#include <string>
#include <variant>

#include "core/wire/frame_decoder.hpp"
#include "core/wire/transport.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/link/raw_bytes.hpp"

namespace dssm::daemon {

class FrameConnection final : private wire::FrameDelegate {
 public:
  // Received in a row before others get their turn.
  static constexpr int kReceivesPerTurn = 16;
  static constexpr std::size_t kBytesPerTurn = 1U << 20;

  // Who works with the link. An error returned from a handler closes the link with last words.
  // Handlers may send on the link, pause it and close it, but not destroy it.
  class Observer {
   public:
    virtual Result<void> on_frame(net::Frame& frame) = 0;
    // Nothing waits to be sent any more, or the socket takes bytes again: samples may follow.
    virtual void on_output_empty() {}
    // The link ended by itself or by an error; called once, last of all, from the loop and never
    // from within a call of the observer's own. Destroy the link later, not here.
    virtual void on_closed(const Error& why) = 0;

   protected:
    ~Observer() = default;
  };

  // Who takes samples: not by way of the observer, because each step on a sample's way costs. The same
  // rules as for the observer's handlers.
  class SampleDelegate {
   public:
    // As wire::FrameDelegate. When the link is paused within on_sample_begin(), `out` is not used, and
    // it comes again for the same sample after resume().
    virtual Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) = 0;
    virtual Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) = 0;
    // All that had arrived is handed out: time to wake readers, to acknowledge.
    virtual void on_batch_end() {}

   protected:
    ~SampleDelegate() = default;
  };

  // observer and loop outlive the link.
  FrameConnection(const EventLoop& loop, std::unique_ptr<wire::Transport> transport,
                  Observer& observer, std::size_t max_queued_bytes);
  FrameConnection(const FrameConnection&) = delete;
  FrameConnection& operator=(const FrameConnection&) = delete;
  ~FrameConnection();

  // From now on samples of this size are received, and `sink`, which outlives the link, gets them.
  // Until then one that comes is an error of the peer.
  void take_samples(std::size_t payload_bytes, SampleDelegate& sink) noexcept;

  // What waits to be sent by send(), and a long frame that is being received, are charged to
  // `budget`, which outlives the link; when it is used up, the link closes itself.
  void set_budget(MemoryBudget& budget) noexcept { budget_ = &budget; }

  // Sends a frame, or queues what does not go at once. After the link closed: nothing happens.
  void send(const net::Frame& frame);

  // --- for SamplePump

  // Whether nothing waits to be sent: only then send_now() may be used.
  bool output_empty() const noexcept { return output_.empty(); }
  // Sends without queueing; 0 bytes when the socket is full or the link is closed. Whoever sent a
  // part of a frame queues the rest at once, or says so by set_mid_frame().
  std::size_t send_now(std::span<const iovec> parts);
  // Queues bytes that complete a frame that send_now() began; not counted against
  // max_queued_bytes. `share` of the budget is given back, and on_output_empty() comes, when they
  // are gone.
  void queue_rest(RawBytes bytes, MemoryShare share = {});
  // While true, a frame is sent by several send_now() with other work between them: what send() is
  // given waits behind it, and send_now() may be used although something waits.
  void set_mid_frame(bool mid_frame);
  // Asks for on_output_empty() when the socket takes bytes again, after send_now() took none.
  void want_output();

  // --- the rest

  // Stops handing out and receiving until resume(): what the peer sends waits in the kernel, and
  // slows it down. What the handler that calls this was given is taken (but see on_sample_begin()).
  void pause();
  void resume();
  bool is_paused() const noexcept { return paused_; }

  // Closes with last words for the peer (a Failure with serial 0), as far as they go out at once.
  // on_closed() follows from the loop.
  void close_with(const Error& why);
  bool is_open() const noexcept { return !closed_; }

  // For heartbeats: when something arrived last, to some milliseconds.
  MonoTime last_heard() const noexcept { return last_heard_; }
  const wire::DecoderCounters& counters() const noexcept { return decoder_.counters(); }

 private:
  struct Outgoing {
    std::variant<std::string, RawBytes> bytes;  // a frame; a rest
    std::size_t sent = 0;
    bool counted = false;  // against max_queued_bytes_
    MemoryShare share;

    std::span<const std::byte> unsent() const noexcept;
  };

  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  Result<void> on_frame(net::Frame& frame) override;

  void on_readable();
  void on_writable();
  void go_on();
  bool hand_out(std::size_t bytes);
  bool charge_input();
  void listen_again();
  std::size_t transmit(std::span<const iovec> parts);
  bool flush();
  void enqueue(Outgoing outgoing);
  void lose_output();
  void close(const Error& why);

  const EventLoop& loop_;
  std::unique_ptr<wire::Transport> transport_;
  Observer& observer_;
  SampleDelegate* samples_ = nullptr;
  std::size_t max_queued_bytes_;
  MemoryBudget* budget_ = nullptr;
  wire::FrameDecoder decoder_;
  std::deque<Outgoing> output_;
  std::size_t queued_bytes_ = 0;
  MemoryShare input_share_;
  bool closed_ = false;
  bool output_lost_ = false;  // the peer takes nothing more; what it said last is still to be read
  bool mid_frame_ = false;
  bool paused_ = false;
  bool handing_out_ = false;  // the decoder is at work
  bool held_ = false;         // it was told to stop, and may have more
  Error why_;
  MonoTime last_heard_ = loop_.now();
  EventSource readable_, writable_, next_turn_, ended_;
};

}  // namespace dssm::daemon
