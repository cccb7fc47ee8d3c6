// SPDX-License-Identifier: Apache-2.0
//
// Takes a ring's memory from the system before anybody writes to it, as the library does for the
// programs of this PC: dssmd itself writes to rings that were created over the network, and
// would be killed by a page that cannot be had. A gigabyte takes a quarter of a second, so it goes
// in slices of kSliceBytes, one per turn of the loop.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <memory>

#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

class RingReservation {
 public:
  static constexpr std::uint64_t kSliceBytes = 4U << 20;  // about 1 ms

  explicit RingReservation(std::shared_ptr<Stream> stream) : stream_(std::move(stream)) {}

  // Takes the next slice. True when it was the last one.
  //   fails  no_memory
  Result<bool> go_on();

 private:
  std::shared_ptr<Stream> stream_;
  std::uint64_t reserved_bytes_ = 0;
};

}  // namespace dssm::daemon
