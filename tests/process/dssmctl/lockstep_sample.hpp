// SPDX-License-Identifier: Apache-2.0
//
// What the streams of lockstep_test.cpp and lockstep_program.cpp carry.
#pragma once

#include <cstdint>

namespace dssm::test {

struct Numbered {
  std::int64_t number;
};

}  // namespace dssm::test
