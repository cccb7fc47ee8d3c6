// SPDX-License-Identifier: Apache-2.0
//
// A D-Bus daemon and an Avahi daemon for one test PC (tests/support/network.hpp), with Avahi's
// default limits. They are invisible outside: their files are in a temporary folder, and
// /run/avahi-daemon, which Avahi requires, is in a mount namespace that ends with Avahi. Both end
// with the test, also when it is killed.
//
//   needs   root, dbus-daemon, avahi-daemon, unshare (util-linux); open() reports what is missing
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <memory>
#include <string>

#include "tests/support/network.hpp"

namespace dssm::test {

class AvahiHost {
 public:
  // Starts nothing yet. `name` is the PC's name in mDNS: "pc1" is found as pc1.local.
  //   fails  when this machine cannot do it, with the reason: skip the test with it
  static Result<std::unique_ptr<AvahiHost>> open(const Network& network, int host,
                                                 const std::string& name);
  AvahiHost(const AvahiHost&) = delete;
  AvahiHost& operator=(const AvahiHost&) = delete;
  ~AvahiHost();

  void start_dbus();   // until it accepts connections
  void start_avahi();  // until it runs; it may not be connected to D-Bus yet
  void kill_dbus();    // SIGKILL
  void kill_avahi();   // SIGKILL: sends no goodbye
  void pause_avahi();  // SIGSTOP; kill_avahi() ends that, too

  pid_t avahi_pid() const noexcept { return avahi_; }  // -1: not running
  // The state of the Avahi daemon and the end of its log, for messages of failed tests.
  std::string account() const;
  // For programs of this PC: "DBUS_SYSTEM_BUS_ADDRESS=...".
  std::string environment() const;
  Inside inside() const { return network_.inside(host_); }

 private:
  AvahiHost(const Network& network, int host, std::string dir)
      : network_(network), host_(host), dir_(std::move(dir)) {}

  const Network& network_;
  const int host_;
  const std::string dir_;
  pid_t dbus_ = -1, avahi_ = -1;
};

}  // namespace dssm::test
