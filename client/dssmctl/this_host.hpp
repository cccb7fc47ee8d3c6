// SPDX-License-Identifier: Apache-2.0
//
// What this PC's dssmd calls its host, without asking it.
#pragma once

#include <dssm/result.hpp>
#include <string>

namespace dssm::ctl {

inline constexpr const char* kDaemonConfig = "/etc/dssm/dssmd.conf";

// The key `name` in the configuration file; without it, or without the file, the machine's name up
// to the first dot: as dssmd does. What flags of dssmd say is not known here.
//   fails  no host can have this name, or the file has a mistake
Result<std::string> this_host_name(const std::string& config = kDaemonConfig);

// Its id, as 32 hexadecimal digits.
//   fails  not_found: this PC has no machine id, so that its host has another id after each start
Result<std::string> this_host_id(const std::string& name);

}  // namespace dssm::ctl
