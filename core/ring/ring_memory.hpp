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

namespace dssm::ring {

// Offsets and sizes in a ring: follow from payload size and depth, and are checked when read from
// a mapping.
struct Geometry {
  std::uint64_t payload_bytes = 0;
  std::uint64_t depth = 0;
  std::uint64_t slot_bytes = 0;    // distance between slots, multiple of 64
  std::uint64_t times_offset = 0;  // of the time index, from the mapping's start
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

 private:
  RingMapping() = default;
  SharedMapping memory_;
  Access access_ = Access::read_only;
  Geometry geometry_;
  RingIdentity identity_;
};

}  // namespace dssm::ring
