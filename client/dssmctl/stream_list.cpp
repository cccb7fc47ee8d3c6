// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/stream_list.hpp"

#include <array>
#include <utility>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

constexpr std::string_view kDuplicateMark = " *";

// `with_id`: the id has a column of its own.
std::vector<std::string> stream_row(const StreamInfo& stream, bool duplicate, bool with_id) {
  return {
      escaped(with_id ? stream.id.name : short_name(stream.id))
          .append(duplicate ? kDuplicateMark : ""),
      std::to_string(stream.id.id),
      escaped(stream.id.host),
      std::to_string(stream.type.payload_bytes),
      std::to_string(stream.depth),
      duration_text(stream.cycle),
      rate_text(stream),
      age_text(stream),
      state_cell(stream),
      count_text(stream, stream.writers),
      count_text(stream, stream.readers),
      or_dash(escaped(stream.type.name)),
  };
}

Table stream_table(const StreamListing& listing, bool with_id) {
  constexpr auto kLeft = Table::Align::left, kRight = Table::Align::right;
  Table table({{"NAME"},
               {"ID", kRight, 1},
               {"HOST"},
               {"SIZE", kRight, 3},
               {"DEPTH", kRight, 2},
               {"CYCLE", kRight, 4},
               {"RATE", kRight},
               {"AGE", kRight},
               {"STATE"},
               {"WRITERS", kRight},
               {"READERS", kRight},
               {"TYPE", kLeft, 0, Table::Column::Fit::cut}});
  for (const StreamInfo& stream : listing.streams) {
    table.add_row(stream_row(stream, listing.duplicate(stream), with_id));
  }
  return table;
}

}  // namespace

std::span<const std::string_view> stream_sort_keys() {
  static constexpr std::array<std::string_view, 13> kKeys = {
      "created", "name", "id",      "host",    "size", "depth", "cycle",
      "rate",    "age",  "writers", "readers", "type", "memory"};
  return kKeys;
}

void sort_streams(std::vector<StreamInfo>& streams, std::string_view key) {
  if (key == "name")
    return sort_by(streams, [](const auto& s) { return std::pair(s.id.name, s.id.id); });
  if (key == "id")
    return sort_by(streams, [](const auto& s) { return std::pair(s.id.id, s.id.name); });
  if (key == "host") return sort_by(streams, [](const auto& s) { return s.id.host; });
  if (key == "size") return sort_by(streams, [](const auto& s) { return s.type.payload_bytes; });
  if (key == "depth") return sort_by(streams, [](const auto& s) { return s.depth; });
  if (key == "cycle") return sort_by(streams, [](const auto& s) { return s.cycle; });
  if (key == "rate") {
    return sort_by(streams, [](const auto& s) { return is_silent(s) ? 0 : s.rate_hz; });
  }
  if (key == "writers") return sort_by(streams, [](const auto& s) { return s.writers; });
  if (key == "readers") return sort_by(streams, [](const auto& s) { return s.readers; });
  if (key == "type") return sort_by(streams, [](const auto& s) { return s.type.name; });
  if (key == "memory") return sort_by(streams, [](const auto& s) { return s.memory_bytes; });
  if (key == "age") {
    return sort_by(streams, [](const auto& s) {
      return std::pair(!is_age_known(s), is_age_known(s) ? s.age : Duration());
    });
  }
}

Table stream_table(const StreamListing& listing, std::size_t columns) {
  Table table = stream_table(listing, true);
  if (!table.fits(columns)) return stream_table(listing, false);
  return table;
}

Json listed_stream_json(const StreamListing& listing, const StreamInfo& stream) {
  Json json = stream_json(stream);
  json["duplicate"] = listing.duplicates ? Json(listing.duplicate(stream)) : Json();
  return json;
}

}  // namespace dssm::ctl
