// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/notify.hpp"

#include <systemd/sd-daemon.h>

namespace dssm::daemon {

// sd_notify's failures are ignored: a manager that does not listen is no reason to stop serving.
void notify_ready(const std::string& status) {
  sd_notify(0, ("READY=1\nSTATUS=" + status).c_str());
}

void notify_stopping() { sd_notify(0, "STOPPING=1"); }

}  // namespace dssm::daemon
