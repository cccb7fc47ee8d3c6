// SPDX-License-Identifier: Apache-2.0
//
// The two hosts of a benchmark: "pc1" owns the streams, "pc2" reads them. They are either this
// machine, connected by loopback, or network namespaces, connected by cables to a switch.
#pragma once

#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/network.hpp"

namespace dssm::bench {

class Hosts {
 public:
  Hosts() = default;  // loopback
  explicit Hosts(std::unique_ptr<test::Network> network) : network_(std::move(network)) {}

  const char* name() const { return network_ ? "namespaces" : "loopback"; }

  // While it exists, this thread is in that host.
  std::unique_ptr<test::Inside> inside(int host) const {
    if (!network_) return nullptr;
    return std::unique_ptr<test::Inside>(new test::Inside(network_->inside(host)));
  }

  std::unique_ptr<test::DaemonProcess> start_owner(const char* log_level = "warning") const {
    return start(1, {"--log-level", log_level});
  }
  std::unique_ptr<test::DaemonProcess> start_other(const test::DaemonProcess& owner) const {
    return start(2, {"--log-level", "warning", "--peer", owner.address()});
  }

  // The ends of a TCP connection without Nagle's delay: on the owner's host, and on the other.
  std::pair<int, int> tcp_pair() const {
    const auto in_owner = inside(1);
    const int listener = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    if (network_) ::inet_pton(AF_INET, network_->address(1).c_str(), &address.sin_addr);
    socklen_t length = sizeof address;
    auto* name = reinterpret_cast<sockaddr*>(&address);
    if (::bind(listener, name, length) || ::listen(listener, 1) ||
        ::getsockname(listener, name, &length)) {
      fail("listen");
    }
    int there = -1;
    {
      const auto in_other = inside(2);
      there = ::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0);
      if (::connect(there, name, length)) fail("connect");
    }
    const int here = ::accept4(listener, nullptr, nullptr, SOCK_CLOEXEC);
    if (here < 0) fail("accept");
    ::close(listener);
    const int on = 1;
    for (const int fd : {here, there}) ::setsockopt(fd, IPPROTO_TCP, TCP_NODELAY, &on, sizeof on);
    return {here, there};
  }

 private:
  std::unique_ptr<test::DaemonProcess> start(int host, std::vector<std::string> flags) const {
    const auto in_host = inside(host);
    flags.insert(flags.end(),
                 {"--listen", network_ ? network_->address(host) + ":0" : "127.0.0.1:0"});
    if (network_) flags.emplace_back("--insecure");
    return std::make_unique<test::DaemonProcess>(std::move(flags), test::Network::name(host));
  }

  std::unique_ptr<test::Network> network_;
};

// Runs on each kind of hosts that this machine supports.
template <class Benchmark>
void on_hosts(Benchmark benchmark) {
  std::printf("--- two hosts on loopback\n");
  benchmark(Hosts());
  auto network = test::Network::open(2);
  if (!network) {
    std::printf("--- SKIPPED two hosts in network namespaces: %s\n",
                network.error().message.c_str());
    return;
  }
  std::printf("--- two hosts in network namespaces\n");
  benchmark(Hosts(*std::move(network)));
}

}  // namespace dssm::bench
