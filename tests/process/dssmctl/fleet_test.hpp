// SPDX-License-Identifier: Apache-2.0
//
// What the tests of dssmctl with other hosts share: dssmctl works on pc1, whose dssmd knows pc2 and
// pc3; all of them run on this machine.
#pragma once

#include <string>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {

class OtherHosts {
 protected:
  DaemonProcess pc2_{{}, "pc2"}, pc3_{{}, "pc3"};
  Session on_pc2_ = session_with(pc2_), on_pc3_ = session_with(pc3_);
};

class FleetTest : protected OtherHosts, public CtlTest {
 protected:
  FleetTest() : CtlTest({"--peer", pc2_.address(), "--peer", pc3_.address()}) {
    await_state("pc2", HostState::up);
    await_state("pc3", HostState::up);
  }

  HostInfo host(const std::string& name) {
    for (HostInfo& host : session_.list_hosts().value()) {
      if (host.name == name) return host;
    }
    return {};
  }
  void await_state(const std::string& name, HostState state) {
    await([&] { return host(name).state == state; });
  }

  // Until pc1 knows as many streams of other hosts.
  void await_streams(std::uint32_t streams) {
    await([&] { return host("pc2").streams + host("pc3").streams == streams; });
  }
};

}  // namespace dssm::test
