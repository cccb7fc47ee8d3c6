// SPDX-License-Identifier: Apache-2.0
//
// JSON output: keys in the order in which they are written, whole numbers exact, NaN and infinity
// as null, everything outside ASCII as \u escapes. Bytes that are no UTF-8 become U+FFFD.
#pragma once

#include <dssm/time.hpp>
#include <nlohmann/json.hpp>
#include <string>

namespace dssm::ctl {

using Json = nlohmann::ordered_json;

inline std::string json_text(const Json& json) {
  return json.dump(-1, ' ', true, Json::error_handler_t::replace);
}

inline std::string json_line(const Json& json) { return json_text(json) + "\n"; }

// A bound on a clock's or stamp's error [ns]; null: unknown.
inline Json bound_json(Duration bound) {
  return bound >= kForeignClockError ? Json() : Json(to_ns(bound));
}

// A document of its own: indented, because people read it too.
inline std::string json_document(const Json& json) {
  return json.dump(2, ' ', true, Json::error_handler_t::replace) + "\n";
}

}  // namespace dssm::ctl
