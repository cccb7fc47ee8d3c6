// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/frame_connection.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <new>
#include <optional>
#include <utility>

#include "core/base/time.hpp"
#include "core/wire/frame.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxParts = 16;  // of one send, as Transport takes them

Error closed_by_handler() { return {Errc::closed, "the connection was closed meanwhile"}; }

iovec part_of(std::span<const std::byte> bytes) noexcept {
  return {const_cast<std::byte*>(bytes.data()), bytes.size()};
}

std::size_t total(std::span<const iovec> parts) noexcept {
  std::size_t bytes = 0;
  for (const iovec& part : parts) bytes += part.iov_len;
  return bytes;
}

}  // namespace

FrameConnection::FrameConnection(const EventLoop& loop, std::unique_ptr<wire::Transport> transport,
                                 Observer& observer, std::size_t max_queued_bytes)
    : loop_(loop),
      transport_(std::move(transport)),
      observer_(observer),
      max_queued_bytes_(max_queued_bytes),
      decoder_(*this, wire::kMaxNetworkFrameBytes),
      readable_(EventSource::readable(loop, transport_->fd(),
                                      [this] { guarded([this] { on_readable(); }); })),
      writable_(EventSource::writable(loop, transport_->fd(),
                                      [this] { guarded([this] { on_writable(); }); })),
      next_turn_(EventSource::timer(loop, [this] { guarded([this] { continue_receiving(); }); })),
      output_timer_(EventSource::timer(loop, [this] { on_output_timeout(); })),
      ended_(EventSource::timer(loop, [this] { observer_.on_closed(last_error_); })) {
  readable_.enable();
  continue_soon();  // with what came behind a handshake
}

// An exception that leaves a callback would end dssmd.
template <class Work>
[[gnu::hot]] void FrameConnection::guarded(Work work) {
  try {
    work();
  } catch (const std::bad_alloc&) {
    close(no_memory_left());
  }
}

FrameConnection::~FrameConnection() {
  if (pace_) pace_->forget(this);
}

std::span<const std::byte> FrameConnection::Outgoing::unsent() const noexcept {
  const auto* text = std::get_if<std::string>(&bytes);
  const auto all = text ? std::as_bytes(std::span(*text)) : std::get_if<RawBytes>(&bytes)->span();
  return all.subspan(sent);
}

void FrameConnection::take_samples(std::size_t payload_bytes, SampleDelegate& delegate) noexcept {
  samples_ = &delegate;
  decoder_.set_payload_bytes(payload_bytes);
}

// --- receiving

[[gnu::hot]] void FrameConnection::on_readable() {
  if (!may_receive()) return;
  std::optional<TurnQueue::Work> work;
  if (turn_) work.emplace(*turns_);
  receive();
}

// If not, take_turn() goes on with it.
[[gnu::hot]] bool FrameConnection::may_receive() {
  if (!turn_ || turn_->may_begin(TurnQueue::Reason::event)) return true;
  awaits_turn_ = true;
  readable_.disable();
  return false;
}

// At once: all that wait get their turn before the loop looks at the sockets again.
void FrameConnection::take_turn() {
  if (closed_ || !std::exchange(awaits_turn_, false) || input_.paused) return;
  if (input_.decoder_held) return continue_receiving();
  readable_.enable();
  on_readable();
}

[[gnu::hot]] void FrameConnection::receive() {
  std::size_t received = 0;
  const std::uint64_t samples_before = decoder_.counters().samples;
  Error end;
  bool ended = false;
  for (int receives = 0; receives < kReceivesPerTurn && received < kBytesPerTurn &&
                         decoder_.counters().samples - samples_before < kSamplesPerTurn;
       ++receives) {
    const std::span<const iovec> spaces = decoder_.spaces();
    const std::size_t free_bytes = total(spaces);
    const Result<wire::IoResult> got = transport_->receive(spaces);
    if (got && got->status == wire::IoStatus::would_block) break;
    if (!got || got->status == wire::IoStatus::end) {
      ended = true;
      end = !got ? got.error()
                 : Error{Errc::unavailable, decoder_.at_frame_end()
                                                ? "the other side closed the connection"
                                                : "the other side closed the connection in the "
                                                  "middle of a frame"};
      break;
    }
    last_heard_ = loop_.coarse_now();
    received += got->bytes;
    if (!decode(got->bytes)) return;
    if (input_.paused || input_.decoder_held || got->bytes < free_bytes) break;
    if (decoder_.collected_bytes() > 0) break;  // many may send long frames in the same turn
  }
  if (received > 0 && samples_) samples_->on_batch_end();
  if (ended) return close(end);
  // What TLS answers by itself.
  if (!closed_ && transport_->has_unsent_output()) want_output();
  continue_soon();
}

// Continues with the bytes that were received before a pause, or that the transport holds.
void FrameConnection::continue_receiving() {
  if (closed_ || input_.paused || !may_receive()) return;
  std::optional<TurnQueue::Work> work;
  if (turn_) work.emplace(*turns_);
  if (!decode(0)) return;
  if (samples_) samples_->on_batch_end();
  if (closed_ || input_.paused) return;
  if (input_.decoder_held || !transport_->has_buffered_input()) return receive_more();
  readable_.enable();  // it may have been paused
  on_readable();
}

// In the next turn, if there is something to continue with that the socket does not show.
[[gnu::hot]] void FrameConnection::continue_soon() {
  if (closed_ || input_.paused || !transport_->has_buffered_input()) return;
  next_turn_.enable_in(Duration::zero());
}

// False when the connection closed meanwhile.
[[gnu::hot]] bool FrameConnection::decode(std::size_t bytes) {
  input_.decoder_held = false;
  input_.decoding = true;
  const Result<void> taken = decoder_.commit(bytes);
  input_.decoding = false;
  if (!taken) close_with(taken.error());
  return !closed_ && charge_input();
}

[[gnu::hot]] bool FrameConnection::charge_input() {
  const std::size_t bytes = decoder_.collected_bytes();
  if (!budget_ || bytes == input_.share.bytes()) return true;
  input_.share = {};
  std::optional<MemoryShare> share = budget_->try_take(bytes);
  if (share) {
    input_.share = *std::move(share);
    return true;
  }
  close_with({Errc::limit_exceeded,
              fmt::format("no memory is left to receive a frame of more than {} bytes: {} are "
                          "used up; use fewer connections or raise that key",
                          bytes, peer_memory(*budget_))});
  return false;
}

void FrameConnection::receive_more() {
  if (input_.decoder_held) return next_turn_.enable_in(Duration::zero());
  readable_.enable();
  continue_soon();
}

// When a handler has closed the connection, an error stops the decoder.
[[gnu::hot]] Result<void> FrameConnection::on_sample_begin(const wire::IncomingSample& sample,
                                                           std::byte*& out) {
  if (closed_) return closed_by_handler();
  return samples_->on_sample_begin(sample, out);
}

[[gnu::hot]] Result<void> FrameConnection::on_sample_end(const wire::IncomingSample& sample,
                                                         bool torn) {
  if (closed_) return closed_by_handler();
  return samples_->on_sample_end(sample, torn);
}

Result<void> FrameConnection::on_frame(net::Frame& frame) {
  if (closed_) return closed_by_handler();
  return observer_.on_frame(frame);
}

void FrameConnection::pause() {
  if (closed_ || input_.paused) return;
  input_.paused = true;
  if (input_.decoding) {
    decoder_.hold();
    input_.decoder_held = true;
  }
  readable_.disable();
  next_turn_.disable();
  if (output_.lost) close(last_error_);
}

void FrameConnection::resume() {
  if (closed_ || !input_.paused) return;
  input_.paused = false;
  receive_more();
}

// --- sending

void FrameConnection::send(const net::Frame& frame) {
  if (closed_ || output_.lost) return;
  Outgoing outgoing{wire::encode_frame(frame), 0, true, {}, false};
  const std::size_t bytes = outgoing.unsent().size();
  if (output_.queue.empty() && !output_.mid_frame) {
    const iovec part = part_of(outgoing.unsent());
    outgoing.sent = transmit({&part, 1});
    if (outgoing.sent == bytes || closed_ || output_.lost) return;
  }
  // The final failure cannot be sent in the middle of a frame.
  const auto refuse = [&](const Error& why) {
    output_.mid_frame = output_.mid_frame || outgoing.sent > 0;
    close_with(why);
  };
  if (output_.queued_bytes + bytes > max_queued_bytes_) {
    return refuse({Errc::limit_exceeded,
                   fmt::format("the other side does not read: {} bytes wait for it, and {} more "
                               "would exceed the limit of {}",
                               output_.queued_bytes, bytes, max_queued_bytes_)});
  }
  if (budget_) {
    std::optional<MemoryShare> share = budget_->try_take(bytes);
    if (!share) {
      return refuse({Errc::limit_exceeded,
                     fmt::format("the other side does not read, and no memory is left for {} "
                                 "bytes more: {} are used up; read faster, use fewer connections, "
                                 "or raise that key",
                                 bytes, peer_memory(*budget_))});
    }
    outgoing.share = *std::move(share);
  }
  output_.queued_bytes += bytes;
  enqueue(std::move(outgoing));
}

[[gnu::hot]] std::size_t FrameConnection::send_now(std::span<const iovec> parts) {
  if (closed_ || output_.lost || (!output_.queue.empty() && !output_.mid_frame)) return 0;
  return transmit(parts);
}

void FrameConnection::queue_rest(RawBytes bytes, MemoryShare share) {
  if (closed_ || output_.lost) return;
  Outgoing outgoing{std::move(bytes), 0, false, std::move(share), false};
  if (!output_.mid_frame) return enqueue(std::move(outgoing));
  // The frame that it completes is sent in pieces: before the queue.
  output_.queue.push_front(std::move(outgoing));
  await_output();
}

void FrameConnection::enqueue(Outgoing outgoing) {
  output_.queue.push_back(std::move(outgoing));
  if (!output_.mid_frame) await_output();
}

void FrameConnection::set_mid_frame(bool mid_frame) {
  output_.mid_frame = mid_frame;
  if (!mid_frame && !output_.queue.empty()) want_output();
}

// What the kernel has is not taken yet: on a slow network that may be all that moves for long.
std::uint64_t FrameConnection::taken_bytes() const noexcept {
  const std::optional<wire::Progress> progress = transport_->progress();
  return sent_bytes_ - (progress ? progress->waiting_bytes : 0);
}

void FrameConnection::await_output() {
  writable_.enable();
  output_.awaited = true;
  watch_output();
}

void FrameConnection::watch_output() {
  if (output_timeout_ == Duration::zero() || output_.watched) return;
  output_.watched = true;
  output_.taken_bytes = taken_bytes();
  output_timer_.enable_in(output_timeout_);
}

void FrameConnection::on_output_timeout() {
  output_.watched = false;
  if (output_timeout_ == Duration::zero() || !output_.awaited) return;
  if (taken_bytes() > output_.taken_bytes) return watch_output();
  close_with({Errc::limit_exceeded,
              fmt::format("the other side has read nothing for {} s of what waits for it",
                          output_timeout_ / std::chrono::seconds(1))});
}

void FrameConnection::want_output() {
  if (!closed_ && !output_.lost) await_output();
}

void FrameConnection::on_writable() {
  if (limits_unsent_) {
    const std::optional<wire::Progress> now = transport_->progress();
    const auto left = [](const wire::Progress& progress) {
      return std::pair(progress.unsent_bytes, progress.waiting_bytes);
    };
    if (now && (!when_writable_ || left(*now) < left(*when_writable_))) {
      when_writable_ = now;
    }
  }
  if (!flush_transport()) return;
  if (!output_.mid_frame && !flush()) return;
  if (closed_ || transport_->has_unsent_output()) return;
  writable_.disable();
  output_.awaited = false;
  observer_.on_output_empty();
}

// False: what the transport holds could not all be sent.
bool FrameConnection::flush_transport() {
  const Result<wire::IoStatus> flushed = transport_->flush();
  if (flushed && *flushed != wire::IoStatus::end) return *flushed == wire::IoStatus::ok;
  on_output_end(flushed ? nullptr : &flushed.error());
  return false;
}

// Sends the queue. True when it is empty.
bool FrameConnection::flush() {
  while (!output_.queue.empty()) {
    std::array<iovec, kMaxParts> parts;
    std::size_t count = 0, bytes = 0;
    for (const Outgoing& next : output_.queue) {
      if (count == parts.size()) break;
      parts[count] = part_of(next.unsent());
      bytes += parts[count++].iov_len;
    }
    std::size_t sent = transmit(std::span(parts).first(count));
    if (closed_ || output_.lost) return false;
    const bool all = sent == bytes;
    while (!output_.queue.empty()) {
      Outgoing& next = output_.queue.front();
      const std::size_t step = std::min(sent, next.unsent().size());
      next.sent += step;
      sent -= step;
      if (!next.unsent().empty()) break;
      if (next.counted) output_.queued_bytes -= next.sent;
      output_.queue.pop_front();
    }
    if (!all) return false;
  }
  return true;
}

[[gnu::hot]] std::size_t FrameConnection::transmit(std::span<const iovec> parts) {
  const Result<wire::IoResult> sent = transport_->send(parts);
  if (sent && sent->status != wire::IoStatus::end) {
    sent_bytes_ += sent->bytes;
    if (pace_) pace_->on_sent(sent->bytes);
    if (transport_->has_unsent_output()) await_output();
    return sent->bytes;
  }
  on_output_end(sent ? nullptr : &sent.error());
  return 0;
}

// why: none when the other side closed the connection.
void FrameConnection::on_output_end(const Error* why) {
  last_error_ = why ? *why : Error{Errc::unavailable, "the other side closed the connection"};
  lose_output();
}

std::size_t FrameConnection::history_allowance() {
  if (!pace_ || closed_) return HistoryPace::kUnlimited;
  const MonoTime now = loop_.now();
  const std::size_t own = share_.allowance(now, pace_->carried_bytes_per_s(now));
  return own == 0 ? 0 : std::min(own, pace_->allowance(now, {this, sent_bytes_, *transport_}));
}

void FrameConnection::on_history_sent(std::uint64_t since_sent_bytes, bool is_full) {
  if (!pace_) return;
  std::uint64_t bytes = sent_bytes_ - since_sent_bytes;
  for (Outgoing& waiting : output_.queue) {
    if (waiting.counted || std::exchange(waiting.is_history, true)) continue;
    bytes += waiting.unsent().size();
  }
  pace_->on_history(bytes);
  share_.on_history(bytes);
  if (is_full) pace_->on_full(this);
}

// The peer may have sent its reason before it closed: that is still to be received, so receiving
// continues until the end of the input.
void FrameConnection::lose_output() {
  output_.lost = true;
  drop_queue();
  output_.queued_bytes = 0;
  writable_.disable();
  output_.awaited = false;
  if (input_.paused) close(last_error_);
}

void FrameConnection::drop_queue() {
  for (const Outgoing& waiting : output_.queue) {
    if (pace_ && waiting.is_history) pace_->on_history_dropped(waiting.unsent().size());
  }
  output_.queue.clear();
}

void FrameConnection::close_with(const Error& why) {
  if (closed_) return;
  try {
    if (!output_.lost && !output_.mid_frame && flush()) {
      const std::string encoded = wire::final_failure(why);
      const iovec part = part_of(std::as_bytes(std::span(encoded)));
      transmit({&part, 1});
    }
  } catch (const std::bad_alloc&) {
    // Then the other side does not get the reason.
  }
  close(why);
}

void FrameConnection::close(Error why) {
  if (closed_) return;
  closed_ = true;
  if (pace_) pace_->forget(this);
  last_error_ = std::move(why);
  readable_.disable();
  writable_.disable();
  next_turn_.disable();
  output_timer_.disable();
  drop_queue();
  input_.share = {};
  transport_.reset();
  ended_.enable_in(Duration::zero());
}

}  // namespace dssm::daemon
