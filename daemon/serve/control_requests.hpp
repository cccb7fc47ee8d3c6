// SPDX-License-Identifier: Apache-2.0
//
// What other hosts ask on their control connections about the streams of this one, by name. No
// state: Watch and Ping, which have some, are DataCommunicator's.
#pragma once

#include <dssm/result.hpp>

#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"
#include "network.pb.h"

namespace dssm::daemon {

class ControlRequests {
 public:
  // Both outlive it.
  ControlRequests(Registry& registry, const OpenTable& opens)
      : registry_(registry), opens_(opens) {}

  // Whether `request` is one that only a control connection takes. Properties are asked for on
  // channels, too: there without a name.
  static bool is_control(const net::Frame& request) noexcept;

  // Does what `request` asks for and fills in the answer's body.
  //   fails  with what the other side is told
  Result<void> serve_untrusted(const net::Frame& request, net::Frame& answer);

 private:
  Result<void> list(net::Frame& answer) const;
  Result<void> info(const net::Info& request, net::Frame& answer) const;
  Result<void> remove(const net::Remove& request, net::Frame& answer);
  Result<void> set_property(const net::SetProperty& request, net::Frame& answer);
  Result<void> get_property(const net::GetProperty& request, net::Frame& answer) const;
  Result<std::shared_ptr<Stream>> find_untrusted(const proto::StreamId& id) const;

  Registry& registry_;
  const OpenTable& opens_;
};

}  // namespace dssm::daemon
