// SPDX-License-Identifier: Apache-2.0
#include "core/base/names.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace dssm {
namespace {

// Longer names than the format allows are not worth comparing.
constexpr std::size_t kMaxCompared = 2 * kMaxFullNameBytes;

// Levenshtein's distance: single characters to insert, delete or replace.
std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 0; i < a.size(); ++i) {
    std::size_t diagonal = std::exchange(row[0], i + 1);
    for (std::size_t j = 0; j < b.size(); ++j) {
      const std::size_t replaced = diagonal + (a[i] == b[j] ? 0 : 1);
      diagonal = std::exchange(row[j + 1], std::min({replaced, row[j] + 1, row[j + 1] + 1}));
    }
  }
  return row[b.size()];
}

}  // namespace

std::string short_name(const StreamId& id) {
  return id.id == 0 ? id.name : fmt::format("{}:{}", id.name, id.id);
}

std::vector<std::string> similar_names(std::string_view wanted, std::vector<std::string> names) {
  constexpr std::size_t kMaxNames = 3;
  if (wanted.size() > kMaxCompared) return {};
  std::vector<std::pair<std::size_t, std::string>> ranked;
  for (std::string& name : names) {
    const bool contains =
        wanted.size() >= 3 && (name.find(wanted) != std::string::npos ||
                               (name.size() >= 3 && wanted.find(name) != std::string_view::npos));
    const std::size_t distance = edit_distance(wanted, name);
    if (contains || distance <= std::max<std::size_t>(1, wanted.size() / 3)) {
      ranked.emplace_back(distance, std::move(name));
    }
  }
  std::sort(ranked.begin(), ranked.end());
  ranked.erase(std::unique(ranked.begin(), ranked.end()), ranked.end());
  if (ranked.size() > kMaxNames) ranked.resize(kMaxNames);
  std::vector<std::string> best;
  best.reserve(ranked.size());
  for (auto& [distance, name] : ranked) best.push_back(std::move(name));
  return best;
}

}  // namespace dssm
