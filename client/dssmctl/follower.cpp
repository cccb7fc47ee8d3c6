// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/follower.hpp"

#include <algorithm>

#include "client/dssmctl/stop_signal.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {

Result<Follower> Follower::open(Session& session, RawReader& reader, Output& out) {
  Follower follower(session, reader, out);
  Result<Session::Watch> watch =
      session.watch([suspicion = follower.suspicion_, id = reader.id()](const StreamEvent& event) {
        if (event.stream.id == id && event.kind == StreamEvent::Kind::removed) {
          suspicion->store(true, std::memory_order_relaxed);
        }
      });
  if (!watch) return std::move(watch).error();
  follower.watch_ = std::move(*watch);
  return follower;
}

// After a restart of dssmd a stream may look removed for a moment, until those who hold it have
// offered it back, and one that is created anew at once goes on: only the answer that there is none
// counts.
bool Follower::removed() {
  if (!suspicion_->exchange(false, std::memory_order_relaxed)) return false;
  const Result<StreamInfo> now = session_.info(reader_.id());
  return !now && now.error().code == Errc::not_found;
}

Follower::Wake Follower::wait(MonoTime deadline) {
  while (true) {
    if (stop_requested() || out_.reader_gone()) return Wake::stop;
    if (removed() || reader_.trouble()) return Wake::ended;
    const MonoTime look_up = std::min(deadline, deadline_in(kLookUp));
    if (reader_.wait(look_up) == WaitStatus::ready) return Wake::sample;
    if (MonoClock::now() >= deadline) return Wake::deadline;
  }
}

Error end_of(const RawReader& reader) {
  if (std::optional<Error> trouble = reader.trouble()) return *std::move(trouble);
  return {Errc::not_found,
          "follow '" + reader.id().str() + "': it was removed; start again if it was created anew"};
}

void say_began_anew(const RawReader& reader) {
  complain("dssmctl: '" + escaped(reader.id().str()) + "': the stream began anew\n");
}

}  // namespace dssm::ctl
