// SPDX-License-Identifier: Apache-2.0
//
// Asking another program of this PC, one that answers in a few lines and at once.
#pragma once

#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <vector>

namespace dssm::ctl {

struct ProgramEnd {
  bool in_time = true;   // else it was killed
  int exit_status = -1;  // -1: ended by a signal
  std::string output;    // standard output and error, at most kMaxProgramOutput bytes
};

inline constexpr std::size_t kMaxProgramOutput = 64U << 10;

// Runs `argv` (found by $PATH) without input until it ends, or kills it after `timeout`. Nothing
// when there is no such program.
std::optional<ProgramEnd> run_program(std::vector<std::string> argv, Duration timeout);

}  // namespace dssm::ctl
