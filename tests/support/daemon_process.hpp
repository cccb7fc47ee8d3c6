// SPDX-License-Identifier: Apache-2.0
//
// A dssmd for one test, with its own runtime folder and socket; ended by its pid.
#pragma once

#include <sys/resource.h>
#include <sys/types.h>

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "tests/support/sanitized.hpp"

namespace dssm::test {

// The path of a built file, e.g. built("daemon/dssmd"); from $DSSM_BUILD_ROOT, which meson
// sets for every test.
std::string built(const std::string& path);

// The path of a file of the sources, from $DSSM_SOURCE_ROOT likewise.
std::string source(const std::string& path);

// A new empty folder below /tmp (short enough for socket paths); remove_tree() removes it.
std::string make_temp_dir();
void remove_tree(const std::string& path);

// Runs a program to its end. `environment` adds to this process's: {"NAME=value"}.
struct Finished {
  int exit_status = -1;  // as a shell shows it: 128 + signal
  std::string out, err;
};
Finished run(const std::vector<std::string>& argv, const std::vector<std::string>& environment = {},
             const std::string& input = {});

// Starts a program in the background. Its output goes to this test's stderr, or its stdout to
// `out_fd` if >= 0; wait_for() returns its status, as a shell shows it.
pid_t start(const std::vector<std::string>& argv, const std::vector<std::string>& environment = {},
            int out_fd = -1);
int wait_for(pid_t pid);

// A port of loopback that is free at this moment, for SOCK_DGRAM or SOCK_STREAM.
std::uint16_t free_port(int socket_type);
// The same, which nobody else is given while the socket is open; whoever sets SO_REUSEADDR, as
// dssmd does, may listen there. The caller closes the socket.
std::pair<int, std::uint16_t> reserve_port(int socket_type);

// For a child of a test that runs as root: makes it the user nobody, in these groups only; ends it
// with status 100 when that fails.
inline constexpr uid_t kNobody = 65534;
void become_nobody(const std::vector<gid_t>& groups);

// While it exists, the system gives the process no more than so much memory besides what it has.
class MemoryLimit {
 public:
  MemoryLimit(pid_t pid, std::uint64_t more_bytes);
  MemoryLimit(const MemoryLimit&) = delete;
  MemoryLimit& operator=(const MemoryLimit&) = delete;
  ~MemoryLimit();

 private:
  pid_t pid_;
  rlimit before_{};
};
// Sanitizers need memory themselves, and keep for a while what was freed.
inline constexpr bool kMemoryIsMeasurable = !kIsSanitized;

// For a dssmd that is killed while programs wait to recreate its streams: on a machine where many
// tests run at once, programs need more than the default of 500 ms to offer their rings.
inline const std::vector<std::string> kPatientRecovery = {"--recovery-grace", "3 s"};

// A folder with credentials for the host `name` of one vehicle, which is that of the whole test
// program; made by dssmctl, removed when the program ends.
std::string credentials_for(const std::string& name);
// Whether connections between hosts are encrypted in this run: $DSSM_TEST_TLS is set.
bool tests_tls();
// The same for a program.
std::string credentials_for_program(const std::string& name);
// The folder of that vehicle's authority.
std::string authority_folder();
// Runs `dssmctl pki WORDS...`; ends the test program with a message if it fails.
void pki(std::vector<std::string> words);

class DaemonProcess {
 public:
  // Starts `dssmd --runtime-dir DIR --name HOST extra...` and waits until it is ready (sd_notify's
  // READY=1). Ends the test program with a message if dssmd does not start. Unless `extra` sets
  // them, dssmd listens for other hosts at a free port of 127.0.0.1, does not use mDNS, so that the
  // network does not see the test, and finds no chronyd. With $DSSM_TEST_TLS its connections are
  // encrypted.
  explicit DaemonProcess(std::vector<std::string> extra = {}, const std::string& host = "pc1");
  DaemonProcess(const DaemonProcess&) = delete;
  DaemonProcess& operator=(const DaemonProcess&) = delete;
  ~DaemonProcess();  // kills it if it still runs, removes the folder

  const std::string& runtime_dir() const { return dir_; }
  std::string socket_path() const { return dir_ + "/dssmd.sock"; }
  std::string environment() const { return "DSSM_SOCKET=" + socket_path(); }
  pid_t pid() const { return pid_; }

  // The first address at which it listens for other hosts, "127.0.0.1:40123"; the same after a
  // restart.
  std::string address() const { return addresses_.empty() ? "" : addresses_.front(); }
  const std::vector<std::string>& addresses() const { return addresses_; }

  // Ends the test program with a message if dssmd has ended with an error. kill_hard() and the
  // destructor do so, too: else the end of a dssmd would go unnoticed, or be seen as a timeout.
  void expect_no_crash() const;

  void kill_hard();                    // SIGKILL, and waits for its end
  int stop();                          // SIGTERM, and its exit status
  void start();                        // again, in the same folder
  void call(const std::string& host);  // its name from the next start() on

 private:
  std::string dir_;
  std::vector<std::string> argv_;
  std::vector<std::string> addresses_;
  int port_fd_ = -1;  // keeps its port over a restart
  pid_t pid_ = -1;
};

}  // namespace dssm::test
