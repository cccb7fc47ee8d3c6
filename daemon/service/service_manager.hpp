// SPDX-License-Identifier: Apache-2.0
//
// The service manager (systemd): dssmd reports its state to it; it keeps descriptors over a restart
// (FileDescriptorStoreMax=), and passes sockets and kept descriptors to the next dssmd. Without one
// ($NOTIFY_SOCKET, $LISTEN_FDS) nothing of this has an effect.
//
// Nothing here blocks: messages that the manager does not take at once are queued. If dssmd is
// killed before they are sent, streams of that moment are offered back by their programs. Watchdog
// messages are never queued.
#pragma once

#include <cstddef>
#include <deque>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// A descriptor that the manager passed, and its name (FDNAME=, FileDescriptorName=).
struct NamedDescriptor {
  std::string name;
  UniqueFd fd;
};

// Those that were passed to this process ($LISTEN_FDS). To be called once, before threads start: it
// removes the variables from the environment.
std::vector<NamedDescriptor> take_handed_over();

class ServiceManager {
 public:
  // notify_socket: as in $NOTIFY_SOCKET, a path, or '@' and an abstract name; empty: there is none.
  ServiceManager(const EventLoop& loop, std::string notify_socket);
  ServiceManager(const ServiceManager&) = delete;
  ServiceManager& operator=(const ServiceManager&) = delete;
  ~ServiceManager();

  // $NOTIFY_SOCKET; empty: not set.
  static std::string notify_socket();

  bool is_there() const noexcept { return !path_.empty(); }

  void ready(std::string_view status);  // up, or done with reloading
  void reloading();
  void stopping();
  void status(std::string_view text);  // the line in `systemctl status`
  void alive();                        // for the watchdog

  // Keeps `fds` (at most 253, the kernel's SCM_MAX_FD) under one name until forget() or the end of
  // the service. They must stay open until then: a message that waits holds no copies.
  void keep(const std::string& name, const std::vector<int>& fds);
  void forget(const std::string& name);

 private:
  struct Message {
    std::string text;
    std::vector<int> fds;
    std::string keeps;  // the name under which `fds` shall be kept
  };
  enum class Sent : unsigned char { taken, not_now, no_manager };

  void send(Message message);
  Sent send_now(const Message& message);
  Sent try_send(const Message& message) const;
  bool connect();
  void send_waiting();

  const EventLoop& loop_;
  std::string path_;
  UniqueFd socket_;
  bool connected_ = false;
  std::deque<Message> waiting_;
  EventSource writable_;  // of the socket; only speeds up try_again_
  EventSource try_again_;
};

// Reports to the manager that the loop runs, twice in the interval that it requires
// ($WATCHDOG_USEC): when the loop hangs, the manager kills and restarts dssmd.
class Watchdog {
 public:
  // Begins at once. manager: outlives it.
  Watchdog(const EventLoop& loop, ServiceManager& manager);
  Watchdog(const Watchdog&) = delete;
  Watchdog& operator=(const Watchdog&) = delete;

 private:
  Duration pause_{};  // zero: not required
  EventSource timer_;
};

// Updates the line that `systemctl status` shows, at most once in kPause and only when it changed.
// Does nothing without a service manager.
class StatusLine {
 public:
  static constexpr Duration kPause = std::chrono::seconds(1);

  // text: makes the line, from the loop. manager: outlives it.
  StatusLine(const EventLoop& loop, ServiceManager& manager, std::function<std::string()> text);
  StatusLine(const StatusLine&) = delete;
  StatusLine& operator=(const StatusLine&) = delete;

  // The line as it is now, for the caller to send to the manager.
  std::string now();

  // Something changed that is in the line.
  void touch();

 private:
  void update();

  ServiceManager& manager_;
  std::function<std::string()> text_;
  std::string sent_;
  bool due_ = false;
  EventSource timer_;
};

// The descriptors that the service manager passed to dssmd, sorted by their kind. Names matter only
// to distinguish sockets that dssmd put into the descriptor store from those of a socket unit.
struct Inherited {
  // Listening sockets; non-blocking by now.
  std::vector<NamedDescriptor> local;    // AF_UNIX, streams
  std::vector<NamedDescriptor> network;  // TCP
  std::vector<NamedDescriptor> others;   // what DescriptorStore kept, and anything else

  static Inherited sort(std::vector<NamedDescriptor> handed_over);

  // Takes the socket that listens at `path` out of `local`; none: none does.
  UniqueFd take_local(const std::string& path);
};

}  // namespace dssm::daemon
