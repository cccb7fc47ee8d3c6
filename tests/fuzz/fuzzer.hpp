// SPDX-License-Identifier: Apache-2.0
//
// What fuzzer.cpp calls with each input; every fuzzer defines it. It aborts when a promise is
// broken. fuzzer.cpp aborts when it took more processor time, or memory of the heap, than the bytes
// that it was fed allow: a peer may cost what it sends, and not much more.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>

namespace dssm::fuzz {

void run_input(std::span<const std::uint8_t> input);

// For run_input(): it feeds so many bytes that are not in the input.
void count_bytes(std::size_t bytes) noexcept;

}  // namespace dssm::fuzz
