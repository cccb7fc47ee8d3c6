// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <dssm/session.hpp>
#include <string>

namespace dssm::ctl {

// What this PC's dssmd knows, as OpenMetrics text (docs/metrics.md).
//   fails  as the session's calls
Result<std::string> metrics_text(Session& session);

}  // namespace dssm::ctl
