// SPDX-License-Identifier: Apache-2.0
//
// One descriptor for poll() and event libraries that stands for a connection which comes and goes:
// readable when its socket is, or when the time has come to try again.
#pragma once

#include <dssm/result.hpp>
#include <dssm/time.hpp>

#include "core/base/unique_fd.hpp"

namespace dssm::detail {

// A resource with one owner.
class Readiness {
 public:
  static Result<Readiness> make();

  // What fd() stands for from now on: `socket` (-1: none) with poll's `events`, and `at`.
  void follow(int socket, short events, MonoTime at) noexcept;
  int fd() const noexcept { return epoll_.get(); }

 private:
  Readiness() = default;
  UniqueFd epoll_, timer_;
};

}  // namespace dssm::detail
