// SPDX-License-Identifier: Apache-2.0
//
// The folder that a dssmd works in, and the lock that makes it the only one there. The lock is an
// flock() on the folder itself: it leaves no file and the kernel drops it however dssmd
// ends.
#pragma once

#include <dssm/result.hpp>
#include <string>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

class RuntimeDir {
 public:
  // Takes `path`, creating the folder (mode 0755) but not its parents.
  //   fails  conflict (another dssmd works there), os errors
  static Result<RuntimeDir> open(const std::string& path);

  const std::string& path() const noexcept { return path_; }
  std::string socket_path() const { return path_ + "/dssmd.sock"; }
  std::string clock_page_path() const { return path_ + "/clock"; }

 private:
  RuntimeDir(std::string path, UniqueFd lock) : path_(std::move(path)), lock_(std::move(lock)) {}
  std::string path_;
  UniqueFd lock_;
};

}  // namespace dssm::daemon
