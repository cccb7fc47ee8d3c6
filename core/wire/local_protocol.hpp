// SPDX-License-Identifier: Apache-2.0
//
// Shared by both ends of the local socket: version and limits.
#pragma once

#include "core/wire/messages.hpp"
#include "local.pb.h"

namespace dssm::wire {

inline constexpr std::uint32_t kLocalProtocolVersion = 1;
inline constexpr std::size_t kMaxLocalFrameBytes = 17U
                                                   << 20;  // the largest property and its stream
inline constexpr const char* kDefaultSocketPath = "/run/dssm/dssmd.sock";

}  // namespace dssm::wire
