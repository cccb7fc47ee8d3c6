// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/sample_receiver.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <optional>
#include <utility>

#include "core/base/try.hpp"

namespace dssm::daemon {

Result<std::unique_ptr<SampleReceiver>> SampleReceiver::open(const EventLoop& loop,
                                                             FrameConnection& link,
                                                             MemoryBudget& budget,
                                                             ServedStream& stream,
                                                             std::uint64_t publisher) {
  const std::uint64_t payload_bytes = stream.stream().type().payload_bytes;
  std::optional<MemoryShare> share = budget.try_take(payload_bytes);
  if (!share) {
    return Error{Errc::limit_exceeded,
                 fmt::format("publish into '{}': no memory is left for a sample of {} bytes: {} "
                             "are used up; close other connections or raise that key",
                             stream.stream().id().str(), payload_bytes, peer_memory(budget))};
  }
  std::shared_ptr<OwnWriter> writer = DSSM_TRY(stream.writer());
  return std::unique_ptr<SampleReceiver>(
      new SampleReceiver(loop, link, *std::move(share), stream, std::move(writer), publisher));
}

SampleReceiver::SampleReceiver(const EventLoop& loop, FrameConnection& link, MemoryShare share,
                               ServedStream& stream, std::shared_ptr<OwnWriter> writer,
                               std::uint64_t publisher)
    : link_(link),
      share_(std::move(share)),
      stream_(stream),
      writer_(std::move(writer)),
      publisher_(publisher),
      payload_(stream.stream().type().payload_bytes),
      retry_timer_(EventSource::timer(loop, [this] { try_again(); })) {}

Result<void> SampleReceiver::on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) {
  dropping_ = is_done_with(sample);
  out = dropping_ ? nullptr : payload_.data();
  return {};
}

// Samples of a stream that was removed are dropped too: no reader can find them.
bool SampleReceiver::is_done_with(const wire::IncomingSample& sample) {
  return sample.info.tid <= last().number || stream_.stream().removed();
}

Result<void> SampleReceiver::on_sample_end(const wire::IncomingSample& sample, bool torn) {
  sample_ = sample;
  if (dropping_ || torn) {
    note_done();
  } else {
    write();
  }
  return {};
}

void SampleReceiver::note_done() {
  if (sample_.serial != 0) {
    answer(sample_.serial);
  } else {
    unacknowledged_ = true;
  }
}

void SampleReceiver::write() {
  // The publisher may have come back on another connection while this one was cut in the middle of
  // the sample, and have sent it there, and more.
  if (is_done_with(sample_)) return note_done();
  const Tid tid = writer_->writer().try_publish(
      {publisher_, sample_.info.tid},
      std::as_const(payload_).span().first(sample_.info.payload_bytes), sample_.info.time,
      sample_.info.clock_error);
  if (tid == kNoTid) {
    waiting_ = true;
    link_.pause();
    retry_timer_.enable_in(retry_);
    retry_ = std::min(2 * retry_, kMaxRetryPause);
    return;
  }
  retry_ = kFirstRetry;
  written_ = true;
  note_done();
}

void SampleReceiver::try_again() {
  waiting_ = false;
  write();
  if (waiting_) return;
  acknowledge();
  link_.resume();
}

void SampleReceiver::answer(std::uint64_t serial) {
  const ring::PublisherCursors::Last written = last();
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_published()->set_last(written.number);
  frame.mutable_published()->set_last_tid(written.tid);
  link_.send(frame);
}

void SampleReceiver::acknowledge() {
  if (std::exchange(written_, false)) stream_.check();
  // One acknowledgement covers all before it: those that would wait for the socket are not
  // sent.
  if (!unacknowledged_ || !link_.output_empty()) return;
  unacknowledged_ = false;
  answer(0);
}

}  // namespace dssm::daemon
