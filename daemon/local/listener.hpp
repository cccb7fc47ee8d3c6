// SPDX-License-Identifier: Apache-2.0
//
// The Unix socket that programs of this PC connect to. Its owner also holds the lock on the folder
// (RuntimeDir), so an existing socket file is that of a dssmd that was killed, or of a socket that
// the service manager passed. The latter is used as it is and not removed: programs that connect
// while no dssmd runs wait there.
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <optional>
#include <string>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

class Listener {
 public:
  // Listens at `path` with that group (none: keep it) and mode; no program can connect before both
  // are set. inherited: the socket that the service manager passed for `path`; none: makes one.
  static Result<Listener> open(const std::string& path, std::optional<gid_t> group, mode_t mode,
                               UniqueFd inherited = {});

  Listener(Listener&&) = default;
  Listener& operator=(Listener&&) = delete;
  ~Listener();  // removes the socket file, unless it was inherited

  int fd() const noexcept { return fd_.get(); }

  // A socket file was there: the dssmd before this one did not end properly.
  bool predecessor_died() const noexcept { return predecessor_died_; }

  // The service manager passed it. Then it is unknown whether a dssmd ran before.
  bool inherited() const noexcept { return inherited_; }

 private:
  Listener(std::string path, UniqueFd fd) : path_(std::move(path)), fd_(std::move(fd)) {}
  Result<void> allow(std::optional<gid_t> group, mode_t mode) const;
  std::string path_;
  UniqueFd fd_;
  bool predecessor_died_ = false;
  bool inherited_ = false;
};

}  // namespace dssm::daemon
