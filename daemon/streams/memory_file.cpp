// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/memory_file.hpp"

#include <fcntl.h>
#include <linux/kcmp.h>
#include <sys/stat.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <string>

#include "core/base/sealed_memory.hpp"

namespace dssm::daemon {

Result<void> check_own_memory_file(int fd, int seals, std::string_view what) {
  const std::string name = "the offered " + std::string(what);
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("look at " + name);
  if (!has_seals(fd, seals)) {
    return Error{Errc::protocol, name + " is not a sealed memory file that dssmd created"};
  }
  if (file.st_uid != ::geteuid()) {
    return Error{Errc::no_permission, name + " belongs to user " + std::to_string(file.st_uid) +
                                          ", not to dssmd's user " + std::to_string(::geteuid()) +
                                          ": dssmd did not create it"};
  }
  return {};
}

DescriptorKind kind_of_untrusted(int fd) {
  char link[128] = {};  // cut off after the part that is compared
  const std::string path = "/proc/self/fd/" + std::to_string(fd);
  if (::readlink(path.c_str(), link, sizeof link - 1) < 0) return DescriptorKind::other;
  const std::string_view name(link);
  if (name.starts_with("/memfd:dssm-ring:")) return DescriptorKind::ring;
  if (name.starts_with("/memfd:dssm-bell ")) return DescriptorKind::bell;
  if (name.starts_with("/memfd:dssm-meta ")) return DescriptorKind::meta;
  if (name.starts_with("/memfd:dssm-playback-clock ")) return DescriptorKind::playback_clock;
  if (name == "anon_inode:[eventfd]") return DescriptorKind::doorbell;
  return DescriptorKind::other;
}

bool same_file(int fd, int other_fd) noexcept {
  struct stat one {
  }, other{};
  return ::fstat(fd, &one) == 0 && ::fstat(other_fd, &other) == 0 && one.st_dev == other.st_dev &&
         one.st_ino == other.st_ino;
}

bool same_open_file(int fd, int other_fd) noexcept {
  const pid_t self = ::getpid();
  return ::syscall(SYS_kcmp, self, self, KCMP_FILE, fd, other_fd) == 0;
}

Result<UniqueFd> duplicate(int fd) {
  UniqueFd copy(::fcntl(fd, F_DUPFD_CLOEXEC, 0));
  if (!copy) return os_error("duplicate a descriptor");
  return copy;
}

}  // namespace dssm::daemon
