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
  Follower follower(session, reader, out, own ? kStopLookUp : kMayComeBack);
  Result<Session::Watch> watch =
      session.watch([suspicion = follower.suspicion_, id = reader.id()](const StreamEvent& event) {
        if (event.stream.id != id) return;
        suspicion->store(event.kind == StreamEvent::Kind::removed, std::memory_order_relaxed);
      });
  if (!watch) return std::move(watch).error();
  follower.watch_ = std::move(*watch);
  return follower;
}

// A stream that is created anew at once goes on, and after a restart of its dssmd one may look
// removed until those who hold it have offered it back: only answers that there is none count, and
// only if that stays so. While another host is away dssmd tells of its stream what the mirror
// knows.
bool Follower::removed() {
  bool gone = false;
  if (suspicion_->load(std::memory_order_relaxed) && session_.is_connected()) {
    const Result<StreamInfo> now = session_.stream_info(reader_.id());
    gone = !now && now.error().code == Errc::not_found;
  }
  if (!gone) {
    gone_since_.reset();
    return false;
  }
  if (!gone_since_) gone_since_ = MonoClock::now();
  return MonoClock::now() - *gone_since_ >= patience_;
}

Follower::Wake Follower::wait(MonoTime deadline) {
  while (true) {
    if (stop_requested() || out_.reader_gone()) return Wake::stop;
    if (removed() || reader_.restart_error()) return Wake::ended;
    const MonoTime look_up = std::min(deadline, deadline_in(kStopLookUp));
    if (reader_.wait(look_up) == WaitStatus::ready) return Wake::sample;
    if (MonoClock::now() >= deadline) return Wake::deadline;
  }
}

Error end_of(const RawReader& reader) {
  if (std::optional<Error> trouble = reader.restart_error()) return *std::move(trouble);
  return {Errc::not_found,
          "follow '" + reader.id().str() + "': it was removed; start again if it was created anew"};
}

void say_began_anew(const RawReader& reader) {
  complain("dssmctl: '" + escaped(reader.id().str()) + "': the stream began anew\n");
}

}  // namespace dssm::ctl
