// SPDX-License-Identifier: Apache-2.0
//
// The list of streams as `dssmctl ls` and `dssmctl top` show it: its order and its columns.
#pragma once

#include <algorithm>
#include <dssm/stream.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/names.hpp"
#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// Sorts by what `key` gives, keeping the order among equals.
template <class Item, class Key>
void sort_by(std::vector<Item>& items, Key key) {
  std::stable_sort(items.begin(), items.end(),
                   [&](const Item& a, const Item& b) { return key(a) < key(b); });
}

// The keys that sort_streams() knows; the first one, "created", is the order in which dssmd lists
// them.
std::span<const std::string_view> stream_sort_keys();

// Numbers rise; streams whose age is not known come last in "age".
void sort_streams(std::vector<StreamInfo>& streams, std::string_view key);

// What to show, in order. The marks follow from all that there is, shown or not; without the
// other hosts' streams they are not known.
struct StreamListing {
  std::vector<StreamInfo> streams;
  std::optional<Duplicates> duplicates;

  bool duplicate(const StreamInfo& stream) const {
    return duplicates && duplicates->has(stream.id);
  }
};

// A row for each stream. Where that is wider than `columns`, the column of ids is left out, and the
// ids are in the names.
Table stream_table(const StreamListing& listing, std::size_t columns);

// A stream of the list: stream_json() and whether it is a duplicate.
Json listed_stream_json(const StreamListing& listing, const StreamInfo& stream);

}  // namespace dssm::ctl
