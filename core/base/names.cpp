// SPDX-License-Identifier: Apache-2.0
#include "core/base/names.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <numeric>
#include <utility>

namespace dssm {
namespace {

// Longer names than the format allows are not worth comparing.
constexpr std::size_t kMaxCompared = 2 * kMaxFullNameBytes;

// The distance of Damerau and Levenshtein (optimal string alignment): single characters to insert,
// delete or replace, and neighbouring ones to swap.
std::size_t edit_distance(std::string_view a, std::string_view b) {
  // Of the first i characters of `a` to the first j of `b`, in [j]: row for i + 1, above for i.
  std::vector<std::size_t> row(b.size() + 1), above(row), two_above(row);
  std::iota(above.begin(), above.end(), 0U);
  for (std::size_t i = 0; i < a.size(); ++i) {
    row[0] = i + 1;
    for (std::size_t j = 0; j < b.size(); ++j) {
      row[j + 1] = std::min({above[j] + (a[i] == b[j] ? 0 : 1), row[j] + 1, above[j + 1] + 1});
      if (i > 0 && j > 0 && a[i] == b[j - 1] && a[i - 1] == b[j]) {
        row[j + 1] = std::min(row[j + 1], two_above[j - 1] + 1);
      }
    }
    two_above.swap(above);
    above.swap(row);
  }
  return above[b.size()];
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
