// SPDX-License-Identifier: Apache-2.0
#include "client/src/subscriber.hpp"

#include <algorithm>
#include <cstdint>
#include <string>
#include <utility>

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
}

void Subscriber::end() {
  what_.reset();
  live_ = resumes_ = false;
  if (arriving_ != Arriving::nothing) arriving_ = Arriving::nowhere;
  target_ = nullptr;
  delivered_.reset();
  queue_.clear();
  restart_at_.reset();
}

void Subscriber::to_message(std::uint64_t incarnation, net::Subscribe& out) const {
  out.set_max_rate_hz(what_->max_rate_hz);
  if (resumes_) {
    out.set_from_tid(due_);
    out.set_incarnation(incarnation);
    return;
  }
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

Result<void> Subscriber::on_subscribed(const net::Subscribed& message) {
  if (message.first_tid() < 0) {
    return Error{Errc::protocol,
                 "the subscription begins with tid " + std::to_string(message.first_tid())};
  }
  if (resumes_ && message.first_tid() > due_ && !is_thinned()) {
    lost_ += static_cast<std::uint64_t>(message.first_tid() - due_);
  }
  due_ = message.first_tid();
  live_ = resumes_ = true;
  return {};
}

void Subscriber::on_gap(const net::Gap& message) noexcept {
  if (!live_ || message.first_tid() < 0) return;
  const auto max_count = static_cast<std::uint64_t>(INT64_MAX - message.first_tid());
  const Tid end = message.first_tid() + static_cast<Tid>(std::min(message.count(), max_count));
  const Tid from = is_thinned() ? std::max(message.first_tid(), due_) : due_;
  if (end <= from) return;
  lost_ += static_cast<std::uint64_t>(end - from);
  due_ = end;
}

void Subscriber::on_restart() noexcept {
  if (!resumes_) return;
  resumes_ = false;  // `due_` is a tid of the old ring
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
  if (info.tid < due_ || info.tid == INT64_MAX) {
    return Error{Errc::protocol, "sample " + std::to_string(info.tid) + " came when " +
                                     std::to_string(due_) + " was due"};
  }
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
  if (!is_thinned()) lost_ += static_cast<std::uint64_t>(info.tid - due_);
  due_ = info.tid + 1;
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
