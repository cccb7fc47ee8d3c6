// SPDX-License-Identifier: Apache-2.0
//
// Names of streams as a person types them, and which one was perhaps meant by a name that does not
// exist.
#pragma once

#include <dssm/stream.hpp>
#include <string>
#include <string_view>
#include <vector>

namespace dssm {

// "lidar", "lidar:1": the name without ":0" and without the host.
std::string short_name(const StreamId& id);

// Those of `names` that a person may have meant by `wanted`, best first, each once, at most three.
std::vector<std::string> similar_names(std::string_view wanted, std::vector<std::string> names);

}  // namespace dssm
