// SPDX-License-Identifier: Apache-2.0
//
// Callbacks in a program that runs libevent's loop. Its functions are called through C, so no
// callback may throw.
#include <event2/event.h>
#include <signal.h>

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
  const auto climate =
      session
          .subscribe<Climate>("climate",
                              [](const dssm::Sample<Climate>& now, dssm::Reader<Climate>& reader) {
                                const auto then = reader.read_at(now.time() - 1s, 150ms);
                                const double before = (then ? *then : now).value.temperature_c;
                                std::printf("%ld: %.2f degrees, %+.2f in a second\n", now.tid(),
                                            now.value.temperature_c,
                                            now.value.temperature_c - before);
                              },
                              {.executor = &executor})
          .value();

  event_base* loop = ::event_base_new();
  const auto on_ready = [](int, short, void* ready) {
    static_cast<dssm::Executor*>(ready)->run_ready();
  };
  const auto on_interrupt = [](int, short, void* interrupted) {
    ::event_base_loopbreak(static_cast<event_base*>(interrupted));
  };
  event* ready = ::event_new(loop, executor.fd(), EV_READ | EV_PERSIST, on_ready, &executor);
  event* interrupt = ::evsignal_new(loop, SIGINT, on_interrupt, loop);
  ::event_add(ready, nullptr);
  ::event_add(interrupt, nullptr);
  ::event_base_dispatch(loop);  // until Ctrl-C
  ::event_free(interrupt);
  ::event_free(ready);
  ::event_base_free(loop);
}
