// SPDX-License-Identifier: Apache-2.0
//
// Checks whether a descriptor is a memory file that dssmd created.
#pragma once

#include <dssm/result.hpp>
#include <string_view>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

// Whether `fd` is a memfd that dssmd's own user created and that carries all of `seals` (F_SEAL_*).
// Only root and programs of that same user can make such a file. `what` names it in the failure:
// "ring".
//   fails  protocol (not a sealed memory file), no_permission (another user's)
Result<void> check_own_memory_file(int fd, int seals, std::string_view what);

// What dssmd uses a descriptor for, by the name of its file alone: not checked.
enum class DescriptorKind : unsigned char { other, ring, bell, meta, doorbell, playback_clock };
DescriptorKind kind_of_untrusted(int fd);

// Whether both are the same file.
bool same_file(int fd, int other_fd) noexcept;

// Whether both are descriptors of the same open file, as duplicates are: eventfds all share one
// inode. Also false where kcmp(2) is filtered.
bool same_open_file(int fd, int other_fd) noexcept;

// A second descriptor of the same open file, close-on-exec.
Result<UniqueFd> duplicate(int fd);

}  // namespace dssm::daemon
