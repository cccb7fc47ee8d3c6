// SPDX-License-Identifier: Apache-2.0
//
// Ctrl-C for verbs that run until told otherwise: SIGINT and SIGTERM end them with success, after
// their last words. All other verbs die of these signals at once, as programs do.
#pragma once

#include <dssm/time.hpp>

namespace dssm::ctl {

// From now on SIGINT and SIGTERM only set a mark, and interrupt system calls.
void catch_stop_signals();

bool stop_requested();

// How long to wait at most before looking at stop_requested() again: a signal that comes between
// the look and the wait does not interrupt it.
inline constexpr Duration kStopLookUp = std::chrono::milliseconds(100);

}  // namespace dssm::ctl
