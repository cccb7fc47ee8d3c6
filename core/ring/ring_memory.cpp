// SPDX-License-Identifier: Apache-2.0
#include "core/ring/ring_memory.hpp"

#include <fcntl.h>
#include <fmt/core.h>
#include <sys/stat.h>

#include <bit>
#include <cerrno>
#include <cstring>
#include <dssm/stream.hpp>

#include "core/base/try.hpp"
#include "core/ring/layout.hpp"

namespace dssm::ring {

namespace {

constexpr std::uint64_t round_up(std::uint64_t value, std::uint64_t unit) noexcept {
  return (value + unit - 1) / unit * unit;
}

}  // namespace

Result<Geometry> Geometry::of(std::uint64_t payload_bytes, std::uint64_t depth) {
  if (payload_bytes < 1 || payload_bytes > kMaxPayloadBytes) {
    return Error{Errc::invalid_argument,
                 fmt::format("a payload of {} bytes is not possible; it takes 1 byte to 64 MiB",
                             payload_bytes)};
  }
  if (depth < kMinDepth || depth > kMaxDepth) {
    return Error{Errc::invalid_argument,
                 fmt::format("a depth of {} slots is not possible; it takes 2 to 16777216", depth)};
  }
  Geometry geometry;
  geometry.payload_bytes = payload_bytes;
  geometry.depth = depth;
  geometry.slot_bytes = round_up(sizeof(SlotHeader) + payload_bytes + kGuardBytes, kLineBytes);
  geometry.times_offset = round_up(sizeof(RingHeader), system_page_bytes());
  geometry.slots_offset = geometry.times_offset + round_up(8 * depth, kPageBytes);
  geometry.total_bytes = round_up(geometry.slots_offset + depth * geometry.slot_bytes, kPageBytes);
  return geometry;  // at most 2^24 * (2^26 + 128) + ..., far below 2^63
}

namespace {

Error not_a_ring(const std::string& why) {
  return Error{Errc::protocol, "this is not a usable ring: " + why};
}

std::string text_of(const char* field, std::size_t capacity) {
  return std::string(field, ::strnlen(field, capacity));
}

}  // namespace

std::string RingIdentity::label() const { return fmt::format("{}#{:x}", id.str(), incarnation); }

Result<UniqueFd> create_ring(const RingIdentity& identity, const Geometry& geometry) {
  const std::string what = "create a ring for '" + identity.id.str() + "'";
  UniqueFd fd = DSSM_TRY(
      create_sealed_memory("dssm-ring:" + identity.label(), geometry.total_bytes, 0400), what);
  const SharedMapping mapping =
      DSSM_TRY(SharedMapping::map(fd.get(), sizeof(RingHeader), PROT_READ | PROT_WRITE), what);
  auto& header = mapping.as<RingHeader>();
  header.alignment_bytes = identity.alignment_bytes;
  header.payload_bytes = geometry.payload_bytes;
  header.depth = geometry.depth;
  header.slot_bytes = geometry.slot_bytes;
  header.times_offset = geometry.times_offset;
  header.slots_offset = geometry.slots_offset;
  header.total_bytes = geometry.total_bytes;
  header.incarnation = identity.incarnation;
  header.cycle_ns = to_ns(identity.cycle);
  header.stream_id = identity.id.id;
  identity.id.name.copy(header.name, sizeof header.name - 1);
  identity.id.host.copy(header.host, sizeof header.host - 1);
  header.top.store(kNoTid, std::memory_order_relaxed);
  header.run_start.store(0, std::memory_order_relaxed);
  header.first.store(0, std::memory_order_relaxed);
  header.layout_version = kLayoutVersion;
  header.magic = kMagic;
  return fd;
}

Result<void> reserve(int fd, const Geometry& geometry) {
  int failed = 0;
  do {
    failed = ::posix_fallocate(fd, 0, static_cast<off_t>(geometry.total_bytes));
  } while (failed == EINTR);
  if (!failed) return {};
  return os_error(fmt::format("reserve {} bytes of memory for a ring", geometry.total_bytes),
                  failed);
}

Result<std::shared_ptr<const RingMapping>> RingMapping::open_untrusted(int fd, Access access) {
  if (!has_seals(fd, kSizeSeals)) {
    return not_a_ring("it is not a memory file of a sealed size");
  }
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("get the size of a ring's file");
  const auto file_bytes = static_cast<std::uint64_t>(file.st_size);
  if (file_bytes < sizeof(RingHeader)) {
    return not_a_ring(fmt::format("its {} bytes are too few for a header", file_bytes));
  }
  std::shared_ptr<RingMapping> mapping(new RingMapping);
  mapping->access_ = access;
  const int protection = access == Access::read_write ? PROT_READ | PROT_WRITE : PROT_READ;
  mapping->memory_ = DSSM_TRY(SharedMapping::map(fd, file_bytes, protection), "map a ring");

  // One copy, which is checked and used; the original may change at any time. What follows the
  // description belongs to the writers, and stays zero here.
  alignas(RingHeader) std::byte snapshot[sizeof(RingHeader)] = {};
  std::memcpy(snapshot, mapping->base(), offsetof(RingHeader, reserved1));
  const auto& header = *std::launder(reinterpret_cast<const RingHeader*>(snapshot));
  if (header.magic != kMagic) return not_a_ring("it does not begin with \"DSSMRING\"");
  if (header.layout_version != kLayoutVersion) {
    return not_a_ring(fmt::format(
        "it has the layout version {}, this program knows {}; install the same version of DSSM "
        "everywhere on this PC",
        header.layout_version, kLayoutVersion));
  }
  const Result<Geometry> geometry = Geometry::of(header.payload_bytes, header.depth);
  if (!geometry) return not_a_ring(geometry.error().message);
  const Geometry stated{header.payload_bytes, header.depth,        header.slot_bytes,
                        header.times_offset,  header.slots_offset, header.total_bytes};
  if (stated != *geometry || file_bytes != geometry->total_bytes) {
    return not_a_ring("its geometry does not follow from its payload size and depth");
  }
  RingIdentity& identity = mapping->identity_;
  identity.id = {text_of(header.name, sizeof header.name), header.stream_id,
                 text_of(header.host, sizeof header.host)};
  if (Result<void> checked = identity.id.check(); !checked) {
    return not_a_ring(checked.error().message);
  }
  identity.incarnation = header.incarnation;
  identity.cycle = Duration(header.cycle_ns);
  identity.alignment_bytes = header.alignment_bytes;
  if (!std::has_single_bit(identity.alignment_bytes) || identity.alignment_bytes > kLineBytes) {
    return not_a_ring("its alignment is not a power of two up to 64");
  }
  mapping->geometry_ = *geometry;
  if (access == Access::read_write) mapping->writer_lock_ = DSSM_TRY(RobustLock::map(fd));
  return std::shared_ptr<const RingMapping>(std::move(mapping));
}

}  // namespace dssm::ring
