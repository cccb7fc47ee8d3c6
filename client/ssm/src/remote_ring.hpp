// SPDX-License-Identifier: Apache-2.0
//
// The samples of another PC's stream, collected in a ring of this process: a thread with a
// subscription fills the ring, and readers read it without the network. It holds each sample, in
// order, as long as the connection is fast enough; lost samples leave a gap.
//
// The ring is a copy like dssmd's mirrors, but its tids keep rising when the stream restarts, so
// that loops of old programs continue. No thread sleeps on it, so it has no bell.
#pragma once

#include <pthread.h>
#include <sys/types.h>

#include <dssm/pconnector.hpp>
#include <memory>

#include "core/base/unique_fd.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/ring_reader.hpp"

namespace dssm::ssm {

// A resource with one owner. A forked child may read what its parent collects; its copy of the
// object does not stop the thread.
class RemoteRing {
 public:
  // Takes over `connector`, which has a subscription. `history` is that of the ring.
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
  UniqueFd stop_;  // eventfd: readable when the thread must end
  const pid_t owner_pid_;
  pthread_t thread_{};
  bool runs_ = false;
};

}  // namespace dssm::ssm
