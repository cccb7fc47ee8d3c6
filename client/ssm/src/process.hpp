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
#include <dssm/playback_clock.hpp>
#include <dssm/session.hpp>
#include <mutex>
#include <optional>

#include "../include/libssm.h"
#include "handle_table.hpp"
#include "messages.hpp"
#include "stream.hpp"

namespace dssm::ssm {

// A sid has a pointer type, but holds a handle of this table. Kept with each place: what
// shm_get_address() shows.
using SidTable = HandleTable<Stream, ssm_header>;

// The playback clock that this process has attached, or none, and the `timecontrol` of <libssm.h>.
//
//   threads  attach() and reap() under one lock; the rest from any thread and from signal handlers
class SharedClock {
 public:
  // `wake` is posted when there is something to reap.
  explicit SharedClock(sem_t& wake) noexcept : clocks_(wake) {}

  bool attached() const noexcept { return current_.load() != 0; }
  void attach(PlaybackClock clock, std::uint64_t process_generation);
  void detach() noexcept;
  void reap(std::uint64_t process_generation) { clocks_.reap(process_generation); }
  void reset_after_fork(int parents_thread) noexcept {
    clocks_.reset_after_fork(parents_thread, [](PlaybackClock&) {});
  }

  // The setting; offset 0, speed 1 without a clock.
  PlaybackClock::Setting setting() noexcept {
    return change([](PlaybackClock&) {}).value_or(PlaybackClock::Setting{});
  }

  // Empty without a clock.
  std::optional<double> now_s() noexcept {
    while (const Clocks::Handle handle = current_.load()) {
      const Clocks::Turn use(clocks_, handle);
      if (use) return use->now_s();
    }
    return std::nullopt;
  }

  // Calls change(clock) and shows the setting that follows through timecontrol; nothing without a
  // clock.
  template <class Change>
  std::optional<PlaybackClock::Setting> change(Change change) noexcept {
    while (const Clocks::Handle handle = current_.load()) {
      const Clocks::Turn use(clocks_, handle);
      if (!use) continue;  // detached meanwhile: current_ has changed before
      change(*use);
      const PlaybackClock::Setting setting = use->setting();
      show(setting);
      return setting;
    }
    return std::nullopt;
  }

 private:
  using Clocks = HandleTable<PlaybackClock>;

  static void show(const PlaybackClock::Setting& setting) noexcept;

  Clocks clocks_;  // the current one, and those that were detached while they were used
  std::atomic<Clocks::Handle> current_{0};
};

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

  // request(session), whose failure is kept for errSSM().
  template <class Request>
  auto request(Request request) -> decltype(request(std::declval<Session&>())) {
    Result<Session> registered = session();
    auto answer = registered ? request(*registered) : std::move(registered).error();
    if (!answer) remember_error(answer.error().message);
    return answer;
  }

  // The session, or a temporary one: for sids that outlive endSSM, and for calls that need no
  // initSSM.
  Result<Session> any_session();

  // A sid for the stream; null when too many are open.
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
  Result<void> attach_clock_locked();
  void reap_locked();
  bool registered_locked() const noexcept;

  sem_t wake_{};
  std::mutex mutex_;  // guards what is not atomic
  bool handlers_ = false;
  std::atomic<bool> reaper_{false};
  std::uint64_t generation_ = 1;  // rises with each fork
  Registration* registration_ = nullptr;
  Registration* abandoned_ = nullptr;  // keeps the parents' reachable for leak checkers
  // Between at_exit() and the reaper: the next round is its last, and is over.
  std::atomic<bool> exiting_{false}, ended_{false};
  std::atomic<std::uint64_t> ends_{0};
  std::atomic<bool> was_registered_{false};
  char socket_path_[108] = {};  // where; written before was_registered_
  SidTable sids_;
  SharedClock clock_;
};

Process& process() noexcept;

inline SidTable::Handle handle_of(SSM_sid sid) noexcept {
  return reinterpret_cast<std::uintptr_t>(sid);
}

// The sid's stream during a call.
class SidTurn : public SidTable::Turn {
 public:
  explicit SidTurn(SSM_sid sid, bool may_be_alone = true) noexcept
      : Turn(process().sids(), handle_of(sid), may_be_alone) {}
};

// The same during a wait, in which other threads have their turns.
class SidUse : public SidTable::Use {
 public:
  explicit SidUse(SSM_sid sid) noexcept : Use(process().sids(), handle_of(sid)) {}
};

}  // namespace dssm::ssm
