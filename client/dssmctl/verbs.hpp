// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl can do: one function per verb, one file per group of them. Each connects, works, and
// adds what it has to say to `out`; main() flushes and turns a failure into an exit status.
#pragma once

#include <dssm/result.hpp>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

Result<void> run_ls(const Options& options, Output& out);
Result<void> run_hosts(const Options& options, Output& out);
Result<void> run_clock(const Options& options, Output& out);
Result<void> run_doctor(const Options& options, Output& out);
Result<void> run_ping(const Options& options, Output& out);
Result<void> run_info(const Options& options, Output& out);
Result<void> run_echo(const Options& options, Output& out);
Result<void> run_hz(const Options& options, Output& out);
Result<void> run_bw(const Options& options, Output& out);
Result<void> run_delay(const Options& options, Output& out);
Result<void> run_create(const Options& options, Output& out);
Result<void> run_rm(const Options& options, Output& out);
Result<void> run_property_get(const Options& options, Output& out);
Result<void> run_property_set(const Options& options, Output& out);
Result<void> run_playback(const Options& options, Output& out);

}  // namespace dssm::ctl
