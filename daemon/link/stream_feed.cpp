// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/stream_feed.hpp"

#include <algorithm>
#include <new>
#include <utility>

#include "core/base/try.hpp"
#include "daemon/link/sample_pump.hpp"

namespace dssm::daemon {

Result<std::shared_ptr<StreamFeed>> StreamFeed::open(const EventLoop& loop,
                                                     std::shared_ptr<Stream> stream) {
  auto ring = DSSM_TRY(stream->map_for_writing(), "stream '" + stream->id().str() + "'");
  return std::shared_ptr<StreamFeed>(new StreamFeed(loop, std::move(stream), std::move(ring)));
}

StreamFeed::StreamFeed(const EventLoop& loop, std::shared_ptr<Stream> stream,
                       std::shared_ptr<const ring::RingMapping> ring)
    : loop_(loop),
      stream_(std::move(stream)),
      ring_(std::move(ring)),
      reader_(*ring_),
      poll_soon_(EventSource::timer(loop, [this] { poll(); })) {
  stream_->observe_doorbells(this);
}

StreamFeed::~StreamFeed() {
  stream_->observe_doorbells(nullptr);
  arm(false);
}

void StreamFeed::on_doorbell_added(int fd) {
  EventSource& source = doorbells_[fd];
  source = EventSource::edge(loop_, fd, [this] { poll(); });
  source.enable();
}

// It may have rung just before. Not at once: who removes it may be in the middle of something.
void StreamFeed::on_doorbell_removed(int fd) {
  doorbells_.erase(fd);
  poll_soon_.enable_in(Duration::zero());
}

[[gnu::hot]] void StreamFeed::arm(bool armed) noexcept {
  if (armed == armed_) return;
  armed_ = armed;
  ring_->header().doorbell_armed.store(armed ? 1 : 0, std::memory_order_seq_cst);
}

[[gnu::hot]] bool StreamFeed::wait(Observer& observer, Tid known) {
  std::erase_if(waiting_, [&](const Waiting& waiting) { return waiting.observer == &observer; });
  arm(true);
  if (newest_untrusted(reader_) > known) {
    if (waiting_.empty()) arm(false);
    return false;
  }
  waiting_.push_back({&observer, known});
  return true;
}

[[gnu::hot]] void StreamFeed::forget(Observer& observer) noexcept {
  std::erase_if(waiting_, [&](const Waiting& waiting) { return waiting.observer == &observer; });
  for (Waiting& waiting : notifying_) {
    if (waiting.observer == &observer) waiting.observer = nullptr;
  }
  if (waiting_.empty()) arm(false);
}

[[gnu::hot]] void StreamFeed::poll() {
  poll_again_ = true;
  if (polling_) return;  // an observer wrote to the stream
  polling_ = true;
  while (std::exchange(poll_again_, false) && !waiting_.empty()) {
    // Disarmed, so that the writer does not ring for samples that are sent in this round anyway.
    arm(false);
    std::swap(notifying_, waiting_);  // neither gives its memory back
    for (std::size_t i = 0; i < notifying_.size(); ++i) {
      const Waiting waiting = std::exchange(notifying_[i], {nullptr, kNoTid});
      if (!waiting.observer) continue;
      // An observer that is notified calls wait() again: only for the others it is worth arming.
      bool is_available = newest_untrusted(reader_) > waiting.known;
      try {
        is_available = is_available || !wait(*waiting.observer, waiting.known);
      } catch (const std::bad_alloc&) {
        // It finds no memory either, and ends itself, not the connection whose work this is.
        is_available = true;
      }
      if (is_available) waiting.observer->on_sample_available();
    }
    notifying_.clear();
  }
  polling_ = false;
}

}  // namespace dssm::daemon
