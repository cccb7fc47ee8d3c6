// SPDX-License-Identifier: Apache-2.0
#include "client/src/sample_queue.hpp"

#include <algorithm>
#include <cstring>

namespace dssm::detail {
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
  std::memcpy(payload.data(), payloads_.data() + first_ * payload_bytes_, payload_bytes_);
  info = infos_[first_];
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
    std::memcpy(payloads.data() + n * payload_bytes_, payloads_.data() + index(n) * payload_bytes_,
                payload_bytes_);
    infos[n] = infos_[index(n)];
  }
  payloads_ = std::move(payloads);
  infos_ = std::move(infos);
  first_ = 0;
}

}  // namespace dssm::detail
