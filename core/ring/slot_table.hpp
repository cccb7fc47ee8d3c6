// SPDX-License-Identifier: Apache-2.0
//
// From a tid to its slot and its entry in the time index. The arithmetic uses the geometry that was
// checked when the ring was mapped, never the numbers in the mapping.
#pragma once

#include <dssm/sample.hpp>

#include "core/ring/ring_memory.hpp"

namespace dssm::ring {

// The published sequence of sample `tid`; the slot is being filled while it is one less.
constexpr std::uint64_t published_sequence(Tid tid) noexcept {
  return 2 * static_cast<std::uint64_t>(tid) + 2;
}

// A value; the mapping outlives it.
class SlotTable {
 public:
  explicit SlotTable(const RingMapping& mapping) noexcept
      : first_(&mapping.header().first),
        times_(reinterpret_cast<std::atomic<std::int64_t>*>(mapping.base() +
                                                            mapping.geometry().times_offset)),
        slots_(mapping.base() + mapping.geometry().slots_offset),
        depth_(mapping.geometry().depth),
        slot_bytes_(mapping.geometry().slot_bytes),
        payload_bytes_(mapping.geometry().payload_bytes),
        inverse_(~std::uint64_t{0} / depth_) {}

  std::uint64_t depth() const noexcept { return depth_; }
  std::uint64_t payload_bytes() const noexcept { return payload_bytes_; }

  // tid % depth for tid >= 0, without a division: the product with the inverse's upper half is the
  // quotient or one less.
  std::uint64_t index(Tid tid) const noexcept {
    const std::uint64_t n = static_cast<std::uint64_t>(tid);
    __extension__ using Wide = unsigned __int128;
    const auto quotient = static_cast<std::uint64_t>((static_cast<Wide>(n) * inverse_) >> 64);
    const std::uint64_t rest = n - quotient * depth_;
    return rest >= depth_ ? rest - depth_ : rest;
  }

  SlotHeader& slot(Tid tid) const noexcept {
    return *reinterpret_cast<SlotHeader*>(slots_ + index(tid) * slot_bytes_);
  }
  static std::byte* payload(SlotHeader& slot) noexcept {
    return reinterpret_cast<std::byte*>(&slot) + sizeof(SlotHeader);
  }
  std::atomic<std::int64_t>& time_ns(Tid tid) const noexcept { return times_[index(tid)]; }

  // Oldest readable tid when the newest is `top`; kNoTid for an empty ring. SSM's rule: one slot is
  // left out because it may be written at any moment. A mirror holds no sample before `first`; a
  // `first` beyond `top` means that a sample after a gap is being published: then only `top` is
  // certain to be valid.
  Tid oldest_for(Tid top) const noexcept {
    if (top < 0) return kNoTid;
    const Tid first = first_->load(std::memory_order_acquire);
    if (first > top) return top;
    const Tid oldest = top - static_cast<Tid>(depth_) + 2;
    return oldest < first ? first : oldest;
  }

 private:
  const std::atomic<std::int64_t>* first_;
  std::atomic<std::int64_t>* times_;
  std::byte* slots_;
  std::uint64_t depth_, slot_bytes_, payload_bytes_, inverse_;
};

}  // namespace dssm::ring
