// SPDX-License-Identifier: Apache-2.0
#include <dssm/clock.hpp>

#include "client/src/client.hpp"

namespace dssm::clock {

Reading now() noexcept {
  Reading reading;
  reading.time = WallClock::now();
  reading.earliest = Time::min();
  reading.latest = Time::max();
  const ClockPage* page = detail::latest_clock_page().load(std::memory_order_acquire);
  if (!page) return reading;
  reading.clock_error = clock_error_at(*page, reading.time).value_or(kUnknownClockError);
  reading.status = status_of(*page);
  if (reading.clock_error == kUnknownClockError) return reading;
  reading.earliest = reading.time - reading.clock_error;
  reading.latest = reading.time + reading.clock_error;
  return reading;
}

}  // namespace dssm::clock
