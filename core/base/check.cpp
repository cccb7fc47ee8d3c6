// SPDX-License-Identifier: Apache-2.0
#include "core/base/check.hpp"

#include <cstdio>
#include <cstdlib>

namespace dssm {

void check_failed(const char* expression, const char* file, int line) noexcept {
  std::fprintf(stderr, "dssm: bug: %s does not hold at %s:%d\n", expression, file, line);
  std::abort();
}

}  // namespace dssm
