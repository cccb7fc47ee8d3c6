// SPDX-License-Identifier: Apache-2.0
#include "core/ring/ring_memory.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <bit>
#include <cerrno>
#include <cstring>

#include "core/ring/robust_lock.hpp"

namespace dssm::ring {
namespace {

constexpr int kRingSeals = F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL;

Error not_a_ring(const std::string& why) {
  return Error{Errc::protocol, "this is no ring that can be used: " + why};
}

std::string text_of(const char* field, std::size_t capacity) {
  return std::string(field, ::strnlen(field, capacity));
}

// Opens what `fd` stands for anew; the magic links of /proc lead to the file itself.
Result<UniqueFd> reopen(int fd, int flags) {
  const std::string path = "/proc/self/fd/" + std::to_string(fd);
  UniqueFd again(::open(path.c_str(), flags | O_CLOEXEC));
  if (!again) return os_error("open '" + path + "', a ring, anew");
  return again;
}

}  // namespace

Result<UniqueFd> create_ring(const RingIdentity& identity, const Geometry& geometry) {
  const std::string what = "create a ring for '" + identity.id.str() + "'";
  UniqueFd fd(
      ::memfd_create(("dssm-ring:" + identity.id.str()).c_str(), MFD_CLOEXEC | MFD_ALLOW_SEALING));
  if (!fd) return os_error(what + ": memfd_create");
  if (::ftruncate(fd.get(), static_cast<off_t>(geometry.total_bytes))) {
    return os_error(what + ": set its size to " + std::to_string(geometry.total_bytes) + " bytes");
  }
  void* page = ::mmap(nullptr, sizeof(RingHeader), PROT_READ | PROT_WRITE, MAP_SHARED, fd.get(), 0);
  if (page == MAP_FAILED) return os_error(what + ": map its header");
  auto& header = *static_cast<RingHeader*>(page);
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
  init_robust_lock(header.lock);
  header.top.store(kNoTid, std::memory_order_relaxed);
  header.run_start.store(0, std::memory_order_relaxed);
  header.first.store(0, std::memory_order_relaxed);
  header.layout_version = kLayoutVersion;
  header.magic = kMagic;
  ::munmap(page, sizeof(RingHeader));
  if (::fcntl(fd.get(), F_ADD_SEALS, kRingSeals)) return os_error(what + ": seal its size");
  if (::fchmod(fd.get(), 0400)) return os_error(what + ": protect it");
  return fd;
}

Result<void> reserve(int fd, const Geometry& geometry) {
  int failed = 0;
  do {
    failed = ::posix_fallocate(fd, 0, static_cast<off_t>(geometry.total_bytes));
  } while (failed == EINTR);
  if (!failed) return {};
  return os_error("reserve " + std::to_string(geometry.total_bytes) + " bytes of memory for a ring",
                  failed);
}

Result<UniqueFd> reopen_read_only(int fd) { return reopen(fd, O_RDONLY); }

Result<UniqueFd> reopen_read_write(int fd) {
  if (::fchmod(fd, 0600)) return os_error("open a ring anew for writing");
  Result<UniqueFd> again = reopen(fd, O_RDWR);
  if (::fchmod(fd, 0400)) return os_error("protect a ring");
  return again;
}

Result<std::shared_ptr<const RingMapping>> RingMapping::open_untrusted(int fd, Access access) {
  const int seals = ::fcntl(fd, F_GET_SEALS);
  if (seals < 0 || (seals & kRingSeals) != kRingSeals) {
    return not_a_ring("it is no memory file of a sealed size");
  }
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("look at a ring's file");
  const auto file_bytes = static_cast<std::uint64_t>(file.st_size);
  if (file_bytes < sizeof(RingHeader)) {
    return not_a_ring("its " + std::to_string(file_bytes) + " bytes hold no header");
  }
  std::shared_ptr<RingMapping> mapping(new RingMapping);
  mapping->access_ = access;
  const int protection = access == Access::read_write ? PROT_READ | PROT_WRITE : PROT_READ;
  void* base = ::mmap(nullptr, file_bytes, protection, MAP_SHARED, fd, 0);
  if (base == MAP_FAILED) {
    return os_error("map a ring of " + std::to_string(file_bytes) + " bytes");
  }
  mapping->base_ = static_cast<std::byte*>(base);
  mapping->geometry_.total_bytes = file_bytes;  // what the destructor unmaps

  // One copy, which is checked and used; the original may change at any time.
  struct Snapshot {
    std::byte bytes[offsetof(RingHeader, reserved1)];
  } snapshot;
  std::memcpy(&snapshot, base, sizeof snapshot);
  const auto& header = *std::launder(reinterpret_cast<const RingHeader*>(&snapshot));
  if (header.magic != kMagic) return not_a_ring("it does not begin with \"DSSMRING\"");
  if (header.layout_version != kLayoutVersion) {
    return not_a_ring("it has the layout version " + std::to_string(header.layout_version) +
                      ", this program knows " + std::to_string(kLayoutVersion) +
                      "; install the same version of DSSM everywhere on this PC");
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
    return not_a_ring("its alignment is no power of two up to 64");
  }
  mapping->geometry_ = *geometry;
  return std::shared_ptr<const RingMapping>(std::move(mapping));
}

RingMapping::~RingMapping() {
  if (base_) ::munmap(base_, geometry_.total_bytes);
}

}  // namespace dssm::ring
