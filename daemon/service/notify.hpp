// SPDX-License-Identifier: Apache-2.0
//
// Tells the service manager how dssmd is doing. Does nothing where nobody asked ($NOTIFY_SOCKET).
#pragma once

#include <string>

namespace dssm::daemon {

void notify_ready(const std::string& status);
void notify_stopping();

}  // namespace dssm::daemon
