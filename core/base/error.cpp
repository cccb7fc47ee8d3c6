// SPDX-License-Identifier: Apache-2.0
#include <cerrno>
#include <dssm/error.hpp>
#include <dssm/sample.hpp>
#include <system_error>

namespace dssm {

std::string_view errc_name(Errc code) noexcept {
  switch (code) {
    case Errc::invalid_argument:
      return "invalid_argument";
    case Errc::not_found:
      return "not_found";
    case Errc::already_exists:
      return "already_exists";
    case Errc::type_mismatch:
      return "type_mismatch";
    case Errc::limit_exceeded:
      return "limit_exceeded";
    case Errc::no_memory:
      return "no_memory";
    case Errc::no_permission:
      return "no_permission";
    case Errc::no_daemon:
      return "no_daemon";
    case Errc::daemon_away:
      return "daemon_away";
    case Errc::protocol:
      return "protocol";
    case Errc::conflict:
      return "conflict";
    case Errc::closed:
      return "closed";
    case Errc::system:
      return "system";
  }
  return "system";
}

std::string_view status_name(ReadStatus status) noexcept {
  switch (status) {
    case ReadStatus::ok:
      return "ok";
    case ReadStatus::not_yet:
      return "not_yet";
    case ReadStatus::too_old:
      return "too_old";
    case ReadStatus::lapped:
      return "lapped";
    case ReadStatus::restarted:
      return "restarted";
  }
  return "lapped";
}

Error os_error(std::string_view what) { return os_error(what, errno); }

Error os_error(std::string_view what, int errno_value) {
  Errc code = Errc::system;
  if (errno_value == EACCES || errno_value == EPERM) code = Errc::no_permission;
  if (errno_value == ENOMEM || errno_value == ENOSPC) code = Errc::no_memory;
  return Error{code, std::string(what) + ": " + std::generic_category().message(errno_value)};
}

}  // namespace dssm
