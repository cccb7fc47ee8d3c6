// SPDX-License-Identifier: Apache-2.0
//
// What dssmd asks of the operating system for itself.
#pragma once

#include <signal.h>

namespace dssm::daemon {

// Raises the number of descriptors this process may have to what its user allows: each stream takes
// four, each client one.
void raise_descriptor_limit() noexcept;

// A program that vanished while it was written to is an error code, not the end.
void ignore_broken_pipes() noexcept;

// libprotobuf writes a line to stderr for each malformed string that a client sends: unbounded, and
// waiting where nobody reads stderr. dssmd says itself what it refuses.
void silence_protobuf() noexcept;

// What is freed in large pieces goes back to the system at once: otherwise the C library learns
// from a few answers of 16 MiB to keep such pieces, and what peers made dssmd use stays used.
void return_large_memory() noexcept;

// Keeps requests to stop or to read the configuration anew (SIGINT, SIGTERM, SIGHUP) for later,
// while dssmd starts: whoever sees its socket may send one, and dssmd ends as it always does. For
// one thread, before there are others; those that it starts meanwhile never take one.
class HeldRequests {
 public:
  HeldRequests() noexcept;
  HeldRequests(const HeldRequests&) = delete;
  HeldRequests& operator=(const HeldRequests&) = delete;
  ~HeldRequests() { deliver(); }

  // What has come, and what comes from now on. A second call does nothing.
  void deliver() noexcept;

 private:
  sigset_t before_;
};

}  // namespace dssm::daemon
