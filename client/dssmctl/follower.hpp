// SPDX-License-Identifier: Apache-2.0
//
// Waits on a stream that is being shown: for its next sample, the next report, Ctrl-C, the end of
// the program that reads our output, and the stream's end. A stream that restarts, with a new ring,
// is followed; a stream that was removed and not recreated is at its end.
#pragma once

#include <atomic>
#include <dssm/session.hpp>
#include <memory>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

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

 private:
  Follower(Session& session, RawReader& reader, Output& out, Duration removed_after)
      : session_(session), reader_(reader), out_(out), removed_after_(removed_after) {}
  bool removed();

  // A stream of another host that is not there any more may return soon: its dssmd was restarted,
  // and the programs that hold the stream are about to offer it.
  static constexpr Duration kMayComeBack = std::chrono::seconds(3);

  Session& session_;
  RawReader& reader_;
  Output& out_;
  Duration removed_after_;  // how long the stream has to be missing to count as removed
  // Set by the session's thread: whether a stream of this name was removed, and none came since.
  // Shared with the callback, which moves with the watch.
  std::shared_ptr<std::atomic<bool>> suspicion_ = std::make_shared<std::atomic<bool>>(false);
  std::optional<MonoTime> missing_since_;
  std::optional<Session::Watch> watch_;
};

// Why nothing more comes to `reader`: its stream was removed, or restarted with another type.
Error end_of(const RawReader& reader);

// Reports on standard error that `reader`'s stream restarted.
void report_restart(const RawReader& reader);

}  // namespace dssm::ctl
