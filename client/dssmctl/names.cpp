// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/names.hpp"

#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>

namespace dssm::ctl {

bool fits_pattern(const StreamId& id, const std::string& pattern) {
  const auto fits = [&](const std::string& text) {
    return ::fnmatch(pattern.c_str(), text.c_str(), 0) == 0;
  };
  // An id or host counts only where the pattern has that part: `*2` is about names, and not about
  // all that pc2 has. A colon may also belong to a class of characters, [[:digit:]].
  const bool has_id = pattern.find(':') != std::string::npos;
  const std::string with_id = fmt::format("{}:{}", id.name, id.id);
  if (pattern.find('@') != std::string::npos) {
    return fits(id.name + "@" + id.host) || (has_id && fits(with_id + "@" + id.host));
  }
  return fits(id.name) || (has_id && fits(with_id));
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
  return patterns_.empty() ||
         std::any_of(patterns_.begin(), patterns_.end(),
                     [&](const std::string& pattern) { return fits_pattern(id, pattern); });
}

std::vector<std::string> StreamFilter::patterns() const {
  return patterns_.empty() ? std::vector<std::string>{"*"} : patterns_;
}

std::string pattern_of(const std::string& name) {
  std::string pattern;
  for (const char c : name) {
    if (c == '*' || c == '?' || c == '[' || c == '\\') pattern += '\\';
    pattern += c;
  }
  return pattern;
}

std::vector<std::pair<std::string, std::string>> splits_at_dots(const std::string& text) {
  std::vector<std::pair<std::string, std::string>> parts;
  for (std::size_t dot = text.find('.'); dot != text.npos; dot = text.find('.', dot + 1)) {
    if (dot > 0 && dot + 1 < text.size()) {
      parts.emplace_back(text.substr(0, dot), text.substr(dot + 1));
    }
  }
  return parts;
}

}  // namespace dssm::ctl
