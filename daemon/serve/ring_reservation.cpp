// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/ring_reservation.hpp"

#include <algorithm>

namespace dssm::daemon {

Result<bool> RingReservation::go_on() {
  const std::uint64_t total_bytes = stream_->mapping().geometry().total_bytes;
  const std::uint64_t slice = std::min(total_bytes - reserved_bytes_, kSliceBytes);
  if (Result<void> reserved = stream_->reserve(reserved_bytes_, slice); !reserved) {
    return std::move(reserved).error();
  }
  reserved_bytes_ += slice;
  return reserved_bytes_ == total_bytes;
}

}  // namespace dssm::daemon
