// SPDX-License-Identifier: Apache-2.0
//
// One descriptor for poll() and event libraries that covers a connection across reconnects:
// readable when its socket is ready, or when the next attempt is due.
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>

#include "core/base/unique_fd.hpp"

namespace dssm::detail {

// A resource with one owner.
class Readiness {
 public:
  static Result<Readiness> make();

  // From now on fd() covers `socket` (-1: none) with poll's `events`, and the time `at`.
  void follow(int socket, short events, MonoTime at) noexcept;
  int fd() const noexcept { return epoll_.get(); }

 private:
  Readiness() = default;
  UniqueFd epoll_, timer_;
};

}  // namespace dssm::detail
