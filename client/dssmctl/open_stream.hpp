// SPDX-License-Identifier: Apache-2.0
//
// From the command line to a stream: connecting, opening, waiting for a stream that is to come, and
// helping with a name that does not exist.
#pragma once

#include <dssm/session.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/options.hpp"

namespace dssm::ctl {

Result<Session> connect(const Options& options);

struct OpenedStream {
  RawReader reader;
  bool awaited;  // it was not there at first: nothing of it was missed
};

// Opens `options.stream` for reading, waiting up to `options.wait` for it. Fails also with a text
// that names similar streams; without a reader and without an error when told to stop.
Result<std::optional<OpenedStream>> open_stream(Session& session, const Options& options);

// `error` with a hint at streams named like `wanted` when it says that there is no such stream.
Error with_similar_names(Error error, Session& session, const StreamId& wanted);

// Those of `names` that a person may have meant by `wanted`, best first, at most three.
std::vector<std::string> similar_names(std::string_view wanted, std::vector<std::string> names);

// A stream's shortest unambiguous name: without ":0".
std::string short_name(const StreamId& id);

}  // namespace dssm::ctl
