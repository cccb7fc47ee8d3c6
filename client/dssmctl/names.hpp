// SPDX-License-Identifier: Apache-2.0
//
// Names of streams as a person types them: short ones that open the right stream, those that
// several hosts have, and patterns for them.
#pragma once

#include <cstdint>
#include <dssm/stream.hpp>
#include <map>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/base/names.hpp"

namespace dssm::ctl {

// For each of `streams`, which are all that there are, the shortest name that opens it on the host
// `own_host`: short_name() where that is enough. dssmd takes a name without a host for its own
// stream, and refuses one that only several other hosts have; such names get "@pc2".
std::vector<std::string> opening_names(const std::vector<StreamInfo>& streams,
                                       std::string_view own_host);

// The parts of STREAM.FIELD, where names of streams and of fields may have dots, too: for each of
// its dots what is before and after it.
std::vector<std::pair<std::string, std::string>> splits_at_dots(const std::string& text);

// Streams of several hosts that have the same name and id: without the host in its name such a
// stream opens only on a host that owns one.
class Duplicates {
 public:
  using Key = std::pair<std::string, std::int32_t>;  // name and id

  // `streams`: all that there are, of all hosts.
  explicit Duplicates(const std::vector<StreamInfo>& streams);

  bool has(const StreamId& id) const { return owners_.contains({id.name, id.id}); }

  // For each of them the hosts, two or more, in the order of `streams`.
  const std::map<Key, std::vector<std::string>>& owners() const { return owners_; }

 private:
  std::map<Key, std::vector<std::string>> owners_;
};

// A pattern for StreamFilter that only this full name fits.
std::string pattern_of(const std::string& name);

// Whether a stream fits a pattern, as StreamFilter takes them.
bool fits_pattern(const StreamId& id, const std::string& pattern);

// Which streams are listed or recorded.
class StreamFilter {
 public:
  //   hosts     only streams of these; empty: of all
  //   patterns  shell patterns (fnmatch(3)), one of which fits the name, or NAME:ID, NAME@HOST or
  //             NAME:ID@HOST where it has such a part; empty: all
  StreamFilter(std::vector<std::string> hosts, std::vector<std::string> patterns)
      : hosts_(std::move(hosts)), patterns_(std::move(patterns)) {}

  bool takes(const StreamId& id) const;
  // The patterns; one that all names fit if there are none.
  std::vector<std::string> patterns() const;

 private:
  std::vector<std::string> hosts_, patterns_;
};

}  // namespace dssm::ctl
