// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/follower.hpp"

#include <algorithm>

#include "client/dssmctl/stop_signal.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {

Result<Follower> Follower::open(Session& session, RawReader& reader, Output& out) {
  const Result<DaemonInfo> daemon = session.daemon_info();
  if (!daemon) return daemon.error();
  const bool own = reader.id().host == daemon->host;
  Follower follower(session, reader, out, own ? kStopCheckPeriod : kMayComeBack);
  Result<Session::Watch> watch =
      session.watch([suspicion = follower.suspicion_, id = reader.id()](const StreamEvent& event) {
        if (event.stream.id != id) return;
        suspicion->store(event.kind == StreamEvent::Kind::removed, std::memory_order_relaxed);
      });
  if (!watch) return std::move(watch).error();
  follower.watch_ = std::move(*watch);
  return follower;
}

// A stream may be recreated at once, and after a restart of its dssmd it may seem removed until the
// programs that hold it have offered it back: only answers that there is none count, and only if
// they stay the same for a while. While another host is unavailable, dssmd answers with what the
// mirror knows.
bool Follower::removed() {
  bool missing = false;
  if (suspicion_->load(std::memory_order_relaxed) && session_.is_connected()) {
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

Follower::Wake Follower::wait(MonoTime deadline) {
  while (true) {
    if (stop_requested() || out_.reader_ended()) return Wake::stop;
    if (removed() || reader_.restart_error()) return Wake::ended;
    const MonoTime next_check = std::min(deadline, deadline_in(kStopCheckPeriod));
    if (reader_.wait(next_check) == WaitStatus::ready) return Wake::sample;
    if (MonoClock::now() >= deadline) return Wake::deadline;
  }
}

Error end_of(const RawReader& reader) {
  if (std::optional<Error> trouble = reader.restart_error()) return *std::move(trouble);
  return {Errc::not_found,
          "follow '" + reader.id().str() + "': it was removed; start again if it was recreated"};
}

void report_restart(const RawReader& reader) {
  print_error("dssmctl: '" + escaped(reader.id().str()) + "': the stream restarted\n");
}

}  // namespace dssm::ctl
