// SPDX-License-Identifier: Apache-2.0
#include "client/src/subscriber.hpp"

#include <utility>

#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

// Of samples that arrive while the program waits for an answer, which takes a round trip. Samples
// beyond it count as lost.
constexpr std::size_t kMaxBufferedBytes = 16U << 20;

}  // namespace

Subscriber::Subscriber(std::size_t payload_bytes) : queue_(payload_bytes, kMaxBufferedBytes) {}

void Subscriber::begin(const Subscription& what) {
  end();
  what_ = what;
  cursor_.set_thinned(what.max_rate_hz > 0);
}

void Subscriber::end() {
  what_.reset();
  live_ = false;
  cursor_.set_next(kNoTid);
  if (arriving_ != Arriving::nothing) arriving_ = Arriving::nowhere;
  target_ = nullptr;
  delivered_.reset();
  queue_.clear();
  restart_at_.reset();
}

void Subscriber::to_message(std::uint64_t incarnation, net::Subscribe& out) const {
  out.set_max_rate_hz(what_->max_rate_hz);
  if (granted()) return cursor_.resume(incarnation, out);
  switch (what_->start) {
    case Subscription::Start::now:
      out.set_from_now(true);
      break;
    case Subscription::Start::oldest:
      out.set_from_oldest(true);
      break;
    case Subscription::Start::tid:
      out.set_from_tid(what_->tid);
      out.set_incarnation(incarnation);
      break;
    case Subscription::Start::time:
      out.set_from_time_ns(to_ns(what_->time));
      break;
  }
}

Result<void> Subscriber::on_subscribed_untrusted(Tid first) {
  DSSM_TRY(cursor_.on_subscribed_untrusted(first));
  live_ = true;
  return {};
}

Result<void> Subscriber::on_gap_untrusted(Tid first, std::uint64_t count) {
  return live_ ? cursor_.on_gap_untrusted(first, count) : Result<void>();
}

void Subscriber::on_restart() noexcept {
  if (!granted()) return;
  cursor_.set_next(kNoTid);
  what_->start = Subscription::Start::oldest;
  restart_at_ = queue_.removed() + queue_.size();
}

void Subscriber::on_down() noexcept {
  live_ = false;
  arriving_ = Arriving::nothing;
}

[[gnu::hot]] Result<bool> Subscriber::on_sample_begin(const SampleInfo& info, std::byte*& out) {
  if (!live_) {
    arriving_ = Arriving::nowhere;
    out = nullptr;
    return true;
  }
  if (!cursor_.accepts(info.tid)) return cursor_.unexpected(info.tid);
  if (target_ && !has_buffered()) {
    arriving_ = Arriving::in_target;
    out = target_;
    return true;
  }
  if (!buffering_) return false;
  arriving_ = Arriving::in_queue;
  out = queue_.place();
  return true;
}

[[gnu::hot]] void Subscriber::on_sample_end(const SampleInfo& info, bool torn) noexcept {
  const Arriving arrived = std::exchange(arriving_, Arriving::nothing);
  if (torn || arrived == Arriving::nowhere) return;
  cursor_.on_sample(info.tid);
  if (arrived == Arriving::in_queue) return queue_.push(info);
  delivered_ = info;
  target_ = nullptr;
}

[[gnu::hot]] bool Subscriber::delivered(SampleInfo& info) noexcept {
  if (!delivered_) return false;
  info = *delivered_;
  delivered_.reset();
  return true;
}

std::byte* Subscriber::detach_target() {
  arriving_ = Arriving::in_queue;
  return queue_.place();
}

[[gnu::hot]] std::optional<ReadStatus> Subscriber::pop_buffered(std::span<std::byte> payload,
                                                                SampleInfo& info) noexcept {
  if (is_restart_next()) {
    restart_at_.reset();
    return ReadStatus::restarted;
  }
  if (queue_.empty()) return std::nullopt;
  queue_.pop(payload, info);
  copied_bytes_ += payload.size();
  return ReadStatus::ok;
}

}  // namespace dssm::detail
