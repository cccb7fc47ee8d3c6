// SPDX-License-Identifier: Apache-2.0
//
// PCs of the test's own: network namespaces, joined by one cable each to a switch (a bridge in a
// namespace of its own). Cables can be cut, healed and slowed down.
//
//   PC k is called "pck" and has the addresses 10.77.0.k and fd77::k, whatever else runs on this
//   machine: the namespaces have no names and no connection to the outside, so tests run side by
//   side. They live as long as this object's descriptors and the programs in them: a test that is
//   killed leaves nothing behind.
//
//   shared  everything but the network: files, Unix sockets, processes, memory
//   needs   root, iproute2, and a kernel with veth and bridge; open() says what is missing
#pragma once

#include <sys/types.h>

#include <dssm/result.hpp>
#include <memory>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"

namespace dssm::test {

// While it lives, the thread that made it is inside a namespace: sockets that it makes and
// programs that it starts belong there, also afterwards.
class Inside {
 public:
  explicit Inside(int network_namespace);
  Inside(const Inside&) = delete;
  Inside& operator=(const Inside&) = delete;
  ~Inside();  // back to where the thread was

 private:
  UniqueFd before_;
};

class Network {
 public:
  // A switch and PCs "pc1" to "pc<hosts>", all cables in place. At most 9 hosts.
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

  // One more cable from the host to the switch, at its interface `interface`, which is up and has
  // only the addresses that the kernel itself gives it.
  void add_cable(int host, const std::string& interface);
  // Configures the host as `lines` say, each one an ip(8) command without the word ip:
  // "link del eth0\n".
  void configure(int host, const std::string& lines) const;
  // Lets the host take no TCP from others, and answer nothing to who tries, as behind a firewall
  // that drops; multicast still goes through.
  //   fails  when this machine has no nft(8) that works: skip the test with the reason
  Result<void> swallow(int host);
  void stop_swallowing(int host);

  // Takes the host's cable out of the switch; puts it back. Whichever is so already stays so.
  void cut(int host);
  void heal(int host);

  // Lets the switch send to the host only as tc-netem(8) or tc-tbf(8) says: "netem delay 20ms",
  // "tbf rate 20mbit burst 64kb latency 100ms".
  //   fails  when this kernel has no such thing: skip the test with the reason
  Result<void> shape(int host, const std::string& how);

 private:
  Network() = default;
  void connect(int host, const std::string& port, const std::string& interface);
  UniqueFd switch_;
  std::vector<UniqueFd> hosts_;
};

}  // namespace dssm::test
