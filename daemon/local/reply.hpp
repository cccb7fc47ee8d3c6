// SPDX-License-Identifier: Apache-2.0
//
// A response to a program with its descriptors, and the responses that several requests share.
#pragma once

#include <deque>
#include <memory>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/streams/open_table.hpp"
#include "local.pb.h"

namespace dssm::daemon {

// A response and the descriptors that go with it, in the order that local.proto says.
struct Reply {
  local::Response response;
  std::vector<UniqueFd> descriptors;
};

// Descriptors that arrived, one element per message that brought some. A request that takes
// descriptors takes the oldest element.
using DescriptorQueue = std::deque<std::vector<UniqueFd>>;

// Of a StreamList; the rest of a frame is for the response around it.
inline constexpr std::size_t kMaxListBytes = wire::kMaxLocalFrameBytes - (1U << 20);

// Success without content.
Reply done();

// The descriptors of the oldest message that brought any.
std::vector<UniqueFd> take_descriptors(DescriptorQueue& queue);

// The memory files of an Offer, from its descriptors.
//   fails  protocol: some are missing
Result<OfferedFiles> offered_files(DescriptorQueue& queue, Role role);

// Records that a client has a stream open. The reply comes without descriptors.
Reply record_open(OpenTable& opens, const OpenEntry& entry);

// The same, with the descriptors that go with a Create or an Open.
//   fails  limit_exceeded (opens), os errors; then nothing is recorded
Result<Reply> opened(OpenTable& opens, const OpenEntry& entry);

}  // namespace dssm::daemon
