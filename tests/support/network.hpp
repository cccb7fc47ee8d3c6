// SPDX-License-Identifier: Apache-2.0
//
// PCs for one test: network namespaces, each connected by a cable to a switch (a bridge in a
// separate namespace). Cables can be cut, healed and slowed down.
//
//   PC k is called "pck" and has the addresses 10.77.0.k and fd77::k. The namespaces have no names
//   and no connection to the outside, so several tests can run at the same time. They exist as long
//   as this object's descriptors and the programs in them, so a killed test leaves nothing behind.
//
//   shared  everything but the network: files, Unix sockets, processes, memory
//   needs   root, iproute2, and a kernel with veth and bridge; open() reports what is missing
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <memory>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"

namespace dssm::test {

// While it exists, the thread that created it is inside a namespace. Sockets that the thread
// creates and programs that it starts stay there, also afterwards.
class Inside {
 public:
  explicit Inside(int network_namespace);
  Inside(const Inside&) = delete;
  Inside& operator=(const Inside&) = delete;
  ~Inside();  // returns the thread to its previous namespace

 private:
  UniqueFd before_;
};

class Network {
 public:
  // A switch and PCs "pc1" to "pc<hosts>", all connected. At most 9 hosts.
  //   fails  when this machine cannot do it, with the reason: skip the test with it
  static Result<std::unique_ptr<Network>> open(int hosts);

  int hosts() const { return static_cast<int>(hosts_.size()); }

  // Hosts are numbered from 1.
  static std::string name(int host);      // "pc1"
  static std::string address(int host);   // "10.77.0.1"
  static std::string address6(int host);  // "fd77::1"

  Inside inside(int host) const {
    return Inside(hosts_.at(static_cast<std::size_t>(host) - 1).get());
  }

  // Adds a cable from the host to the switch, at its interface `interface`, which is up and has
  // only the addresses that the kernel assigns.
  void add_cable(int host, const std::string& interface);
  // Configures the host by lines of ip(8) commands, without the word ip:
  // "link del eth0\n".
  void configure(int host, const std::string& lines) const;
  // Drops TCP from other hosts without an answer, like a firewall; multicast still passes.
  //   fails  when this machine has no nft(8) that works: skip the test with the reason
  Result<void> swallow(int host);
  void stop_swallowing(int host);

  // Disconnect and reconnect the host's cable at the switch; no effect if already done.
  void cut(int host);
  void heal(int host);
  // The same further away, as when Wi-Fi is out of reach: the host's interface stays connected.
  void block(int host);
  void unblock(int host);

  // Shapes what the switch sends to the host, as in tc-netem(8) or tc-tbf(8): "netem delay 20ms",
  // "tbf rate 20mbit burst 64kb latency 100ms".
  //   fails  when this kernel does not support it: skip the test with the reason
  Result<void> shape(int host, const std::string& how);

 private:
  Network() = default;
  void connect(int host, const std::string& port, const std::string& interface);
  void set_port_state(int host, const char* state);
  UniqueFd switch_;
  std::vector<UniqueFd> hosts_;
};

}  // namespace dssm::test
