// SPDX-License-Identifier: Apache-2.0
//
// What all channels of one stream share: the feed that notifies of new samples, and the writer.
// They exist only while a channel uses them.
#pragma once

#include <dssm/result.hpp>
#include <map>
#include <memory>

#include "core/ring/bell.hpp"
#include "core/ring/clock_assessment.hpp"
#include "core/ring/publisher_cursors.hpp"
#include "core/ring/ring_writer.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/link/stream_feed.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

// A stream's ring and bell, mapped for writing by dssmd itself.
class OwnWriter {
 public:
  static Result<std::shared_ptr<OwnWriter>> open(const Stream& stream);
  OwnWriter(const OwnWriter&) = delete;
  OwnWriter& operator=(const OwnWriter&) = delete;

  // Without doorbell: the caller notifies the feed of what it writes.
  ring::RingWriter& writer() noexcept { return writer_; }
  ring::PublisherCursors publishers() noexcept {
    return ring::PublisherCursors(mapping_->header());
  }
  void set_clock(const ring::ClockAssessment& assessment) noexcept {
    mapping_->header().clock.store(assessment);
  }

 private:
  OwnWriter(std::shared_ptr<const ring::RingMapping> mapping, std::shared_ptr<ring::Bell> bell);
  std::shared_ptr<const ring::RingMapping> mapping_;
  std::shared_ptr<ring::Bell> bell_;
  ring::RingWriter writer_;
};

class ServedStream {
 public:
  ServedStream(const EventLoop& loop, std::shared_ptr<Stream> stream)
      : loop_(loop), stream_(std::move(stream)) {}
  ServedStream(const ServedStream&) = delete;
  ServedStream& operator=(const ServedStream&) = delete;

  Stream& stream() const noexcept { return *stream_; }

  // Fail with os errors (descriptors or address space run out).
  Result<std::shared_ptr<StreamFeed>> feed();
  Result<std::shared_ptr<OwnWriter>> writer();

  // States in the ring what its times are worth here. From then on it has to be stated again within
  // ClockAssessment::kValidFor, also by the next dssmd. Fails with os errors.
  Result<void> assess(const ring::ClockAssessment& assessment);

  // dssmd wrote to the ring, or a writer may have been killed before it wrote to the doorbell.
  void check();

 private:
  const EventLoop& loop_;
  std::shared_ptr<Stream> stream_;
  std::weak_ptr<StreamFeed> feed_;
  std::weak_ptr<OwnWriter> writer_;
  std::shared_ptr<OwnWriter> assessed_;  // once its times are assessed
};

// By stream. An entry is made by the first channel and stays until the stream is removed.
class ServedStreams {
 public:
  explicit ServedStreams(const EventLoop& loop) : loop_(loop) {}
  ServedStreams(const ServedStreams&) = delete;
  ServedStreams& operator=(const ServedStreams&) = delete;

  std::shared_ptr<ServedStream> get(const std::shared_ptr<Stream>& stream);
  void forget(const Stream& stream) { streams_.erase(&stream); }
  void check_all();

 private:
  const EventLoop& loop_;
  std::map<const Stream*, std::shared_ptr<ServedStream>> streams_;
};

}  // namespace dssm::daemon
