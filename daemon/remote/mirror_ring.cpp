// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/mirror_ring.hpp"

#include <cstring>
#include <new>
#include <string>
#include <utility>

#include "daemon/link/sample_pump.hpp"

namespace dssm::daemon {

Result<std::unique_ptr<MirrorRing>> MirrorRing::open(std::shared_ptr<Stream> stream,
                                                     MemoryBudget& budget) {
  auto mapping = stream->map_for_writing();
  if (!mapping) return std::move(mapping).error();
  auto bell = stream->map_bell();
  if (!bell) return std::move(bell).error();
  return std::unique_ptr<MirrorRing>(
      new MirrorRing(std::move(stream), *std::move(mapping), *std::move(bell), budget));
}

MirrorRing::MirrorRing(std::shared_ptr<Stream> stream,
                       std::shared_ptr<const ring::RingMapping> mapping,
                       std::shared_ptr<ring::Bell> bell, MemoryBudget& budget)
    : stream_(std::move(stream)),
      mapping_(std::move(mapping)),
      bell_(std::move(bell)),
      budget_(budget),
      writer_(*mapping_, *bell_),
      reader_(*mapping_),
      next_(writer_.newest() < 0 ? kNoTid : writer_.newest() + 1) {}

Result<void> MirrorRing::on_subscribed_untrusted(Tid first) {
  if (first < 0 || first > kLastTid) {
    return Error{Errc::protocol,
                 "the subscription is said to begin with sample " + std::to_string(first)};
  }
  // After a cut we know what comes next: what the owner no longer has of it is a gap.
  if (next_ < 0) next_ = first;
  return {};
}

// Behind a gap, the slot of sample `tid` may be one that readers still read, and the payload may
// take long to arrive.
bool MirrorRing::would_spoil_window(Tid tid) const noexcept {
  const Tid newest = writer_.newest();
  if (newest < 0) return false;
  const Tid depth = static_cast<Tid>(stream_->mapping().geometry().depth);
  const Tid same_slot = newest - (depth - (tid - newest) % depth) % depth;
  return same_slot >= reader_.oldest();
}

[[gnu::hot]] Result<std::byte*> MirrorRing::begin_untrusted(const wire::IncomingSample& sample) {
  const Tid tid = sample.info.tid;
  if (tid < next_ || tid > kLastTid) {
    return Error{Errc::protocol, "sample " + std::to_string(tid) + " came where sample " +
                                     std::to_string(next_) + " or a later one was due"};
  }
  if (aside_) drop_aside();  // of one that was cut off
  const bool behind_gap = tid != writer_.newest() + 1;
  if (behind_gap && would_spoil_window(tid)) take_aside(sample.payload_bytes);
  return aside_ ? aside_.get() : writer_.begin(tid);
}

// Without memory for it nothing is set aside: better a sample of the old window that cannot be read
// for a while than none of the new ones.
void MirrorRing::take_aside(std::size_t bytes) {
  Result<MemoryShare> share = budget_.take(bytes);
  if (!share) return;
  aside_.reset(new (std::nothrow) std::byte[bytes]);
  if (aside_) aside_share_ = *std::move(share);
}

void MirrorRing::drop_aside() noexcept {
  aside_.reset();
  aside_share_ = MemoryShare();
}

[[gnu::hot]] void MirrorRing::end(const wire::IncomingSample& sample, bool torn) {
  if (!torn) {
    const Tid tid = sample.info.tid;
    if (aside_) std::memcpy(writer_.begin(tid), aside_.get(), sample.payload_bytes);
    writer_.commit(sample.info.time, sample.info.clock_error);
    gap_samples_ += static_cast<std::uint64_t>(tid - next_);
    next_ = tid + 1;
    news_ = true;
    ++received_samples_;
    received_bytes_ += sample.payload_bytes;
  }
  // A torn one is missing from here on: what comes next counts it, by its own tid.
  if (aside_) drop_aside();
}

Result<void> MirrorRing::on_gap_untrusted(Tid first, std::uint64_t count) {
  if (first < 0 || first > kLastTid || count > static_cast<std::uint64_t>(kLastTid - first)) {
    return Error{Errc::protocol, "a gap of " + std::to_string(count) + " samples at sample " +
                                     std::to_string(first)};
  }
  const Tid behind = first + static_cast<Tid>(count);
  if (behind <= next_) {
    return Error{Errc::protocol, "samples up to " + std::to_string(behind) +
                                     " are said to be lost, and sample " +
                                     std::to_string(next_ - 1) + " has come already"};
  }
  gap_samples_ += static_cast<std::uint64_t>(behind - next_);
  next_ = behind;
  return {};
}

[[gnu::hot]] void MirrorRing::wake() noexcept {
  if (std::exchange(news_, false)) writer_.wake();
}

}  // namespace dssm::daemon
