// SPDX-License-Identifier: Apache-2.0
//
// A program with debug information that describes nothing: it writes a sample to the stream
// "wheel_state", and has that open until it is ended.
#include <unistd.h>

#include <cstdint>
#include <dssm/dssm.hpp>

struct WheelState {
  double travel_m;
  std::int32_t ticks, gear;
};
struct LampState {
  double watts;
  std::int64_t is_on;
};

int main() {
  dssm::Session session = dssm::Session::connect().value();
  const WheelState state{1.5, 3, 1};
  const LampState lamp{40, 1};
  auto writer = session
                    .create_raw({"wheel_state", 0, ""},
                                dssm::TypeInfo{"WheelState", sizeof state, alignof(WheelState), {}},
                                {8, std::chrono::milliseconds(10)})
                    .value();
  writer.write(std::as_bytes(std::span(&state, 1)));
  // The type is in the debug information if it is used.
  return lamp.watts > 0 ? ::pause() : 0;
}
