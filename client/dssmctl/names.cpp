// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/names.hpp"

#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>
#include <map>
#include <utility>

namespace dssm::ctl {
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

std::vector<std::string> opening_names(const std::vector<StreamInfo>& streams,
                                       std::string_view own_host) {
  const Duplicates duplicates(streams);
  std::vector<std::string> names;
  for (const StreamInfo& stream : streams) {
    names.push_back(short_name(stream.id));
    if (stream.id.host != own_host && duplicates.has(stream.id)) {
      names.back() += "@" + stream.id.host;
    }
  }
  return names;
}

std::vector<std::string> similar_names(std::string_view wanted, std::vector<std::string> names) {
  constexpr std::size_t kMaxNames = 3;
  if (wanted.size() > kMaxCompared) return {};
  std::vector<std::pair<std::size_t, std::string>> ranked;
  for (std::string& name : names) {
    const bool contains = wanted.size() >= 3 && (name.find(wanted) != std::string::npos ||
                                                 wanted.find(name) != std::string_view::npos);
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

Duplicates::Duplicates(const std::vector<StreamInfo>& streams) {
  for (const StreamInfo& stream : streams) {
    owners_[{stream.id.name, stream.id.id}].push_back(stream.id.host);
  }
  std::erase_if(owners_, [](const auto& entry) { return entry.second.size() < 2; });
}

bool StreamFilter::takes(const StreamId& id) const {
  if (!hosts_.empty() && std::find(hosts_.begin(), hosts_.end(), id.host) == hosts_.end()) {
    return false;
  }
  if (pattern_.empty()) return true;
  const auto fits = [&](const std::string& text) {
    return ::fnmatch(pattern_.c_str(), text.c_str(), 0) == 0;
  };
  // An id or host counts only where the pattern has that part: `*2` is about names, and not about
  // all that pc2 has. A colon may also belong to a class of characters, [[:digit:]].
  const bool has_id = pattern_.find(':') != std::string::npos;
  const std::string with_id = fmt::format("{}:{}", id.name, id.id);
  if (pattern_.find('@') != std::string::npos) {
    return fits(id.name + "@" + id.host) || (has_id && fits(with_id + "@" + id.host));
  }
  return fits(id.name) || (has_id && fits(with_id));
}

}  // namespace dssm::ctl
