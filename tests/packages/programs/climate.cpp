// SPDX-License-Identifier: Apache-2.0
//
// Writes a sample through the installed dssmd and reads it back; exits with 0 when it is the same.
#include <cstdio>
#include <dssm/dssm.hpp>

struct Climate {
  double temperature_c;
};
DSSM_DESCRIBE(Climate, temperature_c)

int main() {
  using namespace std::chrono_literals;
  auto session = dssm::Session::connect();
  if (!session) return std::fprintf(stderr, "%s\n", session.error().message.c_str()), 1;
  auto writer = session->create<Climate>("climate", 1s, 100ms);
  if (!writer) return std::fprintf(stderr, "%s\n", writer.error().message.c_str()), 1;
  writer->write({21.5});
  auto reader = session->open_reader<Climate>("climate");
  if (!reader) return std::fprintf(stderr, "%s\n", reader.error().message.c_str()), 1;
  Climate climate{};
  dssm::SampleInfo info;
  if (reader->read_newest(climate, info) != dssm::ReadStatus::ok) return 2;
  return climate.temperature_c == 21.5 ? 0 : 3;
}
