// SPDX-License-Identifier: Apache-2.0
//
// Drawings by programs that draw better than we would: Graphviz, gnuplot.
#pragma once

#include <dssm/result.hpp>
#include <string>
#include <vector>

namespace dssm::ctl {

// Runs `command`, which reads `text` and writes `file`; what it reports goes to standard error.
//   install_hint  what to do when there is no such program, for people
//   fails         not_found (no such program), system
Result<void> draw(const std::string& file, std::vector<std::string> command,
                  const std::string& text, const std::string& install_hint);

}  // namespace dssm::ctl
