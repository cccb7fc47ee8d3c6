// SPDX-License-Identifier: Apache-2.0
//
// The service manager (systemd) as dssmd sees it: it is told how dssmd is doing, keeps descriptors
// over a restart (FileDescriptorStoreMax=), and hands over sockets and what it kept. Where there is
// none ($NOTIFY_SOCKET, $LISTEN_FDS) nothing of this does anything.
//
// Nothing here waits: what the manager does not take at once goes out in order when it does. A
// dssmd that is killed before that did not say it: streams of that moment come back from their
// programs. Watchdog signs are the exception, they are worthless later.
#pragma once

#include <cstddef>
#include <deque>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/event_loop.hpp"

namespace dssm::daemon {

// A descriptor that the manager handed over, and the name that goes with it (FDNAME=,
// FileDescriptorName=).
struct NamedDescriptor {
  std::string name;
  UniqueFd fd;
};

// Those that were handed to this process ($LISTEN_FDS). To be called once, before threads begin:
// the environment is taken off.
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

  // Messages that the manager has not taken yet.
  std::size_t waiting() const noexcept { return waiting_.size(); }

 private:
  struct Message {
    std::string text;
    std::vector<int> fds;
    std::string keeps;  // the name under which `fds` shall be kept
  };
  enum class Sent : unsigned char { taken, not_now, nobody_there };

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
  EventSource writable_;  // of the socket; only hurries try_again_
  EventSource try_again_;
};

// Shows the manager that the loop turns, at half of the interval that it asks for
// ($WATCHDOG_USEC): a loop that hangs is noticed, and dssmd is killed and started anew.
class Watchdog {
 public:
  // Begins at once. manager: outlives it.
  Watchdog(const EventLoop& loop, ServiceManager& manager);
  Watchdog(const Watchdog&) = delete;
  Watchdog& operator=(const Watchdog&) = delete;

 private:
  Duration pause_{};  // zero: nobody asks
  EventSource timer_;
};

}  // namespace dssm::daemon
