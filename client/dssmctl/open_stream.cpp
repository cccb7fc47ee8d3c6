// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/open_stream.hpp"

#include <fmt/format.h>
#include <sys/stat.h>

#include <algorithm>
#include <cstdlib>
#include <utility>

#include "client/dssmctl/names.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// What --wait waits for.
bool may_come(const Error& error) {
  return error.code == Errc::not_found || error.code == Errc::unavailable;
}

std::string socket_path(const CommonOptions& options) {
  if (!options.socket_path.empty()) return options.socket_path;
  const char* path = std::getenv("DSSM_SOCKET");  // NOLINT(concurrency-mt-unsafe): one thread
  return path ? path : "";
}

// Without a reader and without an error after a stop signal.
Result<std::optional<OpenedStream>> open_stream(Session& session, const StreamId& id,
                                                const ReadingOptions& options, MonoTime deadline,
                                                FetchHistory history) {
  Result<RawReader> reader = session.open_raw_reader(id, nullptr, 0, history);
  if (reader) return std::optional(OpenedStream{session, std::move(*reader), false});

  if (may_come(reader.error()) && MonoClock::now() < deadline) {
    print_waiting(options, options.wait, with_similar_names(reader.error(), session, id));
  }
  while (may_come(reader.error()) && MonoClock::now() < deadline) {
    if (stop_requested()) return std::optional<OpenedStream>();
    reader = session.await_raw_reader(id, std::min(deadline, deadline_in(kStopCheckPeriod)),
                                      nullptr, history);
    if (reader) return std::optional(OpenedStream{session, std::move(*reader), true});
  }
  Error error = with_similar_names(std::move(reader).error(), session, id);
  if (error.code == Errc::not_found && options.wait == Duration::zero()) {
    error.message += "; --wait 10s waits for it";
  }
  return error;
}

}  // namespace

Result<Session> connect(const CommonOptions& options, std::string program) {
  SessionOptions session_options;
  session_options.socket_path = options.socket_path;
  session_options.program = program.empty() ? "dssmctl " + options.verb_name : std::move(program);
  Result<Session> session = Session::connect(std::move(session_options));
  const std::string path = socket_path(options);
  struct stat file {};
  if (session || session.error().code != Errc::no_daemon || ::stat(path.c_str(), &file) ||
      S_ISSOCK(file.st_mode)) {
    return session;
  }
  return Error{Errc::no_daemon,
               fmt::format("connect to dssmd at '{}': this is a {}, not dssmd's socket; give the "
                           "socket itself, such as {}",
                           path, S_ISDIR(file.st_mode) ? "folder" : "file",
                           S_ISDIR(file.st_mode) ? path + "/dssmd.sock" : "/run/dssm/dssmd.sock")};
}

void print_waiting(const CommonOptions& options, Duration wait, const Error& reason) {
  print_error(fmt::format("dssmctl: {}: waits up to {}: {}\n", options.verb_name,
                          duration_text(wait), escaped_message(reason.message)));
}

Result<std::vector<OpenedStream>> open_streams(const ReadingOptions& options,
                                               const std::vector<std::string>& streams,
                                               FetchHistory history) {
  catch_stop_signals();
  Session session = DSSM_TRY(connect(options));
  std::vector<StreamId> ids;
  ids.reserve(streams.size());
  for (const std::string& stream : streams) ids.push_back(DSSM_TRY(StreamId::parse(stream)));
  const MonoTime deadline = deadline_in(options.wait);
  std::vector<OpenedStream> opened;
  for (const StreamId& id : ids) {
    std::optional<OpenedStream> one =
        DSSM_TRY(open_stream(session, id, options, deadline, history));
    if (!one) return std::vector<OpenedStream>();
    opened.push_back(*std::move(one));
  }
  return opened;
}

std::string full_name(Session& session, const StreamId& id) {
  if (!id.host.empty()) return id.str();
  const Result<StreamInfo> info = session.stream_info(id);
  return info ? info->id.str() : id.str();
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
    // The stream is there: something else was not found.
    if (names.back() == written(wanted)) return error;
  }
  const std::vector<std::string> similar = similar_names(written(wanted), std::move(names));
  for (const std::string& name : similar) {
    error.message += (&name == &similar.front() ? "; is it '" : "' or '") + escaped(name);
  }
  if (!similar.empty()) error.message += "'?";
  return error;
}

Result<Follower> Follower::open(Session& session, RawReader& reader, Output& out) {
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  const bool own = reader.id().host == daemon.host;
  Follower follower(session, reader, out, own ? kStopCheckPeriod : kOfferTimeout);
  follower.watch_ = DSSM_TRY(
      session.watch([observed = follower.observed_, id = reader.id()](const StreamEvent& event) {
        if (event.stream.id != id) return;
        const bool is_removed = event.kind == StreamEvent::Kind::removed;
        observed->removed.store(is_removed, std::memory_order_relaxed);
        if (is_removed || event.stream.type.fields.empty()) return;
        if (event.property_set && !event.described) return;  // it has the type that it had
        const std::lock_guard guard(observed->mutex);
        observed->described = event.stream;
      }));
  return follower;
}

// A stream may be recreated at once, and after a restart of its dssmd it may seem removed until the
// programs that hold it have offered it back: only answers that there is none count, and only if
// they stay the same for a while. While another host is unavailable, dssmd answers with what the
// mirror knows.
bool Follower::removed() {
  bool missing = false;
  if (observed_->removed.load(std::memory_order_relaxed) && session_.is_connected()) {
    const Result<StreamInfo> now = session_.stream_info(reader_.id());
    missing = !now && now.error().code == Errc::not_found;
  }
  if (!missing) {
    missing_since_.reset();
    return false;
  }
  if (!missing_since_) missing_since_ = MonoClock::now();
  return MonoClock::now() - *missing_since_ >= removed_after_;
}

std::optional<StreamInfo> Follower::take_described() {
  const std::lock_guard guard(observed_->mutex);
  return std::exchange(observed_->described, std::nullopt);
}

Follower::Wake Follower::wait(MonoTime deadline) {
  while (true) {
    if (out_.must_stop()) return Wake::stop;
    if (removed() || reader_.restart_error()) return Wake::ended;
    const MonoTime next_check = std::min(deadline, deadline_in(kStopCheckPeriod));
    // Not wait(): the meters read no payloads, so the reader does not know which one is awaited.
    Tid next = std::max(reader_.cursor() + 1, reader_.oldest_tid());
    for (SampleInfo info; reader_.read_info(next, info) == ReadStatus::lost;) ++next;
    if (reader_.wait_for_sample(next, next_check) == WaitStatus::ready) return Wake::sample;
    if (MonoClock::now() >= deadline) return Wake::deadline;
  }
}

Error end_of(const RawReader& reader) {
  if (std::optional<Error> error = reader.restart_error()) return *std::move(error);
  return {Errc::not_found,
          fmt::format("follow '{}': it was removed; start again if it was recreated",
                      reader.id().str())};
}

void report_restart(const RawReader& reader) {
  print_error(fmt::format("dssmctl: '{}': the stream restarted\n", escaped(reader.id().str())));
}

}  // namespace dssm::ctl
