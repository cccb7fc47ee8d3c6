// SPDX-License-Identifier: Apache-2.0
//
// One ring as this process holds it: descriptors, mapping and bell, shared by all readers or all
// writers of the stream in the process, so that opening a stream a hundred times maps it once.
#pragma once

#include <dssm/stream.hpp>
#include <map>
#include <memory>
#include <mutex>
#include <tuple>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_memory.hpp"

namespace dssm::detail {

// Immutable once made. The descriptors are kept to offer the ring back to a restarted dssmd.
struct SharedRing {
  UniqueFd ring_fd, bell_fd, meta_fd;
  UniqueFd doorbell_fd;  // writers only
  std::shared_ptr<const ring::RingMapping> mapping;
  std::shared_ptr<ring::Bell> bell;
};

// All rings of a process, by the identity of their files. Thread-safe.
class RingCache {
 public:
  // The shared ring of these descriptors (as in local.proto's Opened: ring, bell, meta, and for
  // writers the doorbell), mapped now or before. `created`: it is new, so take its memory first.
  //   fails  no_memory, protocol
  Result<std::shared_ptr<const SharedRing>> get(std::vector<UniqueFd> fds, ring::Access access,
                                                bool created);

 private:
  using Key = std::tuple<std::uint64_t, std::uint64_t, ring::Access>;  // device, inode, access
  std::mutex mutex_;
  std::map<Key, std::weak_ptr<const SharedRing>> rings_;
};

}  // namespace dssm::detail
