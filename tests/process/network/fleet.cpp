// SPDX-License-Identifier: Apache-2.0
#include "tests/process/network/fleet.hpp"

#include <cstdlib>

namespace dssm::test {

Fleet::Fleet(std::unique_ptr<Network> network, const std::vector<std::string>& extra,
             IpVersion version)
    : network_(std::move(network)) {
  for (int host = 1; host <= hosts(); ++host) {
    std::vector<std::string> flags = {"--insecure", "--listen", dssmd_address(host, version)};
    for (int peer = 1; peer <= hosts(); ++peer) {
      if (peer == host) continue;
      flags.push_back("--peer");
      flags.push_back(dssmd_address(peer, version));
    }
    flags.insert(flags.end(), {"--log-level", "error"});
    flags.insert(flags.end(), extra.begin(), extra.end());
    const Inside inside = network_->inside(host);
    dssmds_.push_back(std::make_unique<DaemonProcess>(flags, Network::name(host)));
  }
}

bool Fleet::runs(int host) {
  if (dssmd(host).pid() <= 0) return false;
  dssmd(host).expect_no_crash();
  return true;
}

void Fleet::kill_dssmd(int host) {
  if (runs(host)) dssmd(host).kill_hard();
}

void Fleet::start_dssmd(int host) {
  if (runs(host)) return;
  const Inside inside = network_->inside(host);
  dssmd(host).start();
}

Session Fleet::session(int host) {
  return Session::connect(
             {.socket_path = dssmd(host).socket_path(), .request_timeout = std::chrono::minutes(2)})
      .value();
}

std::unique_ptr<Network> NetworkTest::make_network(int hosts) {
  Result<std::unique_ptr<Network>> network = Network::open(hosts);
  if (network) return *std::move(network);
  [&] { GTEST_SKIP() << network.error().message; }();
  return nullptr;
}

bool NetworkTest::make_fleet(int hosts, const std::vector<std::string>& extra, IpVersion version) {
  std::unique_ptr<Network> network = make_network(hosts);
  if (!network) return false;
  fleet = std::make_unique<Fleet>(std::move(network), extra, version);
  return true;
}

std::string dssmd_address(int host, IpVersion version) {
  return (version == IpVersion::v4 ? Network::address(host) : "[" + Network::address6(host) + "]") +
         ":13776";
}

HostInfo host_info(Session& session, const std::string& name) {
  for (HostInfo& host : session.list_hosts().value()) {
    if (host.name == name) return host;
  }
  return {};
}

std::uint64_t number_from_environment(const char* name, std::uint64_t otherwise) {
  const char* text = std::getenv(name);
  return text ? std::strtoull(text, nullptr, 10) : otherwise;
}

}  // namespace dssm::test
