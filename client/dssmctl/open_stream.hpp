// SPDX-License-Identifier: Apache-2.0
//
// From the command line to a stream: connecting, opening, waiting for a stream that is to come,
// helping with a name that does not exist, and following the stream until Ctrl-C or its end.
#pragma once

#include <atomic>
#include <dssm/session.hpp>
#include <memory>
#include <mutex>
#include <optional>
#include <string>
#include <vector>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

//   program  what dssmd shows as its name; empty: "dssmctl VERB"
Result<Session> connect(const CommonOptions& options, std::string program = {});

// Reports on standard error that the verb waits for `wait` at most, and why.
void print_waiting(const CommonOptions& options, Duration wait, const Error& reason);

struct OpenedStream {
  Session session;
  RawReader reader;
  bool awaited;  // it was not there at first: nothing of it was missed
};

// For verbs that run until a stop signal: catches stop signals, connects, and opens `streams` for
// reading, waiting up to `options.wait` for all of them. history: as in Session. Returns none when
// a stop signal came before; a failure to open names similar streams.
Result<std::vector<OpenedStream>> open_streams(const ReadingOptions& options,
                                               const std::vector<std::string>& streams,
                                               FetchHistory history);

// The name of an existing stream with its host.
std::string full_name(Session& session, const StreamId& id);

// `error` with a hint at streams named like `wanted` when there is no such stream.
Error with_similar_names(Error error, Session& session, const StreamId& wanted);

// Waits on a stream that is being shown: for its next sample, the next report, Ctrl-C, the end of
// the program that reads our output, and the stream's end. A stream that restarts, with a new ring,
// is followed; a stream that was removed and not recreated is at its end.
class Follower {
 public:
  enum class Wake : unsigned char {
    sample,  // there is something newer than the reader's cursor, or the stream restarted
    deadline,
    stop,   // by signal, or because our output is no longer read
    ended,  // nothing more will come; samples written before may still be unread
  };

  // `session`, `reader` and `out` outlive the follower.
  static Result<Follower> open(Session& session, RawReader& reader, Output& out);

  Wake wait(MonoTime deadline);

  // The stream as it was announced last, if its type has fields and this was not returned before.
  // It is of the reader's ring if that has the same incarnation.
  std::optional<StreamInfo> take_described();

 private:
  Follower(Session& session, RawReader& reader, Output& out, Duration removed_after)
      : session_(session), reader_(reader), out_(out), removed_after_(removed_after) {}
  bool removed();

  // A stream of another host that is no longer there may return soon: its dssmd was restarted, and
  // the programs that hold the stream are about to offer it.
  static constexpr Duration kOfferTimeout = std::chrono::seconds(3);

  Session& session_;
  RawReader& reader_;
  Output& out_;
  Duration removed_after_;  // how long the stream has to be missing to count as removed
  // Set by the session's thread. Shared with the callback, which moves with the watch.
  struct Observed {
    std::atomic<bool> removed = false;  // a stream of this name was, and none came since
    std::mutex mutex;                   // of:
    std::optional<StreamInfo> described;
  };
  std::shared_ptr<Observed> observed_ = std::make_shared<Observed>();
  std::optional<MonoTime> missing_since_;
  std::optional<Session::Watch> watch_;
};

// The reason why `reader` gets nothing more: its stream was removed, or restarted with another
// type.
Error end_of(const RawReader& reader);

// Reports on standard error that `reader`'s stream restarted.
void report_restart(const RawReader& reader);

}  // namespace dssm::ctl
