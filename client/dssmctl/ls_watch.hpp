// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls --watch.
#pragma once

#include <dssm/session.hpp>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/stream_filter.hpp"

namespace dssm::ctl {

// Success after a stop signal, or when `out` is no longer read.
Result<void> watch_streams(Session& session, const LsOptions& options, const StreamFilter& filter,
                           Output& out);

}  // namespace dssm::ctl
