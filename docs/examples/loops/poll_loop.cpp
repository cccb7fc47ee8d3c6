// SPDX-License-Identifier: Apache-2.0
//
// Callbacks in a program that waits in poll(), here also for lines of standard input. All calls
// come from main()'s thread, so nothing needs a lock.
#include <poll.h>
#include <unistd.h>

#include <array>
#include <cstdio>
#include <dssm/dssm.hpp>

struct Climate {
  double temperature_c;
  float humidity;
};
DSSM_DESCRIBE(Climate, temperature_c, humidity)

int main() {
  using namespace std::chrono_literals;
  auto session = dssm::Session::connect().value();  // value() throws the error
  auto executor = dssm::Executor::create().value();
  bool shown = true;
  const auto climate =
      session
          .subscribe<Climate>("climate",
                              [&](const dssm::Sample<Climate>& now, dssm::Reader<Climate>& reader) {
                                const auto then = reader.read_at(now.time() - 1s, 150ms);
                                const double before = (then ? *then : now).value.temperature_c;
                                if (!shown) return;
                                std::printf("%ld: %.2f degrees, %+.2f in a second\n", now.tid(),
                                            now.value.temperature_c,
                                            now.value.temperature_c - before);
                              },
                              {.executor = &executor})
          .value();

  std::array fds{pollfd{executor.fd(), POLLIN, 0}, pollfd{STDIN_FILENO, POLLIN, 0}};
  while (::poll(fds.data(), fds.size(), -1) > 0) {
    if (fds[0].revents != 0) executor.run_ready();
    if (fds[1].revents == 0) continue;
    std::array<char, 80> line;
    if (::read(STDIN_FILENO, line.data(), line.size()) > 0) {
      shown = !shown;  // Return switches the output off and on
    } else {
      fds[1].fd = -1;  // the end of the input: no longer waited for
    }
  }
}
