// SPDX-License-Identifier: Apache-2.0
//
// Shared by both ends of the local socket: version, limits, and the way between protobuf messages
// and the public types. The functions named *_untrusted check every value they take over.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>

#include "local.pb.h"

namespace dssm::wire {

inline constexpr std::uint32_t kLocalProtocolVersion = 1;
inline constexpr std::size_t kMaxPropertyBytes = 16U << 20;
inline constexpr std::size_t kMaxLocalFrameBytes = 17U
                                                   << 20;  // the largest property and its stream
inline constexpr std::size_t kMaxFields = 1024;
inline constexpr std::size_t kMaxProgramBytes = 127;
inline constexpr const char* kDefaultSocketPath = "/run/dssm/dssmd.sock";

// Public types to messages.
void to_message(const StreamId& id, local::StreamId& out);
void to_message(const TypeInfo& type, local::Type& out);
void to_message(const StreamInfo& info, local::Stream& out);
void to_message(const Error& error, local::Failure& out);

// Messages to public types.
Result<StreamId> stream_id_untrusted(const local::StreamId& message);
Result<TypeInfo> type_untrusted(const local::Type& message);
StreamInfo stream_info(const local::Stream& message);
Error failure(const local::Failure& message);

}  // namespace dssm::wire
