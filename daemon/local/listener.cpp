// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/listener.hpp"

#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include "core/base/try.hpp"

namespace dssm::daemon {
namespace {

// Removes the socket of a dssmd that was killed. Returns whether there was one.
Result<bool> remove_stale(const std::string& path) {
  struct stat file {};
  if (::lstat(path.c_str(), &file)) {
    if (errno == ENOENT) return false;
    return os_error("check for an old socket '" + path + "'");
  }
  if (!S_ISSOCK(file.st_mode)) {
    return Error{Errc::conflict,
                 "listen at '" + path + "': there is a file that is not a socket; move it"};
  }
  if (::unlink(path.c_str())) return os_error("remove the old socket '" + path + "'");
  return true;
}

}  // namespace

Result<Listener> Listener::open(const std::string& path, std::optional<gid_t> group, mode_t mode,
                                UniqueFd inherited) {
  const std::string what = "listen at '" + path + "'";
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (path.size() >= sizeof address.sun_path) {
    return Error{Errc::invalid_argument,
                 what +
                     ": the path is longer than the 107 bytes that a socket's address takes; "
                     "choose a shorter folder with --runtime-dir"};
  }
  std::memcpy(address.sun_path, path.data(), path.size());
  if (inherited) {
    Listener listener(path, std::move(inherited));
    listener.inherited_ = true;
    DSSM_TRY(listener.allow(group, mode));
    return listener;
  }
  const bool stale = DSSM_TRY(remove_stale(path));
  UniqueFd fd(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  if (!fd) return os_error(what);
  if (::bind(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address)) {
    return os_error(what);
  }
  Listener listener(path, std::move(fd));
  listener.predecessor_died_ = stale;
  DSSM_TRY(listener.allow(group, mode));
  if (::listen(listener.fd(), SOMAXCONN)) return os_error(what);
  return listener;
}

Result<void> Listener::allow(std::optional<gid_t> group, mode_t mode) const {
  const std::string what = "listen at '" + path_ + "'";
  struct stat file {};
  if (::stat(path_.c_str(), &file)) return os_error(what);
  if (group && *group != file.st_gid && ::chown(path_.c_str(), static_cast<uid_t>(-1), *group)) {
    Error error = os_error(what + ": give it to group " + std::to_string(*group));
    error.message +=
        "; dssmd's user has to own the socket (SocketUser=) and be a member of "
        "socket_group";
    return error;
  }
  if (mode != (file.st_mode & 07777) && ::chmod(path_.c_str(), mode)) {
    return os_error(what + ": set its permissions (key socket_mode)");
  }
  return {};
}

Listener::~Listener() {
  if (fd_ && !inherited_) ::unlink(path_.c_str());
}

}  // namespace dssm::daemon
