// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/sample_printer.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <limits>

#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// Enough to recognise a sample, few enough for a screen.
constexpr std::size_t kShownElements = 32;
constexpr std::size_t kShownBytes = 64;

}  // namespace

std::string csv_cell(std::string_view text) {
  if (text.find_first_of(",\"\r\n") == std::string_view::npos) return std::string(text);
  std::string out = "\"";
  for (const char c : text) {
    if (c == '"') out += '"';
    out += c;
  }
  return out + "\"";
}

SamplePrinter::SamplePrinter(Output& out, Style style, StreamId stream, std::vector<Field> fields)
    : out_(out), style_(style), stream_(std::move(stream)), fields_(std::move(fields)) {}

// A terminal must not get control characters from a stream; a file gets the cell as it is.
std::string SamplePrinter::cell(std::string_view text) const {
  return csv_cell(out_.terminal() ? escaped(text) : std::string(text));
}

void SamplePrinter::begin() {
  if (style_.form != SampleForm::csv) return;
  std::string line = fmt::format("tid,{},clock_error_ns", style_.iso ? "time" : "time_ns");
  for (const Field& field : fields_) {
    if (field.count == 1 || is_text(field)) {
      line.append(",").append(cell(field.name));
      continue;
    }
    for (std::uint64_t i = 0; i < field.count; ++i) {
      line.append(",").append(cell(fmt::format("{}[{}]", field.name, i)));
    }
  }
  if (fields_.empty()) line += ",payload_hex";
  out_.add(line + "\n");
}

void SamplePrinter::sample(const SampleInfo& info, std::span<const std::byte> payload,
                           const Breaks& breaks) {
  switch (style_.form) {
    case SampleForm::text:
      return text_sample(info, payload, breaks);
    case SampleForm::json:
      return json_sample(info, payload, breaks);
    case SampleForm::csv:
      return csv_sample(info, payload);
  }
}

void SamplePrinter::text_sample(const SampleInfo& info, std::span<const std::byte> payload,
                                const Breaks& breaks) {
  std::string text;
  if (breaks.lost > 0) {
    text += fmt::format("# {} samples were overwritten before they could be shown\n", breaks.lost);
  }
  text += fmt::format("tid: {}\ntime: {}\nclock_error: {}\n", info.tid,
                      time_text(info.time, style_.iso), bound_text(info.clock_error));
  const std::size_t shown = style_.full ? std::numeric_limits<std::size_t>::max() : kShownElements;
  for (const Field& field : fields_) {
    text += fmt::format("{}: {}\n", escaped(field.name), field_text(payload, field, shown));
  }
  if (fields_.empty()) {
    const std::size_t end = style_.full ? payload.size() : std::min(payload.size(), kShownBytes);
    text += fmt::format("payload: {}\n{}", bytes_text(payload.size()),
                        hex_dump(payload.first(end), "  "));
    if (end < payload.size()) {
      text += fmt::format("  ... {} more (--full shows all)\n", bytes_text(payload.size() - end));
    }
  }
  out_.add(text + "---\n");
}

void SamplePrinter::json_sample(const SampleInfo& info, std::span<const std::byte> payload,
                                const Breaks& breaks) {
  Json json;
  json["stream"] = stream_.str();
  json["tid"] = info.tid;
  json["time_ns"] = to_ns(info.time);
  json["clock_error_ns"] = bound_json(info.clock_error);
  json["lost"] = breaks.lost;
  json["restarts"] = breaks.restarts;
  if (fields_.empty()) {
    json["payload_bytes"] = payload.size();
    json["payload_hex"] = hex_text(payload);
  } else {
    Json& values = json["fields"] = Json::object();
    for (const Field& field : fields_) values[field.name] = field_json(payload, field);
  }
  out_.add(json_line(json));
}

void SamplePrinter::csv_sample(const SampleInfo& info, std::span<const std::byte> payload) {
  std::string line = fmt::format(
      "{},{},", info.tid, style_.iso ? iso_text(info.time) : std::to_string(to_ns(info.time)));
  if (info.clock_error < kForeignClockError) line += std::to_string(to_ns(info.clock_error));
  for (const Field& field : fields_) {
    const std::uint64_t cells = is_text(field) ? 1 : field.count;
    for (std::uint64_t i = 0; i < cells; ++i) {
      line.append(",").append(cell(element_text(payload, field, i)));
    }
  }
  if (fields_.empty()) line.append(",").append(hex_text(payload));
  out_.add(line + "\n");
}

}  // namespace dssm::ctl
