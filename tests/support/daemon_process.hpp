// SPDX-License-Identifier: Apache-2.0
//
// A dssmd of the test's own: private runtime folder, private socket, ended by its pid.
#pragma once

#include <sys/types.h>

#include <string>
#include <vector>

namespace dssm::test {

// The path of something built here, e.g. built("daemon/dssmd"); from $DSSM_BUILD_ROOT, which meson
// sets for every test.
std::string built(const std::string& path);

// A new empty folder below /tmp (short enough for socket paths); remove_tree() takes it away.
std::string make_temp_dir();
void remove_tree(const std::string& path);

// Runs a program to its end. `environment` adds to this process's: {"NAME=value"}.
struct Finished {
  int exit_status = -1;  // as a shell shows it: 128 + signal
  std::string out, err;
};
Finished run(const std::vector<std::string>& argv, const std::vector<std::string>& environment = {},
             const std::string& input = {});

// Starts a program in the background, its output going to this test's stderr unless `out_fd` >= 0
// names where its stdout goes; wait_for() takes its status, as a shell shows it.
pid_t start(const std::vector<std::string>& argv, const std::vector<std::string>& environment = {},
            int out_fd = -1);
int wait_for(pid_t pid);

// For a dssmd that is killed while others wait to create its streams anew: holders that offer their
// rings get more than dssmd's own 500 ms for it, which is little where many tests run at once.
inline const std::vector<std::string> kPatientRecovery = {"--recovery-grace", "3 s"};

class DaemonProcess {
 public:
  // Starts `dssmd --runtime-dir DIR --name HOST extra...` and waits until it says that it is ready
  // (sd_notify's READY=1). Ends the test program with a text when it does not come up. Unless
  // `extra` says where to listen for other hosts, it is at any free port of 127.0.0.1; and unless
  // it says something of mDNS, there is none: nobody else on this network shall see a test. For
  // the same reason it finds no chronyd.
  explicit DaemonProcess(std::vector<std::string> extra = {}, const std::string& host = "pc1");
  DaemonProcess(const DaemonProcess&) = delete;
  DaemonProcess& operator=(const DaemonProcess&) = delete;
  ~DaemonProcess();  // kills it if it still runs, removes the folder

  const std::string& runtime_dir() const { return dir_; }
  std::string socket_path() const { return dir_ + "/dssmd.sock"; }
  std::string environment() const { return "DSSM_SOCKET=" + socket_path(); }
  pid_t pid() const { return pid_; }

  // Where it listens for other hosts, "127.0.0.1:40123"; the first one. After a restart it is there
  // again.
  std::string address() const { return addresses_.empty() ? "" : addresses_.front(); }
  const std::vector<std::string>& addresses() const { return addresses_; }

  void kill_hard();                    // SIGKILL, and waits for its end
  int stop();                          // SIGTERM, and its exit status
  void start();                        // again, in the same folder
  void call(const std::string& host);  // so from the next start() on

 private:
  std::string dir_;
  std::vector<std::string> argv_;
  std::vector<std::string> addresses_;
  pid_t pid_ = -1;
};

}  // namespace dssm::test
