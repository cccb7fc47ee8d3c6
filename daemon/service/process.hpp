// SPDX-License-Identifier: Apache-2.0
//
// The dssmd process: descriptor limit, signals, memory, and the folder that it works in.
#pragma once

#include <signal.h>

#include <dssm/result.hpp>
#include <string>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

// Raises the number of descriptors this process may have to what its user allows: each stream takes
// four, each client one.
void raise_descriptor_limit() noexcept;

// Writing to a closed connection returns an error instead of ending dssmd (SIGPIPE).
void ignore_broken_pipes() noexcept;

// Keeps libprotobuf from writing a line to stderr for each malformed string that a client sends:
// that has no limit, and it blocks when stderr is a full pipe. dssmd logs what it refuses.
void silence_protobuf() noexcept;

// Returns large freed blocks to the system at once. Otherwise the C library raises its threshold
// after a few long lists and keeps such blocks, so peers could make dssmd's memory grow.
void return_large_memory() noexcept;

// Blocks SIGINT, SIGTERM and SIGHUP while dssmd starts, so that one which is sent as soon as the
// socket exists still ends or reloads dssmd in the usual way. To be used by the first thread,
// before it starts others; threads started meanwhile never receive these signals.
class BlockedSignals {
 public:
  BlockedSignals() noexcept;
  BlockedSignals(const BlockedSignals&) = delete;
  BlockedSignals& operator=(const BlockedSignals&) = delete;
  ~BlockedSignals() { deliver(); }

  // Delivers those that arrived, and all from now on. A second call does nothing.
  void deliver() noexcept;

 private:
  sigset_t before_;
};

// The folder that a dssmd works in, and the lock that makes it the only one there. The lock is an
// flock() on the folder itself: it leaves no file and the kernel drops it however dssmd
// ends.
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
