// SPDX-License-Identifier: Apache-2.0
//
// The identity of a host, which outlives its restarts and its addresses.
#pragma once

#include <array>
#include <cstdint>
#include <string_view>

namespace dssm::wire {

using HostId = std::array<std::uint8_t, 16>;

// This PC's id for a dssmd that calls its host `name`: from the machine id (machine-id(5)), which
// does not leave this PC, and the name, so that several dssmd with different names on one machine
// are different hosts. Without a machine id it is random, and so different after each start.
HostId host_id_for(std::string_view name);

// Whether this PC has a machine id, so that host_id_for() is the same after each start.
bool has_lasting_host_id();

}  // namespace dssm::wire
