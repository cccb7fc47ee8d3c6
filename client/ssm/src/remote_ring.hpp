// SPDX-License-Identifier: Apache-2.0
//
// The samples of another PC's stream, collected in a ring of this process: a thread takes a
// subscription and fills the ring, readers read it without the network. Every sample is in it, in
// order, as long as the link keeps up; what was lost is missing, and is told as missing.
//
// The ring is a copy as dssmd keeps them, but its tids go on rising when the stream begins anew, so
// that old programs' loops go on, and nobody sleeps on it, so it has no bell.
#pragma once

#include <pthread.h>
#include <sys/types.h>

#include <dssm/pconnector.hpp>
#include <memory>

#include "core/base/unique_fd.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/ring_reader.hpp"

namespace dssm::ssm {

// A resource with one owner. A forked child may read what its parent collects, and leaves the
// thread alone.
class RemoteRing {
 public:
  // Takes `connector` over, which has a subscription. History: of the ring.
  //   fails  limit_exceeded, no_memory, system
  static Result<std::unique_ptr<RemoteRing>> start(PConnector connector, const History& history);
  RemoteRing(const RemoteRing&) = delete;
  RemoteRing& operator=(const RemoteRing&) = delete;
  ~RemoteRing();

  ring::RingReader reader() const noexcept { return ring::RingReader(*mapping_); }

 private:
  explicit RemoteRing(PConnector connector);
  static void* run(void* self);
  void fill();
  bool pause();

  PConnector connector_;  // the thread's
  std::shared_ptr<const ring::RingMapping> mapping_;
  UniqueFd stop_;  // eventfd: readable when the thread shall end
  const pid_t owner_pid_;
  pthread_t thread_{};
  bool runs_ = false;
};

}  // namespace dssm::ssm
