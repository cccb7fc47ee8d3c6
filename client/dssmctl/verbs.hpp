// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl can do: run() once per verb, one file per group of them. Each connects, works, and
// adds its output to `out`; main() flushes and turns a failure into an exit status.
#pragma once

#include <dssm/result.hpp>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

Result<void> run(const LsOptions& options, Output& out);
Result<void> run(const HostsOptions& options, Output& out);
Result<void> run(const ClockOptions& options, Output& out);
Result<void> run(const DoctorOptions& options, Output& out);
Result<void> run(const PingOptions& options, Output& out);
Result<void> run(const InfoOptions& options, Output& out);
Result<void> run(const EchoOptions& options, Output& out);
Result<void> run(const HzOptions& options, Output& out);
Result<void> run(const BwOptions& options, Output& out);
Result<void> run(const DelayOptions& options, Output& out);
Result<void> run(const CreateOptions& options, Output& out);
Result<void> run(const RmOptions& options, Output& out);
Result<void> run(const PropertyGetOptions& options, Output& out);
Result<void> run(const PropertySetOptions& options, Output& out);
Result<void> run(const PlaybackOptions& options, Output& out);

}  // namespace dssm::ctl
