// SPDX-License-Identifier: Apache-2.0
//
// Ctrl-C for verbs that run until told otherwise: SIGINT and SIGTERM end them with success, after
// their last words. All other verbs die of these signals at once, as programs do.
#pragma once

namespace dssm::ctl {

// From now on SIGINT and SIGTERM only set a mark, and interrupt system calls.
void catch_stop_signals();

bool stop_requested();

}  // namespace dssm::ctl
