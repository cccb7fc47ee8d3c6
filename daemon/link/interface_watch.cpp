// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/interface_watch.hpp"

#include <linux/netlink.h>
#include <linux/rtnetlink.h>
#include <sys/socket.h>

#include <cerrno>
#include <utility>

namespace dssm::daemon {

InterfaceWatch::InterfaceWatch(const EventLoop& loop, std::function<void()> on_change)
    : netlink_(::socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC | SOCK_NONBLOCK, NETLINK_ROUTE)) {
  sockaddr_nl address{};
  address.nl_family = AF_NETLINK;
  address.nl_groups = RTMGRP_LINK;
  // Without it (a sandbox that forbids netlink) changes go unnoticed.
  if (!netlink_ || ::bind(netlink_.get(), reinterpret_cast<sockaddr*>(&address), sizeof address)) {
    return;
  }
  source_ = EventSource::readable(loop, netlink_.get(), [this, then = std::move(on_change)] {
    // The content of the messages does not matter, even if some are lost (ENOBUFS).
    char buffer[8192];
    while (::recv(netlink_.get(), buffer, sizeof buffer, 0) >= 0 || errno == ENOBUFS ||
           errno == EINTR) {
    }
    then();
  });
  source_.enable();
}

}  // namespace dssm::daemon
