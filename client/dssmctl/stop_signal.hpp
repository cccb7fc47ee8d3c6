// SPDX-License-Identifier: Apache-2.0
//
// Ctrl-C for verbs that run until then: SIGINT and SIGTERM end them with success, after their final
// output. All other verbs end by these signals at once, as programs do.
#pragma once

#include <dssm/time.hpp>

namespace dssm::ctl {

// From now on SIGINT and SIGTERM only set a mark, and interrupt system calls.
void catch_stop_signals();

bool stop_requested();

// How long to wait at most before checking stop_requested() again: a signal that comes between the
// check and the wait does not interrupt the wait.
inline constexpr Duration kStopCheckPeriod = std::chrono::milliseconds(100);

}  // namespace dssm::ctl
