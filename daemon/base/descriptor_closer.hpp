// SPDX-License-Identifier: Apache-2.0
//
// Closes descriptors that came from a program, in a thread. close() may wait for as long as that
// program likes, also of a descriptor that does not block: that of a TCP socket with SO_LINGER, of
// a file that a program serves (FUSE), and of a Unix socket in which such ones wait unread.
#pragma once

#include <cstddef>
#include <memory>
#include <vector>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

// One thread, which runs while there is something to close. Its owner bounds how much that is: see
// unclosed().
class DescriptorCloser {
 public:
  DescriptorCloser();
  DescriptorCloser(const DescriptorCloser&) = delete;
  DescriptorCloser& operator=(const DescriptorCloser&) = delete;

  // Closes them after all that it has.
  void close(std::vector<UniqueFd> group);

  // How many groups are not closed yet.
  std::size_t unclosed() const;

  // Starts the thread if there is something to close and no thread could be had before.
  void go_on();

 private:
  struct Shared;
  static void work(Shared& shared);

  std::shared_ptr<Shared> shared_;  // with the thread, which may outlive this
};

}  // namespace dssm::daemon
