// SPDX-License-Identifier: Apache-2.0
//
// Two dssmd on this machine's loopback: pc1 owns the streams, pc2 reads and writes them.
#pragma once

#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <cstring>
#include <dssm/dssm.hpp>
#include <string>
#include <thread>
#include <utility>

#include "tests/process/fleet/fleet_tools.hpp"
#include "tests/support/samples.hpp"

namespace dssm::test {

using namespace std::chrono_literals;

class TwoHosts : public testing::Test {
 protected:
  explicit TwoHosts(const std::string& linger = "5 s", std::vector<std::string> of_pc1 = {})
      : linger_(linger), pc1(std::move(of_pc1), "pc1") {
    await_state(there, pc1, HostState::up);
  }

  // What pc2 says about its copy of `name`, a stream of pc1.
  MirrorInfo mirror(const std::string& name) {
    const auto info = there.stream_info({name, 0, "pc1"});
    return info && info->mirror ? *info->mirror : MirrorInfo{};
  }
  std::uint32_t channels(const std::string& name) {
    return here.stream_info({name, 0, ""}).value().channels;
  }

  const std::string linger_;
  DaemonProcess pc1;
  DaemonProcess pc2{{"--peer", pc1.address(), "--mirror-linger", linger_}, "pc2"};
  Session here = connect(pc1), there = connect(pc2);
};

}  // namespace dssm::test
