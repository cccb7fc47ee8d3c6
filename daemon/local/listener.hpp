// SPDX-License-Identifier: Apache-2.0
//
// The Unix socket that programs of this PC connect to. Whoever holds one also holds the lock on its
// folder (RuntimeDir), so a socket file that is there already belongs to a dssmd that died.
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <optional>
#include <string>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

class Listener {
 public:
  // Listens at `path` with that group (none: leave it) and mode; nobody can connect before both are
  // set.
  static Result<Listener> open(const std::string& path, std::optional<gid_t> group, mode_t mode);

  Listener(Listener&&) = default;
  Listener& operator=(Listener&&) = delete;
  ~Listener();  // removes the socket file

  int fd() const noexcept { return fd_.get(); }

  // A socket file was there: the dssmd before this one did not end properly.
  bool predecessor_died() const noexcept { return predecessor_died_; }

 private:
  Listener(std::string path, UniqueFd fd, bool predecessor_died)
      : path_(std::move(path)), fd_(std::move(fd)), predecessor_died_(predecessor_died) {}
  std::string path_;
  UniqueFd fd_;
  bool predecessor_died_;
};

}  // namespace dssm::daemon
