// SPDX-License-Identifier: Apache-2.0
//
// Descriptions of this host's streams, the same for its own programs and for other hosts.
#pragma once

#include <cstddef>
#include <dssm/result.hpp>
#include <string>

#include "common.pb.h"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

// The stream as it is at this moment, with how many programs and channels use it.
void describe(const Stream& stream, const OpenTable& opens, proto::Stream& out);

// The same, with the programs of this host that use it.
void describe_with_users(const Stream& stream, const OpenTable& opens, proto::Stream& out);

// All streams in the order of creation. From `max_bytes` on their types' fields are left out,
// because a list has to fit into one frame.
void describe_all(const Registry& registry, const OpenTable& opens, std::size_t max_bytes,
                  proto::StreamList& out);

// The stream's property.
//   fails  not_found (none is set), os errors
Result<std::string> property_of(const Stream& stream);

}  // namespace dssm::daemon
