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
#include <optional>
#include <vector>

#include "core/wire/frame_decoder.hpp"
#include "core/wire/transport.hpp"
#include "daemon/service/event_loop.hpp"

namespace dssm::daemon {

class FrameLink final : private wire::FrameSink {
 public:
  // Who works with the link. An error returned from a handler closes the link with last words.
  // Handlers may send on the link and close it, but not destroy it.
  class User {
   public:
    virtual Result<void> on_frame(net::Frame& frame) = 0;
    // As wire::FrameSink. Without set_payload_bytes() there are none.
    virtual Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) = 0;
    virtual Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) = 0;
    // All that had arrived is handed out: time to wake readers, to acknowledge.
    virtual void on_batch_end() {}
    // Nothing waits to be sent any more: samples may follow.
    virtual void on_output_empty() {}
    // The link ended by itself or by an error; called once, last of all, from the loop and never
    // from within a call of the user's own. Destroy the link later, not here.
    virtual void on_closed(const Error& why) = 0;

   protected:
    ~User() = default;
  };

  // user and loop outlive the link.
  FrameLink(const EventLoop& loop, std::unique_ptr<wire::Transport> transport, User& user,
            std::size_t max_queued_bytes);
  FrameLink(const FrameLink&) = delete;
  FrameLink& operator=(const FrameLink&) = delete;
  ~FrameLink();

  // Size of the samples that this link may receive; see FrameDecoder.
  void set_payload_bytes(std::size_t payload_bytes) noexcept;

  // Sends a frame, or queues what does not go at once. After the link closed: nothing happens.
  void send(const net::Frame& frame);

  // --- for SamplePump -------------------------------------------------------------------------

  // Whether nothing waits to be sent: only then send_now() may be used.
  bool output_empty() const noexcept;
  // Sends without queueing; 0 bytes when the socket is full or the link is closed. Whoever sent a
  // part of a frame queues the rest at once.
  std::size_t send_now(std::span<const iovec> parts, bool more);
  // Queues bytes that complete a frame that send_now() began; not counted against
  // max_queued_bytes. on_output_empty() comes when they are gone.
  void queue_rest(std::vector<std::byte> bytes);
  // Asks for on_output_empty() when the socket takes bytes again, after send_now() took none.
  void want_output();

  // --- the rest -------------------------------------------------------------------------------

  // Stops receiving until resume(): what the peer sends waits in the kernel, and slows it down.
  void pause();
  void resume();

  // Closes with last words for the peer (a Failure with serial 0), as far as they go out at once.
  // on_closed() follows from the loop.
  void close_with(const Error& why);
  bool is_open() const noexcept { return !closed_; }

  // For heartbeats: when something arrived last.
  MonoTime last_heard() const noexcept { return last_heard_; }
  const wire::DecoderCounters& counters() const noexcept { return decoder_.counters(); }

 private:
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  Result<void> on_frame(net::Frame& frame) override;

  std::unique_ptr<wire::Transport> transport_;
  User& user_;
  std::size_t max_queued_bytes_;
  wire::FrameDecoder decoder_;
  bool closed_ = false;
  MonoTime last_heard_ = MonoClock::now();
};

}  // namespace dssm::daemon
