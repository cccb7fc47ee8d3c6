// SPDX-License-Identifier: Apache-2.0
#include "messages.hpp"

#include <algorithm>
#include <cstdio>
#include <cstring>

namespace dssm::ssm {
namespace {

// Per thread and of fixed size: no lock that a signal handler could meet, nothing to free.
thread_local char last_error[512];

}  // namespace

void remember_error(std::string_view text) noexcept {
  const std::size_t length = std::min(text.size(), sizeof last_error - 1);
  std::memcpy(last_error, text.data(), length);
  last_error[length] = '\0';
}

void report_error(std::string_view text) noexcept {
  remember_error(text);
  std::fprintf(stderr, "SSM ERROR : %.*s\n", static_cast<int>(text.size()), text.data());
}

const char* remembered_error() noexcept { return last_error; }

}  // namespace dssm::ssm
