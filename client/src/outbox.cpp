// SPDX-License-Identifier: Apache-2.0
#include "client/src/outbox.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cstring>

#include "core/base/check.hpp"
#include "core/base/try.hpp"
#include "core/wire/sample_frame.hpp"

namespace dssm::detail {
namespace {

constexpr std::int64_t kFirstCapacity = 16;

// Of unsent bytes that are found at a time: more than one send takes, or a long frame.
constexpr std::size_t kEnoughBytes = 256U << 10;

using Header = std::array<std::byte, wire::kMaxSampleHeaderBytes>;

std::size_t frame_bytes(std::size_t payload_bytes) {
  Header header;
  SampleInfo info;
  info.payload_bytes = payload_bytes;
  return wire::encode_sample_header(header, 0, info, wire::Trailer::none) + payload_bytes;
}

}  // namespace

Outbox::Outbox(std::size_t payload_bytes, std::uint64_t max_samples, std::uint64_t max_bytes)
    : payload_bytes_(payload_bytes),
      most_frame_bytes_(frame_bytes(payload_bytes)),
      max_count_(static_cast<std::int64_t>(std::clamp<std::uint64_t>(
          std::min(max_samples, max_bytes / payload_bytes), 1, std::uint64_t{1} << 32))) {}

std::byte* Outbox::place(std::int64_t number) noexcept {
  return frames_.data() + static_cast<std::size_t>(number % capacity_) * most_frame_bytes_;
}

std::span<const std::byte> Outbox::frame(std::int64_t number) const noexcept {
  const auto at = static_cast<std::size_t>(number % capacity_);
  return {frames_.data() + at * most_frame_bytes_, frame_bytes_[at]};
}

std::int64_t Outbox::push(std::span<const std::byte> payload, Time time, Duration clock_error) {
  DSSM_CHECK(payload.size() <= payload_bytes_);
  make_space();
  Header header;
  const std::size_t header_bytes = wire::encode_sample_header(
      header, 0, {next_, time, clock_error, payload.size()}, wire::Trailer::none);
  std::byte* const begin = std::copy_n(header.begin(), header_bytes, place(next_));
  std::copy(payload.begin(), payload.end(), begin);
  frame_bytes_[static_cast<std::size_t>(next_ % capacity_)] = header_bytes + payload.size();
  return next_++;
}

void Outbox::make_space() {
  if (next_ - first_ < capacity_) return;
  if (capacity_ == max_count_) return drop_oldest();
  const std::int64_t capacity = std::min(max_count_, std::max(kFirstCapacity, 2 * capacity_));
  std::vector<std::byte> frames(static_cast<std::size_t>(capacity) * most_frame_bytes_);
  std::vector<std::size_t> lengths(static_cast<std::size_t>(capacity));
  for (std::int64_t number = first_; number < next_; ++number) {
    const std::span<const std::byte> kept = frame(number);
    const auto at = static_cast<std::size_t>(number % capacity);
    std::memcpy(frames.data() + at * most_frame_bytes_, kept.data(), kept.size());
    lengths[at] = kept.size();
  }
  frames_ = std::move(frames);
  frame_bytes_ = std::move(lengths);
  capacity_ = capacity;
}

// A frame that was sent in part must be completed, or the other side cannot find the next one.
void Outbox::detach_begun_frame() {
  if (sent_of_send_ == 0) return;
  const std::span<const std::byte> rest = frame(send_).subspan(sent_of_send_);
  begun_.assign(rest.begin(), rest.end());
  sent_of_send_ = 0;
  ++send_;
}

void Outbox::drop_oldest() {
  if (send_ == first_) detach_begun_frame();
  if (send_ == first_) {
    ++dropped_;
    ++send_;
  } else {
    if (unacked_dropped_.empty() || unacked_dropped_.back().to != first_)
      unacked_dropped_.push_back({first_, first_});
    ++unacked_dropped_.back().to;
    if (unacked_dropped_.size() > kMaxUnackedRanges) unacked_dropped_.pop_front();
  }
  ++first_;
}

std::span<const std::byte> Outbox::rest_of_frame() const noexcept {
  if (!begun_.empty()) return begun_;
  if (sent_of_send_ == 0) return {};
  return frame(send_).subspan(sent_of_send_);
}

std::span<const std::byte> Outbox::unsent() const noexcept {
  if (!begun_.empty()) return begun_;
  if (send_ == next_) return {};
  // Up to the end of the circular buffer, or the first frame that is followed by unused bytes.
  const std::int64_t end = std::min(next_, send_ - send_ % capacity_ + capacity_);
  std::size_t bytes = 0;
  for (std::int64_t number = send_; number < end; ++number) {
    bytes += frame(number).size();
    if (frame(number).size() != most_frame_bytes_ || bytes >= kEnoughBytes) break;
  }
  return {frame(send_).data() + sent_of_send_, bytes - sent_of_send_};
}

void Outbox::sent(std::size_t bytes) noexcept {
  if (!begun_.empty()) {
    begun_.erase(begun_.begin(), begun_.begin() + static_cast<std::ptrdiff_t>(bytes));
    return;
  }
  sent_of_send_ += bytes;
  while (sent_of_send_ > 0 && sent_of_send_ >= frame(send_).size()) {
    sent_of_send_ -= frame(send_++).size();
  }
}

Result<void> Outbox::acknowledge(std::int64_t last, Tid tid) {
  if (last >= next_) {
    return Error{Errc::protocol,
                 fmt::format("dssmd acknowledged sample {} of this program; the last one was {}",
                             last, next_ - 1)};
  }
  if (last <= written_) return {};
  written_ = last;
  written_tid_ = tid;
  // Samples that the previous connection still carried may be written before they are sent again.
  if (last >= send_) detach_begun_frame();
  send_ = std::max(send_, last + 1);
  first_ = std::max(first_, last + 1);
  while (!unacked_dropped_.empty() && unacked_dropped_.front().to <= last + 1)
    unacked_dropped_.pop_front();
  if (!unacked_dropped_.empty())
    unacked_dropped_.front().from = std::max(unacked_dropped_.front().from, last + 1);
  return {};
}

void Outbox::on_down() noexcept {
  begun_.clear();
  if (sent_of_send_ > 0) ++send_;  // counts as sent: it may have arrived
  sent_of_send_ = 0;
}

Result<void> Outbox::restart(std::int64_t last, Tid tid) {
  DSSM_TRY(acknowledge(last, tid));
  // Samples that the owner has not written and that are not kept any more are lost.
  for (const Range& lost : unacked_dropped_)
    dropped_ += static_cast<std::uint64_t>(lost.to - lost.from);
  unacked_dropped_.clear();
  send_ = first_;
  return {};
}

}  // namespace dssm::detail
