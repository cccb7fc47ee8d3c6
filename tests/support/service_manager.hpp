// SPDX-License-Identifier: Apache-2.0
//
// A fake systemd: starts dssmd like dssmd.service, passes its Unix socket, receives its messages
// ($NOTIFY_SOCKET), and keeps descriptors over restarts. It imitates these parts of systemd 252:
//
//   store      accepts new descriptors (each open file once) up to a maximum, passes all of them at
//              each start, and is emptied at stop()
//   passing    $LISTEN_FDS, $LISTEN_FDNAMES, $LISTEN_PID; the socket first, then the store
//   watchdog   $WATCHDOG_USEC
//
// Its functions may be called from one thread; a thread of its own receives messages.
#pragma once

#include <sys/types.h>

#include <condition_variable>
#include <functional>
#include <map>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "core/base/unique_fd.hpp"

namespace dssm::test {

class ServiceManager {
 public:
  struct Options {
    // dssmd's arguments besides runtime folder and name. Unless they set an address, dssmd listens
    // at a free port of 127.0.0.1, and at the same one after a restart.
    std::vector<std::string> arguments = {};
    std::string host = "pc1";
    bool socket = true;                  // creates and passes the Unix socket
    std::vector<int> more_sockets = {};  // also passed, as "other"; owned by the caller
    std::size_t store_max = 32'000;      // FileDescriptorStoreMax=
    int watchdog_us = 0;                 // WatchdogSec=; 0: none. dssmd is never killed
  };

  // Starts dssmd and waits until it is ready.
  explicit ServiceManager(Options options);
  ServiceManager() : ServiceManager(Options{}) {}
  ServiceManager(const ServiceManager&) = delete;
  ServiceManager& operator=(const ServiceManager&) = delete;
  ~ServiceManager();  // kills it, removes the folder

  const std::string& runtime_dir() const { return dir_; }
  std::string socket_path() const { return dir_ + "/dssmd.sock"; }
  pid_t pid() const { return pid_; }
  std::string address();  // the first address at which it listens for other hosts

  // Ends and starts of dssmd; start() and restart() return when it is ready.
  void kill_hard();  // SIGKILL; no restart, the store is kept
  int stop();        // systemctl stop: SIGTERM, its exit status; the store is emptied
  void start();      // after either of them
  void restart();    // systemctl restart: SIGTERM and a start, the store is kept
  void forget_more_sockets() { options_.more_sockets.clear(); }
  void rename_host(const std::string& host) { options_.host = host; }  // from the next start on
  void set_arguments(const std::vector<std::string>& arguments) {      // likewise
    options_.arguments = arguments;
  }
  // kill(2); for SIGHUP, SIGSTOP ...
  void signal(int number) const;

  // Waits until `is_so` of all messages since dssmd's last start, oldest first.
  using Messages = std::vector<std::string>;
  void await(const std::function<bool(const Messages&)>& is_so);
  Messages messages();
  // Waits until the status line contains `text`.
  void await_status(const std::string& text);
  // Whether a message with `text` arrives within the time.
  bool says_within(const std::string& text, std::chrono::milliseconds time);

  // The number of descriptors in the store, by name, after all messages sent before this call.
  std::map<std::string, std::size_t> stored();
  std::size_t stored_descriptors();
  void await_stored(std::size_t descriptors);  // for many, which take some time
  // Adds a descriptor that dssmd did not send.
  void put_into_store(const std::string& name, UniqueFd fd);
  // How many received descriptors were in the store already.
  int doubled();

 private:
  struct Stored {
    std::string name;
    UniqueFd fd;
    ino_t inode = 0;  // to find different files quickly
  };

  int end(int number);
  void listen();
  void drain();  // with the mutex held
  void take(const std::string& text, std::vector<UniqueFd> fds);

  Options options_;
  std::string dir_;
  UniqueFd notify_, local_, stop_listening_;
  std::mutex mutex_;
  std::condition_variable changed_;
  Messages messages_;
  std::string status_;
  std::vector<Stored> store_;
  int doubled_ = 0;
  pid_t pid_ = -1;
  std::thread thread_;
};

}  // namespace dssm::test
