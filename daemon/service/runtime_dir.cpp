// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/runtime_dir.hpp"

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>

#include <cerrno>

namespace dssm::daemon {

Result<RuntimeDir> RuntimeDir::open(const std::string& path) {
  const std::string what = "use the runtime folder '" + path + "'";
  if (::mkdir(path.c_str(), 0755) == 0) {
    // The umask may have taken more than others' write permission.
    if (::chmod(path.c_str(), 0755)) return os_error(what);
  } else if (errno != EEXIST) {
    Error error = os_error(what + ": create it");
    error.message += "; create it first or choose another one with --runtime-dir";
    return error;
  }
  UniqueFd lock(::open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!lock) {
    Error error = os_error(what);
    error.message += "; choose another one with --runtime-dir";
    return error;
  }
  if (::flock(lock.get(), LOCK_EX | LOCK_NB)) {
    if (errno != EWOULDBLOCK) return os_error(what + ": lock it");
    return Error{Errc::conflict, what +
                                     ": another dssmd is running there already; stop it, or choose "
                                     "another folder with --runtime-dir"};
  }
  return RuntimeDir(path, std::move(lock));
}

}  // namespace dssm::daemon
