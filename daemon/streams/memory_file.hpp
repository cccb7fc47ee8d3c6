// SPDX-License-Identifier: Apache-2.0
//
// What dssmd asks of a descriptor before it takes it for a memory file of its own making.
#pragma once

#include <dssm/result.hpp>
#include <string_view>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

// Whether `fd` is a memfd that dssmd's own user created and that carries all of `seals` (F_SEAL_*).
// Nobody else can make such a file, short of root and other programs of that same user. `what`
// names it in the failure: "ring".
//   fails  protocol (no sealed memory file), no_permission (somebody else's)
Result<void> check_own_memory_file(int fd, int seals, std::string_view what);

// What dssmd uses a descriptor for that it made itself; told by its name alone, so that who takes
// it still has to check it.
enum class DescriptorKind : unsigned char { other, ring, bell, meta, doorbell, playback_clock };
DescriptorKind kind_of_untrusted(int fd);

// Whether both stand for the same file.
bool same_file(int fd, int other_fd) noexcept;

// Whether both are descriptors of the same open file, as duplicates are: eventfds all share one
// inode. False also where the kernel does not tell (kcmp(2) may be filtered).
bool same_open_file(int fd, int other_fd) noexcept;

// A second descriptor of the same open file, close-on-exec.
Result<UniqueFd> duplicate(int fd);

}  // namespace dssm::daemon
