// SPDX-License-Identifier: Apache-2.0
//
// From the command line to a stream: connecting, opening, waiting for a stream that is to come, and
// helping with a name that does not exist.
#pragma once

#include <dssm/session.hpp>
#include <functional>

#include "client/dssmctl/options.hpp"

namespace dssm::ctl {

Result<Session> connect(const CommonOptions& options);

struct OpenedStream {
  Session session;
  RawReader reader;
  bool awaited;  // it was not there at first: nothing of it was missed
};

// For verbs that run until a stop signal: catches stop signals, connects, opens `options.stream`
// for reading, waiting up to `options.wait` for it, and does `work` with it. Success without `work`
// when a stop signal came before; a failure to open names similar streams.
Result<void> with_stream(const ReadingOptions& options,
                         const std::function<Result<void>(OpenedStream&)>& work);

// `error` with a hint at streams named like `wanted` when it says that there is no such stream.
Error with_similar_names(Error error, Session& session, const StreamId& wanted);

}  // namespace dssm::ctl
