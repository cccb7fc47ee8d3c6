// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/fields.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <cstring>
#include <utility>
#include <variant>

#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// One element, widened to the kinds that print differently.
using Value = std::variant<bool, char, std::int64_t, std::uint64_t, float, double>;

// Payloads are in the byte order of their PC, which is this one.
template <class T>
T load(const std::byte* place) {
  T value;
  std::memcpy(&value, place, sizeof value);
  return value;
}

// A whole number, or the bits of it that are the field.
template <class T>
Value whole(const std::byte* place, const Field& field) {
  using Wide = std::conditional_t<std::is_signed_v<T>, std::int64_t, std::uint64_t>;
  const T element = load<T>(place);
  if (field.bits == 0) return Wide{element};
  const auto bits = std::uint64_t{static_cast<std::make_unsigned_t<T>>(element)};
  // Shifts of signed numbers repeat the sign.
  return static_cast<Wide>(bits << (64 - field.first_bit - field.bits)) >> (64 - field.bits);
}

Value value_at(std::span<const std::byte> payload, const Field& field, std::uint64_t i) {
  const std::byte* place = payload.data() + field.offset_bytes + i * field.stride_bytes;
  switch (field.kind) {
    case Scalar::boolean:
      // 2 in a bool is undefined to load.
      return std::get<std::uint64_t>(whole<std::uint8_t>(place, field)) != 0;
    case Scalar::character:
      return load<char>(place);
    case Scalar::int8:
      return whole<std::int8_t>(place, field);
    case Scalar::uint8:
      return whole<std::uint8_t>(place, field);
    case Scalar::int16:
      return whole<std::int16_t>(place, field);
    case Scalar::uint16:
      return whole<std::uint16_t>(place, field);
    case Scalar::int32:
      return whole<std::int32_t>(place, field);
    case Scalar::uint32:
      return whole<std::uint32_t>(place, field);
    case Scalar::int64:
      return whole<std::int64_t>(place, field);
    case Scalar::uint64:
      return whole<std::uint64_t>(place, field);
    case Scalar::float32:
      return load<float>(place);
    case Scalar::float64:
      return load<double>(place);
  }
  return std::uint64_t{0};  // not reached: readable_fields_untrusted() passes only known kinds
}

// Numbers so short that reading them again gives the same bits.
std::string bare_text(const Value& value) {
  return std::visit(
      [](auto v) -> std::string {
        if constexpr (std::is_same_v<decltype(v), bool>) {
          return v ? "true" : "false";
        } else if constexpr (std::is_same_v<decltype(v), char>) {
          return std::string(1, v);
        } else {
          std::array<char, 32> text{};
          return {text.data(), std::to_chars(text.data(), text.data() + text.size(), v).ptr};
        }
      },
      value);
}

std::string quoted_text(const Value& value) {
  if (const char* c = std::get_if<char>(&value)) {
    return fmt::format("'{}'", escaped({c, 1}));
  }
  return bare_text(value);
}

Json value_json(const Value& value) {
  return std::visit(
      [](auto v) -> Json {
        if constexpr (std::is_same_v<decltype(v), char>) {
          return std::string(1, v);
        } else {
          return v;  // NaN and infinity are dumped as null
        }
      },
      value);
}

// How many elements of the field the sample has, which may be shorter than its stream's samples.
std::uint64_t elements_in(std::span<const std::byte> payload, const Field& field) {
  const std::uint64_t first_end = field.offset_bytes + scalar_bytes(field.kind);
  if (payload.size() < first_end) return 0;
  if (field.count == 1) return 1;
  return std::min(field.count, (payload.size() - first_end) / field.stride_bytes + 1);
}

bool fits_untrusted(const Field& field, std::uint64_t payload_bytes) {
  if (field.kind < Scalar::boolean || field.kind > Scalar::float64) return false;
  const std::uint64_t element_bytes = scalar_bytes(field.kind);
  if (field.count == 0 || field.offset_bytes > payload_bytes) return false;
  if (field.bits > 0 && field.first_bit + field.bits > 8 * element_bytes) return false;
  const std::uint64_t rest = payload_bytes - field.offset_bytes;
  if (element_bytes > rest) return false;
  if (field.count == 1) return true;
  // Elements that overlap would make a small payload endless.
  return field.stride_bytes >= element_bytes &&
         field.count - 1 <= (rest - element_bytes) / field.stride_bytes;
}

bool asks_for(const std::string& wanted, const std::string& name) {
  if (!name.starts_with(wanted)) return false;
  return name.size() == wanted.size() || name[wanted.size()] == '.' || name[wanted.size()] == '[';
}

}  // namespace

std::vector<Field> readable_fields_untrusted(const TypeInfo& type) {
  const bool all_fit = std::all_of(type.fields.begin(), type.fields.end(), [&](const Field& field) {
    return fits_untrusted(field, type.payload_bytes);
  });
  return all_fit ? type.fields : std::vector<Field>{};
}

Result<std::vector<Field>> select_fields(std::vector<Field> fields,
                                         const std::vector<std::string>& wanted) {
  for (const std::string& name : wanted) {
    const auto is_it = [&](const Field& field) { return asks_for(name, field.name); };
    if (std::any_of(fields.begin(), fields.end(), is_it)) continue;
    if (fields.empty()) {
      return Error{
          Errc::invalid_argument,
          fmt::format("no field '{}': this stream's type does not describe its fields", name)};
    }
    std::vector<std::string_view> known;
    known.reserve(fields.size());
    for (const Field& field : fields) known.push_back(field.name);
    return Error{Errc::invalid_argument,
                 fmt::format("no field '{}'; there are '{}'", name, fmt::join(known, "', '"))};
  }
  if (!wanted.empty()) {
    std::erase_if(fields, [&](const Field& field) {
      return std::none_of(wanted.begin(), wanted.end(),
                          [&](const std::string& name) { return asks_for(name, field.name); });
    });
  }
  return fields;
}

std::optional<FieldElement> find_field(const std::vector<Field>& fields, std::string_view wanted) {
  for (const Field& field : fields) {
    if (wanted == field.name) return FieldElement{field, std::nullopt};
    if (!wanted.starts_with(field.name + "[") || !wanted.ends_with(']')) continue;
    const std::size_t begin = field.name.size() + 1;
    const Result<std::uint64_t> number =
        parse_whole(wanted.substr(begin, wanted.size() - begin - 1), 0, field.count - 1);
    if (number) return FieldElement{field, *number};
  }
  return std::nullopt;
}

bool is_text(const Field& field) {
  return field.kind == Scalar::character && field.count > 1 && field.stride_bytes == 1;
}

std::string text_of(std::span<const std::byte> payload, const Field& field) {
  const auto* start = reinterpret_cast<const char*>(payload.data() + field.offset_bytes);
  return std::string(start, ::strnlen(start, elements_in(payload, field)));
}

std::string field_text(std::span<const std::byte> payload, const Field& field, std::size_t shown) {
  if (is_text(field)) {
    std::string text = text_of(payload, field);
    const std::size_t hidden = text.size() > shown ? text.size() - shown : 0;
    text.resize(text.size() - hidden);
    std::string out = double_quoted(text);
    if (hidden > 0) out += fmt::format(" ... {} more", hidden);
    return out;
  }
  const std::uint64_t count = elements_in(payload, field);
  if (field.count == 1) return count == 0 ? "-" : quoted_text(value_at(payload, field, 0));
  std::string out = "[";
  const std::uint64_t end = std::min<std::uint64_t>(count, shown);
  for (std::uint64_t i = 0; i < end; ++i) {
    if (i > 0) out += ", ";
    out += quoted_text(value_at(payload, field, i));
  }
  if (end < count) out += fmt::format(", ... {} more", count - end);
  return out + "]";
}

Json field_json(std::span<const std::byte> payload, const Field& field) {
  if (is_text(field)) return text_of(payload, field);
  const std::uint64_t count = elements_in(payload, field);
  if (field.count == 1) return count == 0 ? Json() : value_json(value_at(payload, field, 0));
  Json array = Json::array();
  for (std::uint64_t i = 0; i < count; ++i) {
    array.push_back(value_json(value_at(payload, field, i)));
  }
  return array;
}

std::string element_text(std::span<const std::byte> payload, const Field& field, std::uint64_t i) {
  if (is_text(field)) return text_of(payload, field);
  if (i >= elements_in(payload, field)) return "";
  const Value value = value_at(payload, field, i);
  const char* const c = std::get_if<char>(&value);
  return c && *c == '\0' ? "" : bare_text(value);  // programs that read lines end at a zero byte
}

std::optional<double> element_number(std::span<const std::byte> payload, const Field& field,
                                     std::uint64_t i) {
  if (i >= elements_in(payload, field)) return std::nullopt;
  return std::visit([](auto v) { return static_cast<double>(v); }, value_at(payload, field, i));
}

}  // namespace dssm::ctl
