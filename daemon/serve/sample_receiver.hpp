// SPDX-License-Identifier: Apache-2.0
//
// The server end of a remote writer: takes the samples that a client publishes on its channel,
// writes each of them once into the stream's ring, and acknowledges them.
//
// A payload is received into memory of dssmd, not into the ring: a slot may be filled only under
// the lock of the stream's writers, and they must not wait for the network. For the same reason
// dssmd does not wait for a program that holds that lock: while it does, the link is paused, so
// that the client's samples wait on its side.
#pragma once

#include <dssm/result.hpp>
#include <memory>

#include "daemon/base/event_loop.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/serve/served_stream.hpp"

namespace dssm::daemon {

class SampleReceiver {
 public:
  // How long to leave a lock alone that a program holds: at first, and at most after doubling it.
  static constexpr Duration kFirstRetry = std::chrono::milliseconds(1);
  static constexpr Duration kMaxRetryPause = std::chrono::milliseconds(16);

  // Begins to publish for `publisher`. All outlive it.
  //   fails  limit_exceeded (no memory of `budget` is left for one payload), os errors
  static Result<std::unique_ptr<SampleReceiver>> open(const EventLoop& loop, FrameConnection& link,
                                                      MemoryBudget& budget, ServedStream& stream,
                                                      std::uint64_t publisher);
  SampleReceiver(const SampleReceiver&) = delete;
  SampleReceiver& operator=(const SampleReceiver&) = delete;

  // Where the publisher stopped.
  ring::PublisherCursors::Last last() const noexcept {
    return writer_->publishers().last_untrusted(publisher_);
  }

  // As SampleDelegate.
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out);
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn);

  // All that had arrived was handed out, or the link takes more again: acknowledges what is not
  // yet.
  void acknowledge();

  // Whether a sample waits for the ring's lock; the link is paused then, and stays so.
  bool busy() const noexcept { return waiting_; }

 private:
  SampleReceiver(const EventLoop& loop, FrameConnection& link, MemoryShare share,
                 ServedStream& stream, std::shared_ptr<OwnWriter> writer, std::uint64_t publisher);
  bool is_done_with(const wire::IncomingSample& sample);
  void note_done();
  void write();
  void try_again();
  void answer(std::uint64_t serial);

  FrameConnection& link_;
  MemoryShare share_;
  ServedStream& stream_;
  std::shared_ptr<OwnWriter> writer_;
  std::uint64_t publisher_;
  RawBytes payload_;
  wire::IncomingSample sample_;  // the one in payload_
  bool dropping_ = false;        // the sample under way is written already
  bool waiting_ = false;
  bool unacknowledged_ = false;
  bool written_ = false;  // since the feed was notified last
  Duration retry_ = kFirstRetry;
  EventSource retry_timer_;
};

}  // namespace dssm::daemon
