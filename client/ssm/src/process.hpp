// SPDX-License-Identifier: Apache-2.0
//
// This process as an SSM program: its registration with dssmd (one libdssm Session from initSSM to
// endSSM), its open sids and its clock. One object for the life of the process, never destroyed,
// because other threads may still use it while the program exits.
//
// endSSM and closeSSM run in signal handlers, so they only change atomics and post a semaphore. A
// thread of this library, the reaper, then destroys what they closed; so does each call that takes
// the lock.
//
// A forked child starts without a registration. Streams that it inherits stay readable and writable
// but are never destroyed: they belong to the parent.
#pragma once

#include <semaphore.h>

#include <atomic>
#include <dssm/session.hpp>
#include <mutex>

#include "shared_clock.hpp"
#include "sid_table.hpp"

namespace dssm::ssm {

class Process {
 public:
  Process() noexcept;

  // initSSM: registers this process and attaches the clock. Fails as Session::connect does.
  Result<void> start();

  // endSSM; async-signal-safe. Whether a dssmd listens where this process was registered; false
  // when it never was.
  bool end() noexcept;

  // The session; fails with `closed` before start() and after end(). Call it without the lock.
  Result<Session> session();

  // The session, or a temporary one: for sids that outlive endSSM, and for calls that need no
  // initSSM.
  Result<Session> any_session();

  // A sid for the stream.
  SSM_sid add(std::unique_ptr<Stream> stream);

  // Attaches the clock again; false without a session.
  bool attach_clock();

  SidTable& sids() noexcept { return sids_; }
  SharedClock& clock() noexcept { return clock_; }

 private:
  struct Registration {
    Session session;
    std::uint64_t ends;  // value of ends_ at its start: it has ended when that has changed
    Registration* next;  // in abandoned_
  };

  static void* run_reaper(void* self);
  static void after_fork_in_child();
  static void at_exit();
  Result<void> prepare_locked();
  void reap_locked();
  bool registered_locked() const noexcept;

  sem_t wake_{};
  std::mutex mutex_;  // guards what is not atomic
  bool handlers_ = false;
  bool reaper_ = false;
  std::uint64_t generation_ = 1;  // rises with each fork
  Registration* registration_ = nullptr;
  Registration* abandoned_ = nullptr;  // keeps the parents' reachable for leak checkers
  std::atomic<bool> reaping_{false}, exiting_{false};  // between the reaper and at_exit()
  std::atomic<std::uint64_t> ends_{0};
  std::atomic<bool> was_registered_{false};
  char socket_path_[108] = {};  // where; written before was_registered_
  SidTable sids_;
  SharedClock clock_;
};

Process& process() noexcept;

}  // namespace dssm::ssm
