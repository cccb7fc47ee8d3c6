// SPDX-License-Identifier: Apache-2.0
//
// What fuzzer.cpp calls with each input; every fuzzer defines it. It aborts when a promise is
// broken.
#pragma once

#include <cstdint>
#include <span>

namespace dssm::fuzz {

void run_input(std::span<const std::uint8_t> input);

}  // namespace dssm::fuzz
