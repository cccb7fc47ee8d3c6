// SPDX-License-Identifier: Apache-2.0
#include "client/src/subscriber.hpp"

#include <algorithm>
#include <cstring>
#include <utility>

#include "core/base/try.hpp"

namespace dssm::detail {

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
  copied_bytes_ += info.payload_bytes;
  return ReadStatus::ok;
}

namespace {

constexpr std::size_t kFirstCount = 16;

}  // namespace

SampleQueue::SampleQueue(std::size_t payload_bytes, std::size_t max_bytes)
    : payload_bytes_(payload_bytes),
      max_count_(std::max<std::size_t>(1, max_bytes / payload_bytes)) {}

std::byte* SampleQueue::place() {
  if (count_ == infos_.size()) grow();
  return payloads_.data() + index(count_) * payload_bytes_;
}

void SampleQueue::push(const SampleInfo& info) noexcept {
  infos_[index(count_++)] = info;
  if (count_ <= max_count_) return;
  remove_oldest();
  ++dropped_;
}

void SampleQueue::pop(std::span<std::byte> payload, SampleInfo& info) noexcept {
  info = infos_[first_];
  std::memcpy(payload.data(), payloads_.data() + first_ * payload_bytes_, info.payload_bytes);
  remove_oldest();
}

void SampleQueue::remove_oldest() noexcept {
  first_ = index(1);
  --count_;
  ++removed_;
}

void SampleQueue::clear() noexcept {
  removed_ += count_;
  first_ = count_ = 0;
}

void SampleQueue::grow() {
  const std::size_t max_capacity = max_count_ + 1;  // one is arriving
  const std::size_t capacity = std::min(max_capacity, std::max(kFirstCount, 2 * infos_.size()));
  std::vector<std::byte> payloads(capacity * payload_bytes_);
  std::vector<SampleInfo> infos(capacity);
  for (std::size_t n = 0; n < count_; ++n) {
    infos[n] = infos_[index(n)];
    std::memcpy(payloads.data() + n * payload_bytes_, payloads_.data() + index(n) * payload_bytes_,
                infos[n].payload_bytes);
  }
  payloads_ = std::move(payloads);
  infos_ = std::move(infos);
  first_ = 0;
}

}  // namespace dssm::detail
