// SPDX-License-Identifier: Apache-2.0
//
// The old DSSM's broadcasts, on top of the catalog. What a host shows is the property of a small
// stream of its own, "dssm_broadcast:0"; who wants to know asks the dssmd of this PC for the hosts,
// and each host for that property.
#pragma once

#include <cstddef>
#include <dssm/session.hpp>
#include <functional>
#include <optional>
#include <span>
#include <string>

namespace dssm::ssm {

// One thread at a time.
class Broadcast {
 public:
  Result<void> show(std::span<const std::byte> block);

  struct Host {
    std::string address, port;
    std::optional<std::vector<std::byte>> block;
  };
  // All hosts that answer at this moment.
  Result<std::vector<Host>> hosts();

 private:
  Result<Session*> session();

  std::optional<Session> session_;
  std::optional<RawWriter> stream_;  // held, so that it survives a restart of dssmd
};

}  // namespace dssm::ssm
