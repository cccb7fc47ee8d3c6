// SPDX-License-Identifier: Apache-2.0
//
// <ssm.h>: reading, writing and waiting.
#include <algorithm>
#include <ctime>

#include "../include/libssm.h"
#include "convert.hpp"
#include "process.hpp"

using dssm::ReadStatus;
using dssm::ssm::remember_error;
using dssm::ssm::ring_tid;
using dssm::ssm::seconds_from_time;
using dssm::ssm::SidTurn;
using dssm::ssm::SidUse;
using dssm::ssm::ssm_tid;
using dssm::ssm::Stream;
using dssm::ssm::time_from_seconds;

namespace {

using ReadCallback = void (*)(const void* ssmp, void* data, void* user_data);
using WriteCallback = void (*)(void* ssmp, const void* data, void* user_data);

constexpr dssm::Duration kWait = std::chrono::seconds(1);
// A handler that closes the sid interrupts a wait; another thread's closing is seen by a check.
constexpr dssm::Duration kCheckPause = std::chrono::milliseconds(100);

bool is_to_come(ReadStatus status) noexcept {
  return status == ReadStatus::not_yet || status == ReadStatus::arriving;
}

// After a wait that did not bring the sample. A new ring ends a wait, too: not in a tight loop
// while it cannot be opened.
void pause_after(dssm::WaitStatus waited) noexcept {
  if (waited != dssm::WaitStatus::ready) return;
  constexpr timespec kPause{0, 1'000'000};
  ::nanosleep(&kPause, nullptr);
}

// How long a call still waits. A wait that timed out counts as long as it was to be, not as long as
// it was: in lockstep (dssm/playback_clock.hpp) it lasts that long by the playback clock only.
class WaitBudget {
 public:
  explicit WaitBudget(dssm::Duration time) noexcept : left_(time) {}
  bool is_spent() const noexcept { return left_ <= dssm::Duration::zero(); }

  template <class Wait>
  dssm::WaitStatus spend(Wait wait) noexcept {
    const dssm::MonoTime begin = dssm::MonoClock::now();
    const dssm::Duration part = std::min(left_, kCheckPause);
    const dssm::WaitStatus waited = wait(begin + part);
    left_ -= waited == dssm::WaitStatus::timeout ? part : dssm::MonoClock::now() - begin;
    return waited;
  }

 private:
  dssm::Duration left_;
};

SSM_tid error_of(ReadStatus status) noexcept {
  if (status == ReadStatus::clock_out_of_bounds) {
    remember_error(
        "read by time : the clocks of this PC and the stream's are not known to be close "
        "enough (dssmctl clock)");
    return SSM_ERROR_NO_DATA;
  }
  return is_to_come(status) ? SSM_ERROR_NO_DATA : SSM_ERROR_PAST;
}

// Reads by `read` into `data`.
template <class Read>
SSM_tid read_into(SSM_sid sid, void* data, ssmTimeT* ytime, Read read) {
  const SidTurn turn(sid);
  if (!turn) return SSM_ERROR_NO_DATA;
  dssm::SampleInfo info;
  if (const SSM_tid error = read(*turn, Stream::Target(data), info, turn.alone()); error < 0) {
    return error;
  }
  if (ytime) *ytime = seconds_from_time(info.time);
  return ssm_tid(info.tid);
}

// Reads by `read` and passes the sample to `callback`, exactly once, if there is one. The turn is
// over by then: the callback may take its time.
template <class Read>
SSM_tid read_for(ReadCallback callback, SSM_sid sid, void* adata, void* user_data, ssmTimeT* ytime,
                 Read read) {
  const SidUse use(sid);
  if (!use) return SSM_ERROR_NO_DATA;
  Stream::Copy copy(*use);
  dssm::SampleInfo info;
  {
    const SidTurn turn(sid);
    if (!turn) return SSM_ERROR_NO_DATA;
    const SSM_tid error = read(*use, Stream::Target(copy), info, turn.alone());
    if (error < 0) return error;
  }
  callback(copy.payload(), adata, user_data);
  if (ytime) *ytime = seconds_from_time(info.time);
  return ssm_tid(info.tid);
}

// --- for these two

auto by_tid(SSM_tid tid) {
  return [tid](Stream& stream, Stream::Target out, dssm::SampleInfo& info, bool alone) -> SSM_tid {
    if (tid < 0) {
      const ReadStatus status = stream.latest(out, info, alone);
      return status == ReadStatus::ok ? 0 : error_of(status);
    }
    dssm::Tid wanted = ring_tid(tid, stream.newest(alone));
    ReadStatus status = stream.tid(wanted, out, info, alone);
    // Programs that read one sample after the other would wait for it for ever.
    if (status == ReadStatus::lost && !is_to_come(status = stream.skip_lost(wanted, alone))) {
      status = stream.tid(wanted, out, info, alone);
    }
    if (status == ReadStatus::ok) return 0;
    return is_to_come(status) ? SSM_ERROR_FUTURE : SSM_ERROR_PAST;
  };
}
auto by_time(ssmTimeT time) {
  return [time](Stream& stream, Stream::Target out, dssm::SampleInfo& info, bool alone) -> SSM_tid {
    const ReadStatus status = time > 0 ? stream.at(time_from_seconds(time), out, info, alone)
                                       : stream.latest(out, info, alone);
    return status == ReadStatus::ok ? 0 : error_of(status);
  };
}

dssm::Tid newest_of(SSM_sid sid) {
  const SidTurn turn(sid);
  return turn ? turn->newest(turn.alone()) : dssm::kNoTid;
}

SSM_tid written(dssm::Tid tid) {
  if (tid != dssm::kNoTid) return ssm_tid(tid);
  remember_error("write : the stream cannot be written now");
  return SSM_ERROR_NO_DATA;
}

}  // namespace

extern "C" {

SSM_tid getTID_top(SSM_sid sid) {
  const SidTurn turn(sid);
  return turn ? ssm_tid(turn->newest(turn.alone())) : SSM_ERROR_NO_DATA;
}

SSM_tid getTID_bottom(SSM_sid sid) {
  const SidTurn turn(sid);
  return turn ? ssm_tid(turn->oldest(turn.alone())) : SSM_ERROR_NO_DATA;
}

SSM_tid getTID(SSM_sid sid, ssmTimeT ytime) {
  const SidTurn turn(sid);
  if (!turn) return SSM_ERROR_NO_DATA;
  dssm::SampleInfo info;
  const ReadStatus status = turn->find(dssm::ssm::time_before(ytime), info, turn.alone());
  return status == ReadStatus::ok ? ssm_tid(info.tid) : error_of(status);
}

double getClockErrorSSM(SSM_sid sid, SSM_tid tid) {
  const SidTurn turn(sid);
  if (!turn) return -1;
  const dssm::Tid newest = turn->newest(turn.alone());
  const dssm::Duration error =
      turn->clock_error(tid < 0 ? newest : ring_tid(tid, newest), turn.alone());
  return error == dssm::kUnknownClockError ? -1 : std::chrono::duration<double>(error).count();
}

int waitTID(SSM_sid sid, SSM_tid tid) {
  const SidUse use(sid);
  if (!use) return -1;
  if (tid < 0) return 1;
  const dssm::Tid wanted = ring_tid(tid, newest_of(sid));
  WaitBudget budget(kWait);
  for (auto waited = dssm::WaitStatus::timeout;;) {
    if (newest_of(sid) >= wanted) return 1;
    pause_after(waited);
    if (use.closed()) return -1;
    if (budget.is_spent()) return 0;
    waited = budget.spend([&](dssm::MonoTime until) { return use->wait_for_tid(wanted, until); });
  }
}

SSM_tid dssm_ssm_next(SSM_sid sid, SSM_tid tid, int waits) {
  const SidUse use(sid);
  if (!use || tid < 0) return SSM_ERROR_NO_DATA;
  dssm::Tid next = ring_tid(tid, newest_of(sid));
  WaitBudget budget(waits ? kWait : dssm::Duration::zero());
  const auto is_settled = [&] {
    const SidTurn turn(sid);
    return turn && turn->newest(turn.alone()) >= next &&
           !is_to_come(turn->skip_lost(next, turn.alone()));
  };
  for (auto waited = dssm::WaitStatus::timeout;;) {
    if (is_settled()) return ssm_tid(next);
    pause_after(waited);
    if (use.closed()) return SSM_ERROR_NO_DATA;
    if (budget.is_spent()) return SSM_ERROR_FUTURE;
    waited = budget.spend([&](dssm::MonoTime until) { return use->wait_for_sample(next, until); });
  }
}

// These are called for each sample: all that they call in this library becomes a part of them,
// which saves a quarter of the time of a small sample.
[[gnu::flatten]] SSM_tid readSSM(SSM_sid sid, void* data, ssmTimeT* ytime, SSM_tid tid) {
  return read_into(sid, data, ytime, by_tid(tid));
}

[[gnu::flatten]] SSM_tid readSSM_time(SSM_sid sid, void* data, ssmTimeT ytime, ssmTimeT* ret_time) {
  return read_into(sid, data, ret_time, by_time(ytime));
}

SSM_tid readSSMP(SSM_sid sid, void* adata, ssmTimeT* ytime, SSM_tid tid, ReadCallback callback,
                 void* user_data) {
  return read_for(callback, sid, adata, user_data, ytime, by_tid(tid));
}

SSM_tid readSSMP_time(SSM_sid sid, void* adata, ssmTimeT ytime, ssmTimeT* ret_time,
                      ReadCallback callback, void* user_data) {
  return read_for(callback, sid, adata, user_data, ret_time, by_time(ytime));
}

[[gnu::flatten]] SSM_tid writeSSM(SSM_sid sid, const void* data, ssmTimeT ytime) {
  const SidTurn turn(sid);
  if (!turn) return SSM_ERROR_NO_DATA;
  return written(turn->write(data, time_from_seconds(ytime), turn.alone()));
}

SSM_tid writeSSM_time(SSM_sid sid, const void* data, ssmTimeT ytime) {
  return writeSSM(sid, data, ytime);
}

SSM_tid writeSSMP(SSM_sid sid, const void* adata, ssmTimeT ytime, WriteCallback callback,
                  void* user_data) {
  const SidTurn turn(sid, false);  // other threads may read while the callback takes its time
  if (!turn) return SSM_ERROR_NO_DATA;
  return written(turn->write_in_place([&](std::byte* slot) { callback(slot, adata, user_data); },
                                      time_from_seconds(ytime), turn.alone()));
}

SSM_tid writeSSMP_time(SSM_sid sid, const void* adata, ssmTimeT ytime, WriteCallback callback,
                       void* user_data) {
  return writeSSMP(sid, adata, ytime, callback, user_data);
}

}  // extern "C"
