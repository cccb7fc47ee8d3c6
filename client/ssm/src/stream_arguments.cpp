// SPDX-License-Identifier: Apache-2.0
#include "stream_arguments.hpp"

#include <algorithm>
#include <cstdio>
#include <cstring>

#include "../include/libssm.h"
#include "stream.hpp"
#include "time_convert.hpp"

namespace dssm::ssm {
namespace {

std::string number(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%g", value);
  return text;
}

}  // namespace

std::string quoted(std::string_view name, int id) {
  return "'" + std::string(name) + "' [" + std::to_string(id) + "]";
}

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
    return "create '" + std::string(name) + "' : a stream name has 1 to 31 bytes, not " +
           std::to_string(length);
  }
  if (name[length] && !name[length + 1]) {
    return "create '" + std::string(name) + "' : there is no host's name behind the '@'";
  }
  const std::string what = "create " + quoted(name, id) + " : ";
  if (id < 0) return what + "a stream id is 0 or more";
  if (!(life > 0)) return what + "life is " + number(life) + " s, must be more than 0";
  if (!(cycle > 0)) return what + "cycle is " + number(cycle) + " s, must be more than 0";
  if (life < cycle) {
    return what + "life (" + number(life) + " s) is shorter than cycle (" + number(cycle) + " s)";
  }
  if (slots(life, cycle) > static_cast<double>(kMaxDepth)) {
    return what + "life " + number(life) + " s at cycle " + number(cycle) +
           " s needs more slots than a ring may have (" + std::to_string(kMaxDepth) +
           "); ask for less life";
  }
  return std::nullopt;
}

History history_of(double life, double cycle) noexcept {
  return {static_cast<std::uint64_t>(slots(life, cycle)),
          std::max(Duration(1), Duration(ns_from_seconds(cycle)))};
}

TypeInfo type_for(std::size_t bytes) {
  TypeInfo type;
  type.payload_bytes = bytes;
  if (bytes > 0) return type;
  type.name = kEmptyType;
  type.payload_bytes = 1;
  return type;
}

}  // namespace dssm::ssm
