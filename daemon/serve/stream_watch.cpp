// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/stream_watch.hpp"

#include "core/wire/messages.hpp"
#include "daemon/streams/description.hpp"

namespace dssm::daemon {

StreamWatch::StreamWatch(const Registry& registry, const OpenTable& opens, FrameConnection& link,
                         std::uint64_t serial)
    : opens_(opens),
      link_(link),
      serial_(serial),
      pending_(registry.streams().begin(), registry.streams().end()) {}

bool StreamWatch::work() {
  for (int sent = 0; !pending_.empty() && link_.output_empty(); ++sent) {
    if (sent == kStreamsPerTurn) return true;
    const std::shared_ptr<const Stream> stream = pending_.front().lock();
    pending_.pop_front();
    if (stream && !stream->removed()) send_added(*stream);
  }
  if (!pending_.empty() || serial_ == 0) return false;
  net::Frame done;
  done.set_serial(serial_);
  done.mutable_done();
  serial_ = 0;
  link_.send(done);
  return false;
}

void StreamWatch::send_added(const Stream& stream) {
  net::Frame frame;
  describe(stream, opens_, *frame.mutable_stream_event()->mutable_stream());
  link_.send(frame);
}

void StreamWatch::on_stream_added(const Stream& stream) {
  if (pending_.empty()) {
    send_added(stream);
  } else {
    pending_.push_back(stream.weak_from_this());
  }
}

// Also for one whose addition was not sent yet: a receiver ignores the removal of an unknown
// stream.
void StreamWatch::on_stream_removed(const Stream& stream) {
  net::Frame frame;
  proto::StreamEvent& event = *frame.mutable_stream_event();
  event.set_removed(true);
  wire::to_message(stream.id(), *event.mutable_stream()->mutable_id());
  event.mutable_stream()->set_incarnation(stream.incarnation());
  link_.send(frame);
}

}  // namespace dssm::daemon
