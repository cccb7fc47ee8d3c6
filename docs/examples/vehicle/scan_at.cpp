// SPDX-License-Identifier: Apache-2.0
#include "scan_at.hpp"

#include <algorithm>
#include <utility>

#include "stop.hpp"

namespace vehicle {

ScanAt::ScanAt(dssm::Reader<Scan> reader, dssm::Duration deadline)
    : reader_(std::move(reader)), deadline_(deadline) {}

bool ScanAt::at(dssm::Time t, dssm::Tid tid, Scan& out) {
  const dssm::MonoTime deadline = dssm::deadline_in(deadline_);
  dssm::SampleInfo info;
  while (!stop_requested()) {
    const bool written =
        reader_.newest_tid() >= tid;  // before the read, so that at() misses no scan
    const dssm::ReadStatus status = reader_.read_at(t, out, info);
    if (status == dssm::ReadStatus::restarted) continue;
    if (status == dssm::ReadStatus::ok && info.tid == tid) return true;
    const dssm::MonoTime now = dssm::MonoClock::now();
    // From another PC the newest scans come first, and this one may be on its way.
    const bool is_awaited = !written || status == dssm::ReadStatus::arriving;
    if (!is_awaited || now >= deadline) return false;
    (void)reader_.wait_for_sample(tid, std::min(deadline, now + kSlice));
  }
  return false;
}

}  // namespace vehicle
