// SPDX-License-Identifier: Apache-2.0
//
// Names of streams as a person types them: short ones that open the right stream, and the one that
// was perhaps meant.
#pragma once

#include <dssm/stream.hpp>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::ctl {

// "lidar", "lidar:1": the name without ":0" and without the host.
std::string short_name(const StreamId& id);

// For each of `streams`, which are all that there are, the shortest name that opens it on the host
// `own_host`: short_name() where that is enough. dssmd takes a name without a host for its own
// stream, and refuses one that only several other hosts have; such names get "@pc2".
std::vector<std::string> opening_names(const std::vector<StreamInfo>& streams,
                                       std::string_view own_host);

// Those of `names` that a person may have meant by `wanted`, best first, each once, at most three.
std::vector<std::string> similar_names(std::string_view wanted, std::vector<std::string> names);

}  // namespace dssm::ctl
