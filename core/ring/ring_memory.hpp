// SPDX-License-Identifier: Apache-2.0
//
// Creates and maps the memory of a ring, and checks that what is mapped is a ring. Both the daemon
// and the client library map rings through RingMapping. Its geometry is a checked copy: no code
// reads the header's geometry again, because another process may overwrite it at any time.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <string>

#include "core/base/sealed_memory.hpp"
#include "core/ring/layout.hpp"
#include "core/ring/robust_lock.hpp"

namespace dssm::ring {

// Offsets and sizes in a ring: follow from payload size and depth, and are checked when read from
// a mapping.
struct Geometry {
  std::uint64_t payload_bytes = 0;
  std::uint64_t depth = 0;
  std::uint64_t slot_bytes = 0;    // distance between slots, multiple of 64
  std::uint64_t times_offset = 0;  // of the time index, from the mapping's start: one page
  std::uint64_t slots_offset = 0;  // of slot 0
  std::uint64_t total_bytes = 0;   // of the whole ring, multiple of the page size

  // The geometry for these. Fails with invalid_argument, naming value and range: payload 1 byte to
  // 64 MiB, depth 2 to 2^24.
  static Result<Geometry> of(std::uint64_t payload_bytes, std::uint64_t depth);

  friend bool operator==(const Geometry&, const Geometry&) = default;
};

// What the ring's header states about its stream.
struct RingIdentity {
  StreamId id;                    // with host
  std::uint64_t incarnation = 0;  // random; differs between two rings of one name
  Duration cycle{};
  std::uint32_t alignment_bytes = 1;

  // "odometry:0@pc1#57d6e9a3": in the names of a stream's memory files, which nobody can change. It
  // tells which files belong together.
  std::string label() const;
};

enum class Access : unsigned char { read_only, read_write };

// Creates the memory file of a new ring: header written, size sealed, inode mode 0400, so that only
// its creator (and root) can open it again through /proc. The system takes memory for it at the
// first write to each page; see reserve().
//   returns  a read-write descriptor
Result<UniqueFd> create_ring(const RingIdentity& identity, const Geometry& geometry);

// Takes all memory of the ring from the system now, charged to the calling process, so that no
// write to it can fail later. May take a while: 1 GiB about a quarter of a second.
//   fails  no_memory
Result<void> reserve(int fd, const Geometry& geometry);

// A mapped ring. Immutable after open(); share it by shared_ptr between readers and writers of one
// process. Unmapped by the destructor.
class RingMapping {
 public:
  // Maps the ring in the file `fd` after a check that it is one: a sealed memfd, magic and layout
  // version, and a geometry that follows from payload size and depth and fits the file's size.
  // Does not keep `fd`.
  //   fails  protocol (not a ring, or another layout version; the message says which), os errors
  static Result<std::shared_ptr<const RingMapping>> open_untrusted(int fd, Access access);

  RingMapping(const RingMapping&) = delete;
  RingMapping& operator=(const RingMapping&) = delete;

  const Geometry& geometry() const noexcept { return geometry_; }
  const RingIdentity& identity() const noexcept { return identity_; }
  bool writable() const noexcept { return access_ == Access::read_write; }
  std::byte* base() const noexcept { return memory_.base(); }
  RingHeader& header() const noexcept { return memory_.as<RingHeader>(); }
  // Of a mapping with write access.
  const RobustLock& writer_lock() const noexcept { return writer_lock_; }

 private:
  RingMapping() = default;
  SharedMapping memory_;
  RobustLock writer_lock_;
  Access access_ = Access::read_only;
  Geometry geometry_;
  RingIdentity identity_;
};

// The published sequence of sample `tid`; the slot is being filled while it is one less.
constexpr std::uint64_t published_sequence(Tid tid) noexcept {
  return 2 * static_cast<std::uint64_t>(tid) + 2;
}

// That of sample `tid` of a mirror that will never come, although older ones are here. Its entry in
// the time index has the time of the sample after it, so that no search finds it.
constexpr std::uint64_t lost_sequence(Tid tid) noexcept {
  return published_sequence(tid) | std::uint64_t{1} << 63;
}

// Samples [begin, end).
struct TidRange {
  Tid begin = 0, end = 0;

  bool is_empty() const noexcept { return begin >= end; }
  Tid count() const noexcept { return end - begin; }
  bool holds(Tid tid) const noexcept { return tid >= begin && tid < end; }
};

// The hole of a mirror: samples of which some are still to come. All samples after it are here or
// lost, and searches by time begin after it. In other rings it is empty. The end is loaded first,
// because it is stored first: while the hole grows, a reader may see it greater than it is, but
// never smaller.
inline TidRange hole_of(const RingHeader& header) noexcept {
  const Tid end = header.hole_end.load(std::memory_order_acquire);
  return {header.hole_begin.load(std::memory_order_acquire), end};
}

// From a tid to its slot and its entry in the time index. The arithmetic uses the geometry that was
// checked when the ring was mapped, never the numbers in the mapping. A value; the mapping outlives
// it.
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
