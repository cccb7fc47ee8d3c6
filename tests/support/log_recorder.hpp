// SPDX-License-Identifier: Apache-2.0
//
// The logger of tests: keeps what is logged.
#pragma once

#include <algorithm>
#include <string>
#include <string_view>
#include <vector>

#include "daemon/base/log.hpp"

namespace dssm::daemon {

class LogRecorder final : public Logger {
 public:
  void write(LogLevel level, std::string_view text, const LogFields&) noexcept override {
    lines.emplace_back(text);
    if (level <= LogLevel::notice) notices.emplace_back(text);
    if (level <= LogLevel::warning) warnings.emplace_back(text);
  }

  // Whether a line contains `words`.
  bool contains(std::string_view words) const {
    return std::any_of(lines.begin(), lines.end(), [&](const std::string& line) {
      return line.find(words) != std::string::npos;
    });
  }

  std::vector<std::string> lines;     // of all levels
  std::vector<std::string> notices;   // notices, warnings and errors
  std::vector<std::string> warnings;  // warnings and errors
};

}  // namespace dssm::daemon
