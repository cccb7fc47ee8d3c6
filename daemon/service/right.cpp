// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/right.hpp"

#include <fmt/format.h>
#include <fmt/ranges.h>

#include <algorithm>
#include <array>
#include <cstdint>
#include <limits>
#include <optional>
#include <utility>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "daemon/service/config_values.hpp"

namespace dssm::daemon {
namespace {

// By Verb.
constexpr std::array<std::string_view, 6> kVerbNames = {"read",   "write",    "create",
                                                        "remove", "property", "clock"};
constexpr std::size_t kMaxPatternBytes = 63;

Error wrong_right(std::string why) { return {Errc::invalid_argument, std::move(why)}; }

// The part of `text` before the next `separator`, which is taken from it.
std::string_view take_part(std::string_view& text, char separator) {
  const std::size_t end = std::min(text.find(separator), text.size());
  const std::string_view part = text.substr(0, end);
  text.remove_prefix(std::min(end + 1, text.size()));
  return part;
}

// The next word, without the blanks around it.
std::string_view take_word(std::string_view& text) {
  while (text.starts_with(' ')) text.remove_prefix(1);
  const std::string_view word = take_part(text, ' ');
  while (text.starts_with(' ')) text.remove_prefix(1);
  return word;
}

std::optional<std::uint32_t> number_of(std::string_view text) {
  // The highest one means "none" to the kernel.
  const auto number = parse_count(text, 0, std::numeric_limits<std::uint32_t>::max() - 1);
  if (!number) return std::nullopt;
  return static_cast<std::uint32_t>(*number);
}

Result<void> take_who(std::string_view text, Right& out) {
  std::string_view name = text;
  const std::string_view kind = take_part(name, ':');
  if (kind == "everyone" || kind == "local") {
    if (kind != text) return wrong_right(fmt::format("'{}' takes no name", kind));
    out.who = kind == "local" ? Right::Who::local : Right::Who::everyone;
    return {};
  }
  static constexpr std::pair<std::string_view, Right::Who> kKinds[] = {
      {"user", Right::Who::user},
      {"group", Right::Who::group},
      {"host", Right::Who::host},
      {"program", Right::Who::program}};
  const auto* known = std::find_if(std::begin(kKinds), std::end(kKinds),
                                   [&](const auto& one) { return one.first == kind; });
  if (known == std::end(kKinds)) {
    return wrong_right(
        fmt::format("{} is not known; write everyone, local, user:NAME, group:NAME, host:NAME or "
                    "program:NAME",
                    in_quotes(text)));
  }
  if (name.empty()) return wrong_right(fmt::format("{} has no name", in_quotes(text)));
  if (name.size() > kMaxPatternBytes) return wrong_right(in_quotes(text) + " has too long a name");
  out.who = known->second;
  if (out.who == Right::Who::host || out.who == Right::Who::program) {
    out.name_pattern = name;
    return {};
  }
  if (const auto number = number_of(name)) {
    out.number = *number;
  } else {
    out.number =
        out.who == Right::Who::user ? DSSM_TRY(parse_user(name)) : DSSM_TRY(parse_group(name));
  }
  return {};
}

Result<Verbs> parse_verbs(std::string_view text) {
  Verbs verbs;
  while (!text.empty()) {
    const std::string_view name = take_part(text, ',');
    if (name == "all") {
      verbs |= Verbs::all();
      continue;
    }
    const auto* found = std::find(kVerbNames.begin(), kVerbNames.end(), name);
    if (found == kVerbNames.end()) {
      return wrong_right(fmt::format("{} is not a verb; the verbs are {} and all", in_quotes(name),
                                     fmt::join(kVerbNames, ", ")));
    }
    const Verb verb = static_cast<Verb>(found - kVerbNames.begin());
    verbs |= verb;
    if (verb == Verb::create) verbs |= Verb::write;
  }
  return verbs;
}

Result<void> take_streams(std::string_view text, Right& out) {
  if (text.size() > kMaxPatternBytes) {
    return wrong_right(in_quotes(text) + " names a stream too long to be one");
  }
  if (text.find('@') != text.npos) {
    return wrong_right(in_quotes(text) +
                       " names a host; a right counts for the streams of all hosts");
  }
  out.streams = text;
  return {};
}

}  // namespace

std::string Verbs::str() const {
  if (*this == all()) return "all";
  std::string text;
  for (std::size_t i = 0; i < kVerbNames.size(); ++i) {
    if (!has(static_cast<Verb>(i))) continue;
    text.append(text.empty() ? "" : ",").append(kVerbNames[i]);
  }
  return text.empty() ? "none" : text;
}

Result<Right> parse_right(std::string_view text) {
  std::string_view rest = text;
  const std::string_view who = take_word(rest), verbs = take_word(rest), streams = take_word(rest);
  if (streams.empty() || !rest.empty() || text.find('\0') != text.npos) {
    return wrong_right(in_quotes(text) +
                       " is not a right; write \"WHO VERBS STREAMS\", such as "
                       "\"group:drivers read,write lidar*\" or \"host:pc2 all *\"");
  }
  const std::string what = in_quotes(text);
  Right right;
  right.line = text;
  DSSM_TRY(take_who(who, right), what);
  right.verbs = DSSM_TRY(parse_verbs(verbs), what);
  DSSM_TRY(take_streams(streams, right), what);
  return right;
}

}  // namespace dssm::daemon
