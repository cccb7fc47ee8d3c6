// SPDX-License-Identifier: Apache-2.0
#include "tests/unit/daemon/link/fake_transport.hpp"

#include <event2/event.h>

namespace dssm::daemon {

void run_turns(const EventLoop& loop, int turns) {
  for (int i = 0; i < turns; ++i) event_base_loop(loop.base(), EVLOOP_ONCE | EVLOOP_NONBLOCK);
}

}  // namespace dssm::daemon
