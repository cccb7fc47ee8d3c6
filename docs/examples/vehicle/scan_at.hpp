// SPDX-License-Identifier: Apache-2.0
//
// The scan that a pose belongs to. On another PC than the lidar's, the two streams come by
// connections of their own, and a pose may be there before its scan.
#pragma once

#include <dssm/reader.hpp>

#include "samples.hpp"

namespace vehicle {

class ScanAt {
 public:
  // `deadline` is how long at() waits for a scan at most.
  ScanAt(dssm::Reader<Scan> reader, dssm::Duration deadline);

  // Copies the scan that was taken at `t`, which is number `tid`. When it is not there yet, waits
  // for it. False when it does not come in time, when the ring no longer holds it, or when a signal
  // asks to stop.
  bool at(dssm::Time t, dssm::Tid tid, Scan& out);

 private:
  dssm::Reader<Scan> reader_;
  dssm::Duration deadline_;
};

}  // namespace vehicle
