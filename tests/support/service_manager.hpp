// SPDX-License-Identifier: Apache-2.0
//
// A small stand-in for systemd: starts dssmd as dssmd.service does, hands its Unix socket over,
// takes its messages ($NOTIFY_SOCKET), and keeps descriptors over restarts. Of systemd 252 it
// repeats what matters here:
//
//   the store  takes what is not in it yet (the same open file counts once) up to a maximum, gives
//              everything back at each start, and is dropped at stop()
//   hand-over  $LISTEN_FDS, $LISTEN_FDNAMES, $LISTEN_PID, the socket first, then the store
//   the watch  $WATCHDOG_USEC
//
// Its functions may be called from one thread; another one, its own, listens.
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
    // Of dssmd, beside runtime folder and name. It listens at any free port of 127.0.0.1 unless
    // they say where, and at the same one after a restart.
    std::vector<std::string> arguments = {};
    std::string host = "pc1";
    bool socket = true;                  // makes and hands over the Unix socket
    std::vector<int> more_sockets = {};  // handed over as well, as "other"; the caller's
    std::size_t store_max = 32'000;      // FileDescriptorStoreMax=
    int watchdog_us = 0;                 // WatchdogSec=; 0: none. Only told, nobody is killed
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
  std::string address();  // the first one where it listens for other hosts

  // The ends of dssmd, and its start; ready when those that start it return.
  void kill_hard();  // SIGKILL; stays dead, the store is kept
  int stop();        // systemctl stop: SIGTERM, its exit status; the store is dropped
  void start();      // after either
  void restart();    // systemctl restart: SIGTERM and a start, the store is kept
  void forget_more_sockets() { options_.more_sockets.clear(); }
  void rename_host(const std::string& host) { options_.host = host; }  // from the next start on
  void set_arguments(const std::vector<std::string>& arguments) {      // likewise
    options_.arguments = arguments;
  }
  // kill(2); for SIGHUP, SIGSTOP ...
  void signal(int number) const;

  // Waits until `is_so` of all that dssmd said since its last start, oldest first.
  using Messages = std::vector<std::string>;
  void await(const std::function<bool(const Messages&)>& is_so);
  Messages messages();
  // Waits for the status line to hold `text`.
  void await_status(const std::string& text);
  // Whether a message with `text` comes within the time.
  bool says_within(const std::string& text, std::chrono::milliseconds time);

  // In the store now: by name, how many descriptors. All that dssmd sent before this call counts.
  std::map<std::string, std::size_t> stored();
  std::size_t stored_descriptors();
  void await_stored(std::size_t descriptors);  // many at once take their time
  // Puts something there that dssmd never sent.
  void put_into_store(const std::string& name, UniqueFd fd);
  // How often descriptors came that were there already.
  int doubled();

 private:
  struct Stored {
    std::string name;
    UniqueFd fd;
    ino_t inode = 0;  // the quick way to see that two are not the same
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
