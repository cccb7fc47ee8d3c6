// SPDX-License-Identifier: Apache-2.0
//
// A fleet of the test's own: PCs with a dssmd each, which listens on its PC's address and has all
// the others for peers.
#pragma once

#include <gtest/gtest.h>

#include <dssm/dssm.hpp>
#include <memory>
#include <string>
#include <vector>

#include "tests/support/daemon_process.hpp"
#include "tests/support/network.hpp"

namespace dssm::test {

class Fleet {
 public:
  // `extra` flags are given to every dssmd. Hosts are numbered from 1, as in Network.
  explicit Fleet(std::unique_ptr<Network> network, const std::vector<std::string>& extra = {});

  Network& network() { return *network_; }
  int hosts() const { return network_->hosts(); }

  DaemonProcess& dssmd(int host) { return *dssmds_.at(static_cast<std::size_t>(host) - 1); }
  // Kills it, unless that was done already; starts it again in its place.
  void kill_dssmd(int host);
  void start_dssmd(int host);
  bool runs(int host) { return dssmd(host).pid() > 0; }

  // A connection of this process to the host's dssmd. A program sees the network only through
  // dssmd, so it does not matter that this one is in no host.
  Session session(int host);

 private:
  std::unique_ptr<Network> network_;
  std::vector<std::unique_ptr<DaemonProcess>> dssmds_;
};

// Tests that need PCs; skipped, with the reason, where there can be none.
class NetworkTest : public testing::Test {
 protected:
  // In a test: `if (!make_fleet(3)) return;`
  bool make_fleet(int hosts, const std::vector<std::string>& extra = {});
  // Skips the test, with the reason, when the network cannot be had.
  std::unique_ptr<Network> make_network(int hosts);

  std::unique_ptr<Fleet> fleet;
};

// $NAME as a number, or `otherwise`.
std::uint64_t number_from_environment(const char* name, std::uint64_t otherwise);

// How much slower than usual things go here: what costs much is done so many times less.
#if defined(__SANITIZE_THREAD__)
inline constexpr int kSlowness = 10;
#elif defined(__SANITIZE_ADDRESS__)
inline constexpr int kSlowness = 4;
#else
inline constexpr int kSlowness = 1;
#endif

}  // namespace dssm::test
