// SPDX-License-Identifier: Apache-2.0
//
// <ssm.h>: reading, writing and waiting.
#include <algorithm>
#include <cstring>

#include "../include/libssm.h"
#include "convert.hpp"
#include "process.hpp"

using dssm::ReadStatus;
using dssm::ssm::remember_error;
using dssm::ssm::ring_tid;
using dssm::ssm::seconds_from_time;
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

SSM_tid error_of(ReadStatus status) noexcept {
  if (status == ReadStatus::clock_out_of_bounds) {
    remember_error(
        "read by time : the clocks of this PC and the stream's are not known to be close "
        "enough (dssmctl clock)");
    return SSM_ERROR_NO_DATA;
  }
  return is_to_come(status) ? SSM_ERROR_NO_DATA : SSM_ERROR_PAST;
}

// Reads by `read` and passes the sample to `take`, exactly once, if there is one.
template <class Read, class Take>
SSM_tid read_and_take(SSM_sid sid, ssmTimeT* ytime, Read read, Take take) {
  const SidUse use(sid);
  if (!use) return SSM_ERROR_NO_DATA;
  Stream::Copy copy(*use);
  if (const SSM_tid error = read(*use, copy); error < 0) return error;
  take(copy.payload().data(), use->data_bytes());
  if (ytime) *ytime = seconds_from_time(copy.info.time);
  return ssm_tid(copy.info.tid);
}

// --- for read_and_take()

auto by_tid(SSM_tid tid) {
  return [tid](Stream& stream, Stream::Copy& copy) -> SSM_tid {
    if (tid < 0) {
      const ReadStatus status = stream.latest(copy);
      return status == ReadStatus::ok ? 0 : error_of(status);
    }
    dssm::Tid wanted = ring_tid(tid, stream.newest());
    ReadStatus status = stream.tid(wanted, copy);
    // Programs that read one sample after the other would wait for it for ever.
    if (status == ReadStatus::lost && !is_to_come(status = stream.skip_lost(wanted))) {
      status = stream.tid(wanted, copy);
    }
    if (status == ReadStatus::ok) return 0;
    return is_to_come(status) ? SSM_ERROR_FUTURE : SSM_ERROR_PAST;
  };
}
auto by_time(ssmTimeT time) {
  return [time](Stream& stream, Stream::Copy& copy) -> SSM_tid {
    const ReadStatus status =
        time > 0 ? stream.at(time_from_seconds(time), copy) : stream.latest(copy);
    return status == ReadStatus::ok ? 0 : error_of(status);
  };
}
auto copy_to(void* data) {
  return [data](const void* sample, std::size_t bytes) { std::memcpy(data, sample, bytes); };
}
auto pass_to(ReadCallback callback, void* adata, void* user_data) {
  return [=](const void* sample, std::size_t) { callback(sample, adata, user_data); };
}

SSM_tid written(dssm::Tid tid) {
  if (tid != dssm::kNoTid) return ssm_tid(tid);
  remember_error("write : the stream cannot be written now");
  return SSM_ERROR_NO_DATA;
}

}  // namespace

extern "C" {

SSM_tid getTID_top(SSM_sid sid) {
  const SidUse use(sid);
  return use ? ssm_tid(use->newest()) : SSM_ERROR_NO_DATA;
}

SSM_tid getTID_bottom(SSM_sid sid) {
  const SidUse use(sid);
  return use ? ssm_tid(use->oldest()) : SSM_ERROR_NO_DATA;
}

SSM_tid getTID(SSM_sid sid, ssmTimeT ytime) {
  const SidUse use(sid);
  if (!use) return SSM_ERROR_NO_DATA;
  dssm::SampleInfo info;
  const ReadStatus status = use->find(dssm::ssm::time_before(ytime), info);
  return status == ReadStatus::ok ? ssm_tid(info.tid) : error_of(status);
}

double getClockErrorSSM(SSM_sid sid, SSM_tid tid) {
  const SidUse use(sid);
  if (!use) return -1;
  const dssm::Tid newest = use->newest();
  const dssm::Duration error = use->clock_error(tid < 0 ? newest : ring_tid(tid, newest));
  return error == dssm::kUnknownClockError ? -1 : std::chrono::duration<double>(error).count();
}

int waitTID(SSM_sid sid, SSM_tid tid) {
  const SidUse use(sid);
  if (!use) return -1;
  const dssm::Tid newest = use->newest();
  if (tid < 0) return 1;
  const dssm::Tid wanted = ring_tid(tid, newest);
  const dssm::MonoTime deadline = dssm::deadline_in(kWait);
  for (;;) {
    if (use->newest() >= wanted) return 1;
    if (use.closed()) return -1;
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= deadline) return 0;
    static_cast<void>(use->wait_for_tid(wanted, std::min(deadline, now + kCheckPause)));
  }
}

SSM_tid dssm_ssm_next(SSM_sid sid, SSM_tid tid, int waits) {
  const SidUse use(sid);
  if (!use || tid < 0) return SSM_ERROR_NO_DATA;
  dssm::Tid next = ring_tid(tid, use->newest());
  const dssm::MonoTime deadline = dssm::deadline_in(waits ? kWait : dssm::Duration::zero());
  for (;;) {
    if (use->newest() >= next && !is_to_come(use->skip_lost(next))) return ssm_tid(next);
    if (use.closed()) return SSM_ERROR_NO_DATA;
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now >= deadline) return SSM_ERROR_FUTURE;
    static_cast<void>(use->wait_for_sample(next, std::min(deadline, now + kCheckPause)));
  }
}

SSM_tid readSSM(SSM_sid sid, void* data, ssmTimeT* ytime, SSM_tid tid) {
  return read_and_take(sid, ytime, by_tid(tid), copy_to(data));
}

SSM_tid readSSM_time(SSM_sid sid, void* data, ssmTimeT ytime, ssmTimeT* ret_time) {
  return read_and_take(sid, ret_time, by_time(ytime), copy_to(data));
}

SSM_tid readSSMP(SSM_sid sid, void* adata, ssmTimeT* ytime, SSM_tid tid, ReadCallback callback,
                 void* user_data) {
  return read_and_take(sid, ytime, by_tid(tid), pass_to(callback, adata, user_data));
}

SSM_tid readSSMP_time(SSM_sid sid, void* adata, ssmTimeT ytime, ssmTimeT* ret_time,
                      ReadCallback callback, void* user_data) {
  return read_and_take(sid, ret_time, by_time(ytime), pass_to(callback, adata, user_data));
}

SSM_tid writeSSM(SSM_sid sid, const void* data, ssmTimeT ytime) {
  const SidUse use(sid);
  if (!use) return SSM_ERROR_NO_DATA;
  return written(use->write(data, time_from_seconds(ytime)));
}

SSM_tid writeSSM_time(SSM_sid sid, const void* data, ssmTimeT ytime) {
  return writeSSM(sid, data, ytime);
}

SSM_tid writeSSMP(SSM_sid sid, const void* adata, ssmTimeT ytime, WriteCallback callback,
                  void* user_data) {
  const SidUse use(sid);
  if (!use) return SSM_ERROR_NO_DATA;
  return written(use->write_in_place([&](std::byte* slot) { callback(slot, adata, user_data); },
                                     time_from_seconds(ytime)));
}

SSM_tid writeSSMP_time(SSM_sid sid, const void* adata, ssmTimeT ytime, WriteCallback callback,
                       void* user_data) {
  return writeSSMP(sid, adata, ytime, callback, user_data);
}

}  // extern "C"
