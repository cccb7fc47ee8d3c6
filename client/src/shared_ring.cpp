// SPDX-License-Identifier: Apache-2.0
#include "client/src/shared_ring.hpp"

#include <sys/mman.h>
#include <sys/stat.h>

#include <iterator>

namespace dssm::detail {
namespace {

// Up to this size a ring's page tables are filled when it is mapped, so that the first lap is as
// fast as the others. Untuned guess: 16 MiB take about 2 ms.
constexpr std::uint64_t kPrefaultBytes = 16U << 20;

void prefault(const ring::RingMapping& mapping) noexcept {
  if (mapping.geometry().total_bytes > kPrefaultBytes) return;
  // Only a hint: an older kernel refuses it, and the pages come when they are touched. Populating
  // for reading would allocate holes, which a ring that was reserved does not have.
  ::madvise(mapping.base(), mapping.geometry().total_bytes,
            mapping.writable() ? MADV_POPULATE_WRITE : MADV_POPULATE_READ);
}

}  // namespace

Result<std::shared_ptr<const SharedRing>> RingCache::get(std::vector<UniqueFd> fds,
                                                         ring::Access access, bool created) {
  const bool writer = access == ring::Access::read_write;
  if (fds.size() != (writer ? 4 : 3)) {
    return Error{Errc::protocol, "dssmd sent " + std::to_string(fds.size()) +
                                     " descriptors with a stream instead of " +
                                     (writer ? "4" : "3")};
  }
  struct stat file {};
  if (::fstat(fds[0].get(), &file)) return os_error("look at a ring's file");
  const Key key{file.st_dev, file.st_ino, access};
  const std::lock_guard guard(mutex_);
  std::erase_if(rings_, [](const auto& entry) { return entry.second.expired(); });
  if (auto known = rings_.find(key); known != rings_.end()) {
    if (auto ring = known->second.lock()) return ring;
  }
  auto mapping = ring::RingMapping::open_untrusted(fds[0].get(), access);
  if (!mapping) return std::move(mapping).error();
  auto bell = ring::Bell::open_untrusted(fds[1].get());
  if (!bell) return std::move(bell).error();
  if (created) {
    if (Result<void> done = ring::reserve(fds[0].get(), (*mapping)->geometry()); !done) {
      return std::move(done).error();
    }
  }
  prefault(**mapping);
  auto ring = std::make_shared<SharedRing>();
  ring->ring_fd = std::move(fds[0]);
  ring->bell_fd = std::move(fds[1]);
  ring->meta_fd = std::move(fds[2]);
  if (writer) ring->doorbell_fd = std::move(fds[3]);
  ring->mapping = std::move(*mapping);
  ring->bell = std::move(*bell);
  rings_[key] = ring;
  return std::shared_ptr<const SharedRing>(std::move(ring));
}

}  // namespace dssm::detail
