// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/open_stream.hpp"

#include <algorithm>
#include <utility>

#include "client/dssmctl/names.hpp"
#include "client/dssmctl/stop_signal.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// What --wait waits for.
bool may_come(const Error& why) {
  return why.code == Errc::not_found || why.code == Errc::unavailable;
}

// Without a reader and without an error after a stop signal.
Result<std::optional<OpenedStream>> open_stream(const ReadingOptions& options) {
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  Result<StreamId> id = StreamId::parse(options.stream);
  if (!id) return std::move(id).error();
  Result<RawReader> reader = session->open_raw_reader(*id);
  if (reader) return std::optional(OpenedStream{*session, std::move(*reader), false});

  const MonoTime deadline = deadline_in(options.wait);
  while (may_come(reader.error()) && MonoClock::now() < deadline) {
    if (stop_requested()) return std::optional<OpenedStream>();
    reader = session->await_raw_reader(*id, std::min(deadline, deadline_in(kStopCheckPeriod)));
    if (reader) return std::optional(OpenedStream{*session, std::move(*reader), true});
  }
  Error error = with_similar_names(std::move(reader).error(), *session, *id);
  if (error.code == Errc::not_found && options.wait == Duration::zero()) {
    error.message += "; --wait SECONDS waits for it";
  }
  return error;
}

}  // namespace

Result<Session> connect(const CommonOptions& options) {
  SessionOptions session_options;
  session_options.socket_path = options.socket_path;
  session_options.program = "dssmctl " + options.verb_name;
  return Session::connect(std::move(session_options));
}

Result<void> with_stream(const ReadingOptions& options,
                         const std::function<Result<void>(OpenedStream&)>& work) {
  catch_stop_signals();
  Result<std::optional<OpenedStream>> opened = open_stream(options);
  if (!opened) return std::move(opened).error();
  return *opened ? work(**opened) : Result<void>();
}

Error with_similar_names(Error error, Session& session, const StreamId& wanted) {
  if (error.code != Errc::not_found) return error;
  const Result<std::vector<StreamInfo>> streams = session.list_streams();
  if (!streams) return error;  // the first failure is the one to report
  if (streams->empty()) {
    error.message += "; there are no streams at all";
    return error;
  }
  const auto written = [&](const StreamId& id) {
    return wanted.host.empty() ? short_name(id) : short_name(id) + "@" + id.host;
  };
  std::vector<std::string> names;
  for (const StreamInfo& stream : *streams) {
    names.push_back(written(stream.id));
    // It is there: something of it was not found.
    if (names.back() == written(wanted)) return error;
  }
  const std::vector<std::string> similar = similar_names(written(wanted), std::move(names));
  for (const std::string& name : similar) {
    error.message += (&name == &similar.front() ? "; is it '" : "' or '") + escaped(name);
  }
  if (!similar.empty()) error.message += "'?";
  return error;
}

}  // namespace dssm::ctl
