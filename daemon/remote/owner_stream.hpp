// SPDX-License-Identifier: Apache-2.0
//
// What the owner of a stream says about it, and about what nobody asked for: shared by mirrors and
// remote writers.
#pragma once

#include <dssm/result.hpp>
#include <dssm/stream.hpp>

#include "network.pb.h"

namespace dssm::daemon {

// The stream in `opened`, which must be `expected`.
//   fails  protocol
Result<StreamInfo> owner_stream_untrusted(const proto::Opened& opened, const StreamId& expected);

// `what` came out of turn.
Error unexpected_frame(const char* what);

}  // namespace dssm::daemon
