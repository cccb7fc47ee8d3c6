// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/follower.hpp"

#include <algorithm>

#include "client/dssmctl/stop_signal.hpp"

namespace dssm::ctl {

Result<Follower> Follower::open(Session& session, RawReader& reader, Output& out) {
  Follower follower(session, reader, out);
  Result<Session::Watch> watch =
      session.watch([suspicion = follower.suspicion_, id = reader.id(),
                     incarnation = reader.incarnation()](const StreamEvent& event) {
        if (event.stream.id != id) return;
        if (event.kind == StreamEvent::Kind::removed || event.stream.incarnation != incarnation) {
          suspicion->store(true, std::memory_order_relaxed);
        }
      });
  if (!watch) return std::move(watch).error();
  follower.watch_ = std::move(*watch);
  return follower;
}

// After a restart of dssmd a stream may look removed for a moment, until those who hold it have
// offered it back: only an answer that names another stream, or none, counts.
bool Follower::removed() {
  if (!suspicion_->exchange(false, std::memory_order_relaxed)) return false;
  const Result<StreamInfo> now = session_.info(reader_.id());
  if (now) return now->incarnation != reader_.incarnation();
  return now.error().code == Errc::not_found;
}

Follower::Wake Follower::wait(MonoTime deadline) {
  while (true) {
    if (stop_requested() || out_.reader_gone()) return Wake::stop;
    if (removed()) return Wake::removed;
    const MonoTime look_up = std::min(deadline, deadline_in(kLookUp));
    if (reader_.wait(look_up) == WaitStatus::ready) return Wake::sample;
    if (MonoClock::now() >= deadline) return Wake::deadline;
  }
}

Error removed_error(const RawReader& reader) {
  return {Errc::not_found,
          "follow '" + reader.id().str() + "': it was removed; start again if it was created anew"};
}

}  // namespace dssm::ctl
