// SPDX-License-Identifier: Apache-2.0
//
// Reads the scan of a pose. On another PC than the lidar's, the two streams have separate
// connections, and a pose may arrive before its scan.
#pragma once

#include <dssm/reader.hpp>

#include "samples.hpp"

namespace vehicle {

class ScanAt {
 public:
  // `deadline` is the longest time that at() waits for a scan.
  ScanAt(dssm::Reader<Scan> reader, dssm::Duration deadline);

  // Copies scan `tid`, whose time is `t`, and waits for it if necessary. False after the deadline,
  // when the ring no longer holds the scan, or after a signal to stop.
  bool at(dssm::Time t, dssm::Tid tid, Scan& out);

 private:
  dssm::Reader<Scan> reader_;
  dssm::Duration deadline_;
};

}  // namespace vehicle
