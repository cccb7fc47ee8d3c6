// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/ring_reservation.hpp"

#include <algorithm>

#include "core/base/try.hpp"

namespace dssm::daemon {

Result<bool> RingReservation::go_on() {
  const std::uint64_t total_bytes = stream_->mapping().geometry().total_bytes;
  const std::uint64_t slice = std::min(total_bytes - reserved_bytes_, kSliceBytes);
  DSSM_TRY(stream_->reserve(reserved_bytes_, slice));
  reserved_bytes_ += slice;
  return reserved_bytes_ == total_bytes;
}

}  // namespace dssm::daemon
