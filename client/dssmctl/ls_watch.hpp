// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls --watch.
#pragma once

#include <dssm/session.hpp>

#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/stream_filter.hpp"

namespace dssm::ctl {

// Success when told to stop, or when nobody reads `out` any more.
Result<void> watch_streams(Session& session, const Options& options, const StreamFilter& filter,
                           Output& out);

}  // namespace dssm::ctl
