// SPDX-License-Identifier: Apache-2.0
//
// `dssmctl doctor` in three steps: collect facts, make findings of them, and print these.
#pragma once

#include <cstdint>
#include <dssm/session.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <vector>

#include "client/dssmctl/options.hpp"

namespace dssm::ctl {

// --- facts

// The socket of dssmd, as the file system shows it.
struct SocketFacts {
  enum class Kind : std::uint8_t { missing, socket, something_else, hidden };
  std::string path;
  bool chosen = false;            // by --socket or $DSSM_SOCKET
  Kind kind = Kind::missing;      // hidden: this user may not read its folder
  std::string group;              // that may connect; empty: not known
  bool user_in_group = false;     // by the system's list of groups
  bool process_in_group = false;  // as of its login
};

// Numbers of the machine; 0: not known.
struct MemoryFacts {
  std::uint64_t total_bytes = 0, available_bytes = 0;
};

struct DescriptorFacts {
  std::uint64_t soft_limit = 0;  // of dssmd; 0: not known
};

struct DiskFacts {
  std::string path;
  std::uint64_t total_bytes = 0, free_bytes = 0;  // free for programs of ordinary users
};

// The clock of this PC, as chronyc reports it.
struct ClockFacts {
  enum class State : std::uint8_t { no_chrony, no_answer, unsynchronized, synchronized };
  State state = State::no_chrony;
  std::string detail;   // what chronyc printed; the source when synchronized
  bool serves = false;  // the Ansible role made this PC serve its clock to the others
};

struct Facts {
  std::string user;     // who runs dssmctl
  bool systemd = true;  // this PC was started by it, so that systemctl works
  std::string service;  // of dssmd, as `systemctl is-active` prints it; empty: not known
  std::string version;  // of dssmctl and its library
  SocketFacts socket;
  std::optional<Error> failed;  // why dssmd does not answer; then there is nothing of these three:
  DaemonInfo daemon;
  std::vector<HostInfo> hosts;      // this one first
  std::vector<StreamInfo> streams;  // of all hosts
  MemoryFacts memory;
  DescriptorFacts descriptors;
  bool avahi_installed = false;
  bool avahi_running = false;
  ClockFacts clock;
  std::vector<DiskFacts> disks;
};

// Asks dssmd, the kernel, systemctl and chronyc; takes some seconds when one of them hangs.
Facts collect_facts(const CommonOptions& options);

// What `chronyc -c tracking` printed, taken apart.
ClockFacts clock_facts_untrusted(int exit_status, const std::string& output);

// The soft limit of open files in the text of /proc/PID/limits; 0: it is not there.
std::uint64_t soft_limit_untrusted(const std::string& limits);

// --- asking another program of this PC, one that answers in a few lines and at once

struct ProgramEnd {
  bool in_time = true;   // else it was killed
  int exit_status = -1;  // -1: ended by a signal
  std::string output;    // standard output and error, at most kMaxProgramOutput bytes
};

inline constexpr std::size_t kMaxProgramOutput = 64U << 10;

// Runs `argv` (found by $PATH) without input until it ends, or kills it after `timeout`. Nothing
// when there is no such program.
std::optional<ProgramEnd> run_program(std::vector<std::string> argv, Duration timeout);

// --- findings: a pure function of the facts, so that tests can give any

struct Finding {
  // warn: it works, but not as well or not as long as it could; fail: something does not work.
  enum class Status : std::uint8_t { ok, warn, fail };
  std::string name;  // of the check: "daemon", "mdns", "host pc2"
  Status status = Status::ok;
  std::string text;          // what was found
  std::string cause = {};    // the likely one; empty when ok
  std::string command = {};  // that fixes it, or shows more; empty when ok

  void fail(std::string likely_cause, std::string helpful_command) {
    warn(std::move(likely_cause), std::move(helpful_command));
    status = Status::fail;
  }
  void warn(std::string likely_cause, std::string helpful_command) {
    status = Status::warn;
    cause = std::move(likely_cause);
    command = std::move(helpful_command);
  }
};

// The part of it about streams.
void check_streams(const Facts& facts, std::vector<Finding>& findings);

// In the order of a person's search: dssmd, this PC, the others. While dssmd does not answer, there
// are no findings about what only it knows.
std::vector<Finding> findings_of(const Facts& facts);

Json findings_json(const std::vector<Finding>& findings);

}  // namespace dssm::ctl
