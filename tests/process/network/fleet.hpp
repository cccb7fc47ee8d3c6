// SPDX-License-Identifier: Apache-2.0
//
// A fleet for one test: PCs with one dssmd each, which listens at its PC's address and has all the
// others as peers.
#pragma once

#include <gtest/gtest.h>

#include <dssm/dssm.hpp>
#include <memory>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/daemon_process.hpp"
#include "tests/support/network.hpp"

namespace dssm::test {

enum class IpVersion : std::uint8_t { v4, v6 };

class Fleet {
 public:
  // Every dssmd gets the `extra` flags. Hosts are numbered from 1, as in Network.
  explicit Fleet(std::unique_ptr<Network> network, const std::vector<std::string>& extra = {},
                 IpVersion version = IpVersion::v4);

  Network& network() { return *network_; }
  int hosts() const { return network_->hosts(); }

  DaemonProcess& dssmd(int host) { return *dssmds_.at(static_cast<std::size_t>(host) - 1); }
  // Kill it unless it is dead; start it unless it runs.
  void kill_dssmd(int host);
  void start_dssmd(int host);
  bool runs(int host);  // ends the test program when it has crashed

  // A connection of this process to the host's dssmd. Programs use the network only through dssmd,
  // so this process need not be in the host's namespace.
  Session session(int host);

 private:
  std::unique_ptr<Network> network_;
  std::vector<std::unique_ptr<DaemonProcess>> dssmds_;
};

// Tests that need PCs; skipped, with the reason, where these cannot be created.
class NetworkTest : public testing::Test {
 protected:
  // In a test: `if (!make_fleet(3)) return;`
  bool make_fleet(int hosts, const std::vector<std::string>& extra = {},
                  IpVersion version = IpVersion::v4);
  // Skips the test, with the reason, if the network cannot be created.
  std::unique_ptr<Network> make_network(int hosts);

  std::unique_ptr<Fleet> fleet;
};

// The address at which the host's dssmd listens: "10.77.0.1:13776", "[fd77::1]:13776".
std::string dssmd_address(int host, IpVersion version = IpVersion::v4);

// Polls until `done` is true, for events without a notification. Fails the test, and returns false,
// after a minute.
template <class Done>
bool await(const char* what, Done done) {
  for (const MonoTime end = deadline_in(std::chrono::minutes(1)); !done();) {
    if (MonoClock::now() > end) {
      ADD_FAILURE() << "did not happen within a minute: " << what;
      return false;
    }
    std::this_thread::sleep_for(std::chrono::milliseconds(2));
  }
  return true;
}

// What `session`'s dssmd knows of the host; the state is empty if dssmd does not list it.
HostInfo host_info(Session& session, const std::string& name);

// $NAME as a number, or `otherwise`.
std::uint64_t number_from_environment(const char* name, std::uint64_t otherwise);

// By how much sanitizers slow programs down; tests divide expensive work by it.
#if defined(__SANITIZE_THREAD__)
inline constexpr int kSlowness = 20;
#elif defined(__SANITIZE_ADDRESS__)
inline constexpr int kSlowness = 4;
#else
inline constexpr int kSlowness = 1;
#endif

}  // namespace dssm::test
