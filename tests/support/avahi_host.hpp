// SPDX-License-Identifier: Apache-2.0
//
// A D-Bus daemon and an Avahi daemon of a test PC's own (tests/support/network.hpp), with Avahi's
// stock limits. Nothing of them is visible outside: their files are in a folder of the test's, and
// /run/avahi-daemon, which Avahi insists on, is in a mount namespace that ends with it. A test that
// is killed takes both along.
//
//   needs   root, dbus-daemon, avahi-daemon, unshare (util-linux); open() says what is missing
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <memory>
#include <string>

#include "tests/support/network.hpp"

namespace dssm::test {

class AvahiHost {
 public:
  // Starts nothing yet. `name` is that of the PC in mDNS: "pc1" is found as pc1.local.
  //   fails  when this machine cannot do it, with the reason: skip the test with it
  static Result<std::unique_ptr<AvahiHost>> open(const Network& network, int host,
                                                 const std::string& name);
  AvahiHost(const AvahiHost&) = delete;
  AvahiHost& operator=(const AvahiHost&) = delete;
  ~AvahiHost();

  void start_dbus();   // until it takes connections
  void start_avahi();  // until it runs; it may not have reached D-Bus yet
  void kill_dbus();    // SIGKILL
  void kill_avahi();   // SIGKILL: says no good-bye
  void pause_avahi();  // SIGSTOP; kill_avahi() ends that, too

  pid_t avahi_pid() const noexcept { return avahi_; }  // -1: does not run
  // How the Avahi daemon is, and its last words: for a test that fails.
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
