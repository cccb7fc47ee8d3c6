// SPDX-License-Identifier: Apache-2.0
//
// The player's side of lockstep (core/clock/lockstep_page.hpp): starts programs, and gives their
// threads turns.
//
// All programs wait when each of their threads sleeps in the kernel and those that have a place in
// the page wait there. The other threads count because a program may pass on what it has read.
// A thread that has a place but sleeps elsewhere, as in pthread_join(), is waited for kElsewhere
// once; after that it counts as one that waits. What it does then is in no fixed order.
#pragma once

#include <sys/types.h>

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <memory>
#include <set>
#include <string>
#include <vector>

#include "client/dssmctl/output.hpp"
#include "core/base/sealed_memory.hpp"
#include "core/base/unique_fd.hpp"
#include "core/clock/lockstep_page.hpp"

namespace dssm::ctl {

// Not thread-safe.
class Lockstep {
 public:
  // Starts each of `commands` by the shell, with nothing to read on standard input. They use the
  // dssmd at `socket_path` (empty: the default).
  //   fails  system, no_memory
  static Result<std::unique_ptr<Lockstep>> start(const std::vector<std::string>& commands,
                                                 const std::string& socket_path, Time begin,
                                                 Output& out);
  Lockstep(const Lockstep&) = delete;
  Lockstep& operator=(const Lockstep&) = delete;
  // Ends the programs that still run.
  ~Lockstep();

  // The functions below return false when playing is over: Ctrl-C, or all programs have ended.
  //   fails  unavailable (a program failed, or does not wait where it must)

  // Waits until each program waits for the first time.
  Result<bool> await_start();
  // Gives turns until no program has anything more to do.
  Result<bool> settle();
  // Advances the playback time to `time`, in steps: first to each time until which a thread sleeps.
  //   set_clock  sets the playback clock
  Result<bool> advance(Time time, const std::function<void(Time)>& set_clock);

  // The recording is over: the programs get SIGINT, as by Ctrl-C, and are awaited.
  //   fails  unavailable (one ended with a failure)
  Result<void> finish();

 private:
  static constexpr Duration kMaxStartTime = std::chrono::seconds(30);
  static constexpr Duration kStartNotice = std::chrono::seconds(3);
  // At the start threads come one after the other: nothing may change for so long.
  static constexpr Duration kStartQuiet = std::chrono::milliseconds(200);
  static constexpr Duration kElsewhere = std::chrono::seconds(1);
  static constexpr Duration kEndTime = std::chrono::seconds(5);  // per signal

  struct Program {
    std::string command;
    UniqueFd memory;
    SharedMapping mapping;
    pid_t process = -1;
    bool runs = false;
    int status = 0;
    std::set<pid_t> processes;        // that have had a place
    std::set<pid_t> elsewhere;        // threads with a place that sleep in another way
    std::uint32_t lost_requests = 0;  // that will not end
    clock::LockstepPage& page() const noexcept { return mapping.as<clock::LockstepPage>(); }
  };

  explicit Lockstep(Output& out) noexcept : out_(out) {}

  Result<void> start_program(const std::string& command, const std::string& socket_path,
                             Time begin);
  // Sleeps until a program rings or one may have ended, or for `time`. False: must stop.
  bool pause(Duration time);
  bool is_waiting(Program& program, bool with_all_threads, bool accept_elsewhere);
  // Until all of `program` waits.
  Result<bool> await(Program& program, bool with_all_threads);
  // Which programs have ended, and how. False: none is left.
  Result<bool> check_ends();
  static std::uint64_t turns_taken(const Program& program) noexcept;
  bool await_ends();
  void signal_all(int number);

  Output& out_;
  UniqueFd bell_;  // eventfd, which all programs ring
  std::vector<std::unique_ptr<Program>> programs_;
  bool noticed_elsewhere_ = false;
};

}  // namespace dssm::ctl
