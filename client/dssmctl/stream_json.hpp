// SPDX-License-Identifier: Apache-2.0
//
// A StreamInfo as JSON: the same keys in `ls` and `info`.
#pragma once

#include <dssm/stream.hpp>

#include "client/dssmctl/json.hpp"

namespace dssm::ctl {

Json stream_json(const StreamInfo& stream, Time now);

// What `info` adds: fields, users, and how the mirror is doing.
void add_details(Json& json, const StreamInfo& stream);

std::string_view role_name(Role role);

}  // namespace dssm::ctl
