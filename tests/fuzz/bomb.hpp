// SPDX-License-Identifier: Apache-2.0
//
// A long frame out of a few bytes of an input. What costs a receiver much is mostly one short thing
// many times, which a fuzzer's mutations, that lengthen inputs little by little, do not find.
#pragma once

#include <google/protobuf/io/coded_stream.h>

#include <cstdint>
#include <span>
#include <string>

#include "tests/fuzz/fuzzer.hpp"

namespace dssm::fuzz {

// Removes its description from `input`, and returns the frame with the length before it; empty when
// the description begins with 0, or nothing is left.
//
//   1 byte    n: 2^n bytes, n of 0 to 17, or as many as fit, of repetitions of the unit
//   3 bytes   numbers of the fields that these are within, from the outside; 0: none. As in
//             create { type { fields {} fields {} ... } }
//   1 byte    length of the unit less 1, of 0 to 15
//   the unit  which is a field with its tag
inline std::string bomb_from(std::span<const std::uint8_t>& input) {
  constexpr std::size_t kHead = 5;
  if (input.empty() || input[0] == 0 || input.size() < kHead) {
    input = input.subspan(input.empty() ? 0 : 1);
    return {};
  }
  const std::size_t size = std::size_t{1} << input[0] % 18;
  const std::size_t unit_bytes = std::min<std::size_t>(input[4] % 16 + 1, input.size() - kHead);
  const std::string unit(reinterpret_cast<const char*>(input.data()) + kHead, unit_bytes);
  const auto varint = [](std::uint32_t number) {
    std::uint8_t bytes[10];
    const std::uint8_t* const end =
        google::protobuf::io::CodedOutputStream::WriteVarint32ToArray(number, bytes);
    return std::string(reinterpret_cast<const char*>(bytes), static_cast<std::size_t>(end - bytes));
  };
  std::string content;
  content.reserve(size + 64);
  while (unit_bytes > 0 && content.size() + unit_bytes <= size) content += unit;
  for (const std::size_t at : {3, 2, 1}) {
    const std::uint32_t number = input[at] % 64U;
    const auto bytes = static_cast<std::uint32_t>(content.size());
    if (number > 0) content.insert(0, varint(number << 3 | 2) + varint(bytes));
  }
  content.insert(0, "\x08\x01");
  input = input.subspan(kHead + unit_bytes);
  count_bytes(content.size());
  return varint(static_cast<std::uint32_t>(content.size())) + content;
}

}  // namespace dssm::fuzz
