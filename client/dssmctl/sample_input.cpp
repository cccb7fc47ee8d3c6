// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/sample_input.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cstring>
#include <limits>

#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/sample_printer.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

constexpr const char* kHexField = "payload_hex";
// Of JSON; more would only serve to overflow the stack.
constexpr int kMaxNesting = 32;
// Of a CSV record, whose quoted cells may go over several lines: more than any sample takes.
constexpr std::size_t kMaxRecordBytes = 256U << 20;
constexpr std::size_t kInfoColumns = 3;  // of echo's CSV, before those of the fields

Error does_not_fit(const std::string& name, std::string_view text, const std::string& wanted) {
  return {Errc::invalid_argument,
          fmt::format("field '{}' cannot be '{}': it takes {}", name, text, wanted)};
}

template <class T>
Result<void> store_number(std::byte* place, const std::string& name, std::string_view text) {
  T value{};
  const char* const end = text.data() + text.size();
  const auto [stop, failed] = std::from_chars(text.data(), end, value);
  if (failed == std::errc() && stop == end) {
    std::memcpy(place, &value, sizeof value);
    return {};
  }
  if constexpr (std::is_floating_point_v<T>) {
    return does_not_fit(name, text,
                        std::is_same_v<T, float> ? "a number (float32)" : "a number (float64)");
  } else {
    return does_not_fit(name, text,
                        fmt::format("a whole number from {} to {}", std::numeric_limits<T>::min(),
                                    std::numeric_limits<T>::max()));
  }
}

Result<void> store_boolean(std::byte* place, const std::string& name, std::string_view text) {
  const bool is_true = text == "true" || text == "1";
  if (!is_true && text != "false" && text != "0") return does_not_fit(name, text, "true or false");
  *place = std::byte{is_true};
  return {};
}

Result<void> store_character(std::byte* place, const std::string& name, std::string_view text) {
  if (text.size() > 1) return does_not_fit(name, text, "one byte");
  *place = text.empty() ? std::byte{0} : static_cast<std::byte>(text.front());
  return {};
}

Result<void> store_scalar(std::byte* place, const Field& field, std::string_view text) {
  switch (field.kind) {
    case Scalar::boolean:
      return store_boolean(place, field.name, text);
    case Scalar::character:
      return store_character(place, field.name, text);
    case Scalar::int8:
      return store_number<std::int8_t>(place, field.name, text);
    case Scalar::uint8:
      return store_number<std::uint8_t>(place, field.name, text);
    case Scalar::int16:
      return store_number<std::int16_t>(place, field.name, text);
    case Scalar::uint16:
      return store_number<std::uint16_t>(place, field.name, text);
    case Scalar::int32:
      return store_number<std::int32_t>(place, field.name, text);
    case Scalar::uint32:
      return store_number<std::uint32_t>(place, field.name, text);
    case Scalar::int64:
      return store_number<std::int64_t>(place, field.name, text);
    case Scalar::uint64:
      return store_number<std::uint64_t>(place, field.name, text);
    case Scalar::float32:
      return store_number<float>(place, field.name, text);
    case Scalar::float64:
      return store_number<double>(place, field.name, text);
  }
  return {};  // not reached: readable_fields_untrusted() passes only known kinds
}

// Into the bits of a bit field; the others of its element stay as they are.
Result<void> store_bits(std::byte* place, const Field& field, std::string_view text) {
  const std::size_t bytes = scalar_bytes(field.kind);
  std::uint64_t value = 0, element = 0;  // little endian: the lower bytes are those of the element
  DSSM_TRY(store_scalar(reinterpret_cast<std::byte*>(&value), field, text));
  const bool is_signed = field.kind == Scalar::int8 || field.kind == Scalar::int16 ||
                         field.kind == Scalar::int32 || field.kind == Scalar::int64;
  const std::uint64_t max = ~std::uint64_t{0} >> (64 - field.bits) >> (is_signed ? 1 : 0);
  const auto unused = static_cast<unsigned>(64 - 8 * bytes);
  const std::int64_t with_sign = static_cast<std::int64_t>(value << unused) >> unused;
  const bool is_negative = is_signed && with_sign < 0;
  if ((is_negative ? ~static_cast<std::uint64_t>(with_sign) : value) > max) {
    return does_not_fit(field.name, text,
                        fmt::format("a whole number from {} to {}",
                                    is_signed ? -static_cast<std::int64_t>(max) - 1 : 0, max));
  }
  const std::uint64_t mask = (~std::uint64_t{0} >> (64 - field.bits)) << field.first_bit;
  std::memcpy(&element, place, bytes);
  element = (element & ~mask) | ((value << field.first_bit) & mask);
  std::memcpy(place, &element, bytes);
  return {};
}

// Element `i` of a field, which lies inside the payload.
Result<void> store_element(std::span<std::byte> payload, const Field& field, std::uint64_t i,
                           std::string_view text) {
  std::byte* place = payload.data() + field.offset_bytes + i * field.stride_bytes;
  return field.bits == 0 ? store_scalar(place, field, text) : store_bits(place, field, text);
}

Result<void> store_text(std::span<std::byte> payload, const Field& field, std::string_view text) {
  if (text.size() > field.count) {
    return does_not_fit(field.name, text, fmt::format("text of up to {} bytes", field.count));
  }
  const std::span<std::byte> place = payload.subspan(field.offset_bytes, field.count);
  std::fill(place.begin(), place.end(), std::byte{0});
  std::memcpy(place.data(), text.data(), text.size());
  return {};
}

// As element text: what `echo --json` prints for a value that is not a number is null.
std::string element_text_of(const Field& field, const Json& value) {
  if (value.is_string()) return value.get<std::string>();
  const bool is_float = field.kind == Scalar::float32 || field.kind == Scalar::float64;
  return value.is_null() && is_float ? "nan" : json_text(value);
}

// Empty: `text` is not JSON, or nested too deeply.
std::optional<Json> parse_json(const std::string& text) {
  bool is_too_deep = false;
  Json json = Json::parse(
      text,
      [&](int depth, Json::parse_event_t, Json&) {
        is_too_deep |= depth > kMaxNesting;
        return !is_too_deep;
      },
      false);
  if (is_too_deep || json.is_discarded()) return std::nullopt;
  return json;
}

// One cell of a CSV record from `at` on, which then stands at the comma after it or at the end.
Result<std::string> take_cell(const std::string& record, std::size_t& at) {
  std::string cell;
  if (at == record.size() || record[at] != '"') {
    const std::size_t end = std::min(record.find(',', at), record.size());
    cell = record.substr(at, end - at);
    at = end;
    return cell;
  }
  for (++at; at < record.size(); ++at) {
    if (record[at] == '"') {
      ++at;
      if (at == record.size() || record[at] == ',') return cell;
      if (record[at] != '"') break;
    }
    cell += record[at];
  }
  return Error{Errc::invalid_argument,
               "a quote inside a quoted cell is written twice, and a comma comes after its end"};
}

Result<std::vector<std::string>> cells_of(const std::string& record) {
  std::vector<std::string> cells;
  std::size_t at = 0;
  while (true) {
    cells.push_back(DSSM_TRY(take_cell(record, at)));
    if (at >= record.size()) return cells;
    ++at;
  }
}

bool take(const std::string& text, std::int64_t& into) {
  const char* const end = text.data() + text.size();
  const auto [stop, failed] = std::from_chars(text.data(), end, into);
  return failed == std::errc() && stop == end;
}

// A bound on the error of a time; none where echo prints that it is unknown.
Result<Duration> clock_error_of(const std::string& text) {
  if (text.empty() || text == "null") return kForeignClockError;
  std::int64_t error_ns = 0;
  if (take(text, error_ns) && error_ns >= 0) return Duration(error_ns);
  return Error{Errc::invalid_argument,
               fmt::format("clock_error_ns cannot be '{}': it is in nanoseconds, 0 or more", text)};
}

// As echo prints it: in nanoseconds since 1970, or as ISO 8601.
Result<Time> time_of(const std::string& text, bool iso) {
  std::int64_t time_ns = 0;
  if (!iso && take(text, time_ns)) return time_from_ns(time_ns);
  const Moment moment = DSSM_TRY(parse_moment(text, Time()));
  if (!moment.back) return moment.time;
  return Error{Errc::invalid_argument, fmt::format("'{}' is not a time as `echo` prints it", text)};
}

bool is_blank(const std::string& line) {
  return line.find_first_not_of(" \t\r") == std::string::npos;
}

}  // namespace

// --- one sample

SampleInput::SampleInput(const TypeInfo& type)
    : payload_bytes_(type.payload_bytes),
      fields_(readable_fields_untrusted(type)),
      payload_(type.payload_bytes) {}

std::optional<SampleInput::Place> SampleInput::find(const std::string& name) const {
  for (const Field& field : fields_) {
    if (name == field.name) return Place{&field, std::nullopt};
    if (field.count == 1 || !name.starts_with(field.name + "[") || !name.ends_with(']')) continue;
    const std::size_t begin = field.name.size() + 1;
    const Result<std::uint64_t> element =
        parse_whole(name.substr(begin, name.size() - begin - 1), 0, field.count - 1);
    if (element) return Place{&field, *element};
  }
  return std::nullopt;
}

bool SampleInput::has(const std::string& name) const { return find(name).has_value(); }

Result<SampleInput::Place> SampleInput::place_of(const std::string& name) const {
  if (const std::optional<Place> place = find(name)) return *place;
  const std::vector<Field> members =
      DSSM_TRY(select_fields(fields_, {name.substr(0, name.find('['))}));
  if (name.ends_with(']')) {
    return Error{Errc::invalid_argument, fmt::format("no element '{}': field '{}' has {}", name,
                                                     members.front().name, members.front().count)};
  }
  std::vector<std::string_view> names;
  names.reserve(members.size());
  for (const Field& member : members) names.push_back(member.name);
  return Error{Errc::invalid_argument, fmt::format("field '{}' has several members; set '{}'", name,
                                                   fmt::join(names, "', '"))};
}

Result<void> SampleInput::set_hex(const std::string& text) {
  const auto wrong = [&] {
    return does_not_fit(kHexField, text,
                        fmt::format("up to {} bytes as hex digits, two for each", payload_bytes_));
  };
  if (text.size() % 2 != 0 || text.size() / 2 > payload_bytes_) return wrong();
  payload_.assign(text.size() / 2, std::byte{0});
  for (std::size_t i = 0; i < payload_.size(); ++i) {
    std::uint8_t value = 0;
    const char* const end = text.data() + 2 * i + 2;
    if (std::from_chars(end - 2, end, value, 16).ptr != end) return wrong();
    payload_[i] = std::byte{value};
  }
  return {};
}

Result<void> SampleInput::set_text(const std::string& name, const std::string& text) {
  if (fields_.empty() && name == kHexField) return set_hex(text);
  const Place place = DSSM_TRY(place_of(name));
  const bool is_structured = text.starts_with('[') || text.starts_with('"');
  const std::optional<Json> json = is_structured ? parse_json(text) : std::nullopt;
  if (json) return set_json(name, *json);
  if (place.element) return store_element(payload_, *place.field, *place.element, text);
  if (is_text(*place.field)) return store_text(payload_, *place.field, text);
  if (place.field->count == 1) return store_element(payload_, *place.field, 0, text);
  return does_not_fit(name, text,
                      fmt::format("a JSON array of up to {} values", place.field->count));
}

Result<void> SampleInput::set_cell(const std::string& name, const std::string& cell) {
  const std::optional<Place> place = find(name);
  if (place && !place->element && is_text(*place->field)) {
    return store_text(payload_, *place->field, cell);  // also what looks like JSON
  }
  return set_text(name, cell);
}

Result<void> SampleInput::set_json(const std::string& name, const Json& value) {
  if (fields_.empty() && name == kHexField && value.is_string()) {
    return set_hex(value.get<std::string>());
  }
  if (value.is_object()) {
    for (const auto& [member, inner] : value.items()) {
      DSSM_TRY(set_json(fmt::format("{}.{}", name, member), inner));
    }
    return {};
  }
  const Place place = DSSM_TRY(place_of(name));
  const Field& field = *place.field;
  if (is_text(field) && !place.element) {
    if (!value.is_string()) return does_not_fit(name, json_text(value), "text");
    return store_text(payload_, field, value.get<std::string>());
  }
  if (place.element || (field.count == 1 && !value.is_array())) {
    return store_element(payload_, field, place.element.value_or(0), element_text_of(field, value));
  }
  if (!value.is_array() || value.size() > field.count) {
    return does_not_fit(name, json_text(value),
                        fmt::format("an array of up to {} values", field.count));
  }
  for (std::size_t i = 0; i < value.size(); ++i) {
    DSSM_TRY(store_element(payload_, field, i, element_text_of(field, value[i])));
  }
  return {};
}

// --- lines

// A record of CSV ends at a line end that is not in quotes.
Result<bool> SampleLines::get_record(std::string& record) {
  if (!std::getline(in_, record)) return false;
  const std::uint64_t first = ++line_;
  if (record.starts_with('{')) return true;
  const auto has_odd_quotes = [](const std::string& text) {
    return std::count(text.begin(), text.end(), '"') % 2 != 0;
  };
  bool is_open = has_odd_quotes(record);
  std::string more;
  while (is_open && std::getline(in_, more)) {
    ++line_;
    is_open = !has_odd_quotes(more);
    record += "\n" + more;
    if (record.size() > kMaxRecordBytes) break;
  }
  if (is_open) {
    return Error{Errc::invalid_argument,
                 fmt::format("line {}: a cell begins with a quote, and has no end", first)};
  }
  if (record.ends_with('\r')) record.pop_back();
  return true;
}

Result<std::optional<SampleInput>> SampleLines::next() {
  std::string record;
  while (DSSM_TRY(get_record(record))) {
    if (is_blank(record)) continue;
    const std::string context = fmt::format("line {}", line_);
    if (!header_ && !record.starts_with('{')) {
      DSSM_TRY(read_header(record), context);
      continue;
    }
    SampleInput sample(type_);
    DSSM_TRY(header_ ? read_row(record, sample) : read_json(record, sample), context);
    return std::optional(std::move(sample));
  }
  return std::optional<SampleInput>();
}

Result<void> SampleLines::read_json(const std::string& line, SampleInput& sample) const {
  const std::optional<Json> parsed = parse_json(line);
  if (!parsed || !parsed->is_object()) {
    return Error{Errc::invalid_argument, "this is not a JSON object on one line, as {\"x\": 1}"};
  }
  const Json& json = *parsed;
  // As `echo --json` prints it, or only the fields.
  const bool is_from_echo = json.contains("time_ns") && !sample.has("time_ns") &&
                            (json.contains("fields") || json.contains(kHexField));
  if (!is_from_echo) {
    for (const auto& [name, value] : json.items()) DSSM_TRY(sample.set_json(name, value));
    return {};
  }
  sample.time = DSSM_TRY(time_of(json_text(json["time_ns"]), false));
  const auto error = json.find("clock_error_ns");
  if (error != json.end()) sample.clock_error = DSSM_TRY(clock_error_of(json_text(*error)));
  if (json.contains(kHexField)) return sample.set_json(kHexField, json[kHexField]);
  for (const auto& [name, value] : json["fields"].items()) DSSM_TRY(sample.set_json(name, value));
  return {};
}

Result<void> SampleLines::read_header(const std::string& line) {
  std::vector<std::string> names = DSSM_TRY(cells_of(line));
  const bool is_from_echo = names.size() >= kInfoColumns && names[0] == "tid" &&
                            (names[1] == "time_ns" || names[1] == "time") &&
                            names[2] == "clock_error_ns";
  info_columns_ = is_from_echo ? kInfoColumns : 0;
  const SampleInput sample(type_);
  for (std::size_t i = info_columns_; i < names.size(); ++i) {
    if (!sample.has(names[i]) && names[i] != kHexField) {
      DSSM_TRY(SampleInput(type_).set_text(names[i], ""), fmt::format("column {}", i + 1));
    }
  }
  header_ = std::move(names);
  return {};
}

Result<void> SampleLines::read_row(const std::string& line, SampleInput& sample) const {
  const std::vector<std::string> cells = DSSM_TRY(cells_of(line));
  if (cells.size() != header_->size()) {
    return Error{Errc::invalid_argument, fmt::format("{} cells, and the header line has {}",
                                                     cells.size(), header_->size())};
  }
  if (info_columns_ > 0) {
    if (!cells[1].empty()) sample.time = DSSM_TRY(time_of(cells[1], (*header_)[1] == "time"));
    sample.clock_error = DSSM_TRY(clock_error_of(cells[2]));
  }
  for (std::size_t i = info_columns_; i < cells.size(); ++i) {
    if (!cells[i].empty()) DSSM_TRY(sample.set_cell((*header_)[i], cells[i]));
  }
  return {};
}

}  // namespace dssm::ctl
