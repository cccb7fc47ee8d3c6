// SPDX-License-Identifier: Apache-2.0
#include "convert.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstring>

#include "../include/libssm.h"

namespace dssm::ssm {

std::string quoted(std::string_view name, int id) { return fmt::format("'{}' [{}]", name, id); }

std::size_t name_length(const char* name) noexcept { return std::strcspn(name, "@"); }

StreamId stream_id(const char* name, int id) {
  const std::size_t length = name_length(name);
  return {std::string(name, length), id, name[length] ? name + length + 1 : ""};
}

// The quotient comes first, as in the old library: 1 s at 0.1 s gives 13, which 1.2 * life / cycle
// would miss by a rounding.
double slots(double life, double cycle) noexcept {
  return SSM_BUFFER_MARGIN * (life / cycle) + SSM_MARGIN;
}

std::optional<std::string> wrong_arguments(const char* name, int id, double life, double cycle) {
  if (!name) return "create : the stream name is NULL";
  const std::size_t length = name_length(name);
  if (length == 0 || length >= SSM_SNAME_MAX) {
    return fmt::format("create '{}' : a stream name has 1 to 31 bytes, not {}", name, length);
  }
  if (name[length] && !name[length + 1]) {
    return fmt::format("create '{}' : there is no host's name after the '@'", name);
  }
  const std::string what = "create " + quoted(name, id) + " : ";
  if (id < 0) return what + "a stream id is 0 or more";
  if (!(life > 0)) return what + fmt::format("life is {:g} s, must be more than 0", life);
  if (!(cycle > 0)) return what + fmt::format("cycle is {:g} s, must be more than 0", cycle);
  if (life < cycle) {
    return what + fmt::format("life ({:g} s) is shorter than cycle ({:g} s)", life, cycle);
  }
  if (slots(life, cycle) > static_cast<double>(kMaxDepth)) {
    return what + fmt::format(
                      "life {:g} s at cycle {:g} s needs more slots than a ring may have ({}); ask "
                      "for less life",
                      life, cycle, kMaxDepth);
  }
  return std::nullopt;
}

std::string property_size_error(const std::string& quoted_name, std::size_t property_bytes,
                                std::size_t program_bytes) {
  return fmt::format(
      "get the property of {} : it has {} bytes, this program's type {}; use the type that it was "
      "set with",
      quoted_name, property_bytes, program_bytes);
}

History history_of(double life, double cycle) noexcept {
  return {static_cast<std::uint64_t>(slots(life, cycle)),
          std::max(Duration(1), Duration(ns_from_seconds(cycle)))};
}

TypeInfo type_for(std::size_t bytes) {
  TypeInfo type;
  type.payload_bytes = bytes;
  if (bytes > 0) return type;
  type.name = kEmptySsmType;
  type.payload_bytes = 1;
  return type;
}

}  // namespace dssm::ssm
