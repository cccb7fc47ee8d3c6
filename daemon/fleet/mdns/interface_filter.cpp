// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/mdns/interface_filter.hpp"

#include <fnmatch.h>
#include <linux/netlink.h>
#include <linux/rtnetlink.h>
#include <net/if.h>
#include <sys/socket.h>

#include <algorithm>
#include <cerrno>

#include "core/base/text.hpp"
#include "daemon/base/log.hpp"

namespace dssm::daemon {
namespace {

bool matches_any(const std::vector<std::string>& patterns, const std::string& name) {
  return std::any_of(patterns.begin(), patterns.end(), [&](const std::string& pattern) {
    return ::fnmatch(pattern.c_str(), name.c_str(), 0) == 0;
  });
}

}  // namespace

bool InterfaceFilter::admits(const std::string& name) const {
  return (use_.empty() || matches_any(use_, name)) && !matches_any(avoid_, name);
}

std::string InterfaceFilter::selection() const {
  std::string text;
  for (const std::string& pattern : use_) text += (text.empty() ? "" : ", ") + in_quotes(pattern);
  return text;
}

std::map<int, std::string> InterfaceFilter::existing() const {
  std::map<int, std::string> found;
  struct if_nameindex* const all = ::if_nameindex();
  if (!all) return found;
  for (const struct if_nameindex* one = all; one->if_index != 0; ++one) {
    if (admits(one->if_name)) found.emplace(static_cast<int>(one->if_index), one->if_name);
  }
  ::if_freenameindex(all);
  return found;
}

std::string interface_name(int index) {
  char name[IF_NAMESIZE] = "";
  if (index <= 0 || !::if_indextoname(static_cast<unsigned>(index), name)) return {};
  return name;
}

InterfaceWatch::InterfaceWatch(const EventLoop& loop, std::function<void()> on_change)
    : netlink_(::socket(AF_NETLINK, SOCK_RAW | SOCK_CLOEXEC | SOCK_NONBLOCK, NETLINK_ROUTE)) {
  sockaddr_nl address{};
  address.nl_family = AF_NETLINK;
  address.nl_groups = RTMGRP_LINK;
  // Without it (a sandbox that forbids netlink) the interfaces of the start are used.
  if (!netlink_ || ::bind(netlink_.get(), reinterpret_cast<sockaddr*>(&address), sizeof address)) {
    return;
  }
  source_ = EventSource::readable(loop, netlink_.get(), [this, then = std::move(on_change)] {
    // The content of the messages does not matter, even if some are lost (ENOBUFS): the list of
    // interfaces is read again.
    char buffer[8192];
    while (::recv(netlink_.get(), buffer, sizeof buffer, 0) >= 0 || errno == ENOBUFS ||
           errno == EINTR) {
    }
    then();
  });
  source_.enable();
}

}  // namespace dssm::daemon
