// SPDX-License-Identifier: Apache-2.0
#include "client/src/outbox.hpp"

#include <algorithm>
#include <array>
#include <cstring>
#include <string>

#include "core/base/check.hpp"
#include "core/wire/sample_frame.hpp"

namespace dssm::detail {
namespace {

constexpr std::int64_t kFirstRoom = 16;

// Only an owner that takes samples and acknowledges none makes so many; the oldest are then taken
// for written.
constexpr std::size_t kMaxUnsure = 1024;

using Header = std::array<std::byte, wire::kMaxSampleHeaderBytes>;

std::size_t header_bytes(std::size_t payload_bytes) {
  Header header;  // all headers of a stream have one length
  return wire::encode_sample_header(header, 0, SampleInfo{}, payload_bytes, wire::Trailer::none);
}

}  // namespace

Outbox::Outbox(std::size_t payload_bytes, std::uint64_t max_samples, std::uint64_t max_bytes)
    : payload_bytes_(payload_bytes),
      frame_bytes_(header_bytes(payload_bytes) + payload_bytes),
      max_count_(static_cast<std::int64_t>(std::clamp<std::uint64_t>(
          std::min(max_samples, max_bytes / payload_bytes), 1, std::uint64_t{1} << 32))) {}

std::byte* Outbox::frame(std::int64_t number) noexcept {
  return frames_.data() + static_cast<std::size_t>(number % room_) * frame_bytes_;
}

const std::byte* Outbox::frame(std::int64_t number) const noexcept {
  return frames_.data() + static_cast<std::size_t>(number % room_) * frame_bytes_;
}

std::int64_t Outbox::push(std::span<const std::byte> payload, Time time, Duration clock_error) {
  DSSM_CHECK(payload.size() == payload_bytes_);
  make_room();
  Header header;
  const std::size_t length = wire::encode_sample_header(header, 0, {next_, time, clock_error},
                                                        payload_bytes_, wire::Trailer::none);
  DSSM_CHECK(length + payload_bytes_ == frame_bytes_);
  std::byte* const place = frame(next_);
  std::memcpy(place, header.data(), length);
  std::memcpy(place + length, payload.data(), payload.size());
  return next_++;
}

void Outbox::make_room() {
  if (next_ - first_ < room_) return;
  if (room_ == max_count_) return drop_oldest();
  const std::int64_t room = std::min(max_count_, std::max(kFirstRoom, 2 * room_));
  std::vector<std::byte> frames(static_cast<std::size_t>(room) * frame_bytes_);
  for (std::int64_t number = first_; number < next_; ++number) {
    std::memcpy(frames.data() + static_cast<std::size_t>(number % room) * frame_bytes_,
                frame(number), frame_bytes_);
  }
  frames_ = std::move(frames);
  room_ = room;
}

// What was begun must be ended, or the other side could not tell where the next frame begins.
void Outbox::leave_begun_frame() {
  if (sent_of_send_ == 0) return;
  begun_.assign(frame(send_) + sent_of_send_, frame(send_) + frame_bytes_);
  sent_of_send_ = 0;
  ++send_;
}

void Outbox::drop_oldest() {
  if (send_ == first_) leave_begun_frame();
  if (send_ == first_) {
    ++dropped_;
    ++send_;
  } else {
    if (unsure_.empty() || unsure_.back().to != first_) unsure_.push_back({first_, first_});
    ++unsure_.back().to;
    if (unsure_.size() > kMaxUnsure) unsure_.pop_front();
  }
  ++first_;
}

std::span<const std::byte> Outbox::rest_of_frame() const noexcept {
  if (!begun_.empty()) return begun_;
  if (sent_of_send_ == 0) return {};
  return {frame(send_) + sent_of_send_, frame_bytes_ - sent_of_send_};
}

std::span<const std::byte> Outbox::unsent() const noexcept {
  if (!begun_.empty()) return begun_;
  if (send_ == next_) return {};
  const std::int64_t end = std::min(next_, send_ - send_ % room_ + room_);  // up to the turn
  return {frame(send_) + sent_of_send_,
          static_cast<std::size_t>(end - send_) * frame_bytes_ - sent_of_send_};
}

void Outbox::sent(std::size_t bytes) noexcept {
  if (!begun_.empty()) {
    begun_.erase(begun_.begin(), begun_.begin() + static_cast<std::ptrdiff_t>(bytes));
    return;
  }
  const std::size_t all = sent_of_send_ + bytes;
  send_ += static_cast<std::int64_t>(all / frame_bytes_);
  sent_of_send_ = all % frame_bytes_;
}

Result<void> Outbox::acknowledge(std::int64_t last, Tid tid) {
  if (last >= next_) {
    return Error{Errc::protocol, "dssmd says that sample " + std::to_string(last) +
                                     " of this program is written; the last one was " +
                                     std::to_string(next_ - 1)};
  }
  if (last <= written_) return {};
  written_ = last;
  written_tid_ = tid;
  // What the connection before this one had still on its way may be written before it is sent anew.
  if (last >= send_) leave_begun_frame();
  send_ = std::max(send_, last + 1);
  first_ = std::max(first_, last + 1);
  while (!unsure_.empty() && unsure_.front().to <= last + 1) unsure_.pop_front();
  if (!unsure_.empty()) unsure_.front().from = std::max(unsure_.front().from, last + 1);
  return {};
}

void Outbox::on_down() noexcept {
  begun_.clear();
  if (sent_of_send_ > 0) ++send_;  // as if it had gone: it may have arrived
  sent_of_send_ = 0;
}

Result<void> Outbox::restart(std::int64_t last, Tid tid) {
  if (Result<void> done = acknowledge(last, tid); !done) return done;
  // What the owner has not written and is not here any more will never be sent.
  for (const Range& lost : unsure_) dropped_ += static_cast<std::uint64_t>(lost.to - lost.from);
  unsure_.clear();
  send_ = first_;
  return {};
}

}  // namespace dssm::detail
