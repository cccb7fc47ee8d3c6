// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fcntl.h>
#include <sys/socket.h>

#include <utility>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {

// A descriptor kept back for the time when none is left: without one a waiting peer could not even
// be refused, and the loop would turn for nothing.
class SpareDescriptor {
 public:
  SpareDescriptor() : fd_(make()) {}

  // Accepts the next connection of `listener` in its place and hands it to `refuse`, which closes
  // it.
  template <class Refuse>
  void accept_to_refuse(int listener, Refuse refuse) {
    fd_.reset();
    UniqueFd socket(::accept4(listener, nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
    if (socket) refuse(std::move(socket));
    fd_ = make();
  }

 private:
  static UniqueFd make() { return UniqueFd(::open("/dev/null", O_RDONLY | O_CLOEXEC)); }
  UniqueFd fd_;
};

}  // namespace dssm::daemon
