// SPDX-License-Identifier: Apache-2.0
//
// Names, types and histories: parsing, checking, and the words for what is wrong with them.
#include <fmt/format.h>

#include <algorithm>
#include <bit>
#include <charconv>
#include <dssm/stream.hpp>

#include "core/base/text.hpp"
#include "core/base/try.hpp"

namespace dssm {
namespace {

template <class... Values>
Error invalid(fmt::format_string<Values...> text, Values&&... values) {
  return Error{Errc::invalid_argument, fmt::format(text, std::forward<Values>(values)...)};
}

// Enough to recognize a type, short enough for a message.
constexpr std::size_t kShownFields = 16;

unsigned last_bit(const Field& field) { return field.first_bit + field.bits - 1U; }

std::string text_of(const Field& field) {
  const std::string count = field.count == 1 ? "" : fmt::format("[{}]", field.count);
  // In an array of structs, where the elements are not side by side.
  const std::string stride = field.count == 1 || field.stride_bytes == scalar_bytes(field.kind)
                                 ? ""
                                 : fmt::format(" every {}", field.stride_bytes);
  const std::string bits =
      field.bits == 0 ? "" : fmt::format(" bit {} to {}", field.first_bit, last_bit(field));
  return fmt::format("{} {}{} at {}{}{}", name_of(field.kind), field.name, count,
                     field.offset_bytes, bits, stride);
}

// Exactly, in the greatest unit that makes a whole number of it: "36000 s", "1500 us".
std::string text_of(Duration duration) {
  constexpr std::pair<std::int64_t, const char*> kUnits[] = {
      {1'000'000'000, "s"}, {1'000'000, "ms"}, {1'000, "us"}};
  const std::int64_t ns = to_ns(duration);
  for (const auto& [unit_ns, name] : kUnits) {
    if (ns % unit_ns == 0) return fmt::format("{} {}", ns / unit_ns, name);
  }
  return fmt::format("{} ns", ns);
}

// Whether both are the same bytes under the same name.
bool is_same(const Field& a, const Field& b) {
  return a.name == b.name && a.kind == b.kind && a.offset_bytes == b.offset_bytes &&
         a.count == b.count && (a.count == 1 || a.stride_bytes == b.stride_bytes) &&
         a.bits == b.bits && a.first_bit == b.first_bit;
}

// "field 2 is 'float64 y at 8' in the stream and 'float64 x at 8' in this program".
std::string first_difference(const std::vector<Field>& ours, const std::vector<Field>& wanted) {
  const auto text = [](const std::vector<Field>& fields, std::size_t at) {
    return at < fields.size() ? "'" + text_of(fields[at]) + "'" : std::string("missing");
  };
  std::size_t at = 0;
  while (at < ours.size() && at < wanted.size() && is_same(ours[at], wanted[at])) ++at;
  return fmt::format("field {} is {} in the stream and {} in this program", at + 1, text(ours, at),
                     text(wanted, at));
}

}  // namespace

Result<StreamId> StreamId::parse(std::string_view text) {
  StreamId id;
  std::string_view rest = text;
  if (const auto at = rest.find('@'); at != rest.npos) {
    id.host = rest.substr(at + 1);
    rest = rest.substr(0, at);
    if (id.host.empty()) {
      return invalid("stream name '{}': no host after '@'; write name:id@host", text);
    }
  }
  if (const auto colon = rest.find(':'); colon != rest.npos) {
    const std::string_view number = rest.substr(colon + 1);
    const auto [end, error] = std::from_chars(number.data(), number.data() + number.size(), id.id);
    if (error != std::errc() || end != number.data() + number.size() || number.empty()) {
      return invalid(
          "stream name '{}': '{}' after ':' is not an id; write name:id with an id from 0 to "
          "2147483647",
          text, number);
    }
    rest = rest.substr(0, colon);
  }
  id.name = rest;
  DSSM_TRY(id.check());
  return id;
}

Result<void> StreamId::check() const {
  if (name.empty()) return invalid("a stream's name is empty; give it 1 to 31 bytes");
  if (name.size() > kMaxNameBytes) {
    return invalid("stream name '{}' is {} bytes long; at most {} are possible", name, name.size(),
                   kMaxNameBytes);
  }
  for (const char c : name) {
    if (is_control(c) || c == ':' || c == '@') {
      return invalid(
          "stream name '{}' holds a control character, ':' or '@'; take another character", name);
    }
  }
  if (!is_utf8(name) || !is_utf8(host)) {
    return invalid("stream name '{}' is not UTF-8, which names of services have to be", name);
  }
  if (id < 0) {
    return invalid("stream '{}' has the id {}; ids start at 0", name, id);
  }
  for (const char c : host) {
    if (is_control(c) || c == ':' || c == '@') {
      return invalid("host name '{}' holds a control character, ':' or '@'", host);
    }
  }
  if (const std::string full = str(); full.size() > kMaxFullNameBytes) {
    return invalid(
        "stream name '{}' is {} bytes long with its host; at most {} fit into a DNS-SD "
        "instance name; shorten the name or the host's name",
        full, full.size(), kMaxFullNameBytes);
  }
  return {};
}

std::string StreamId::str() const {
  return fmt::format("{}:{}{}{}", name, id, host.empty() ? "" : "@", host);
}

std::uint32_t scalar_bytes(Scalar kind) noexcept {
  switch (kind) {
    case Scalar::boolean:
    case Scalar::character:
    case Scalar::int8:
    case Scalar::uint8:
      return 1;
    case Scalar::int16:
    case Scalar::uint16:
      return 2;
    case Scalar::int32:
    case Scalar::uint32:
    case Scalar::float32:
      return 4;
    case Scalar::int64:
    case Scalar::uint64:
    case Scalar::float64:
      return 8;
  }
  return 0;
}

std::string_view name_of(Scalar kind) noexcept {
  switch (kind) {
    case Scalar::boolean:
      return "bool";
    case Scalar::character:
      return "char";
    case Scalar::int8:
      return "int8";
    case Scalar::uint8:
      return "uint8";
    case Scalar::int16:
      return "int16";
    case Scalar::uint16:
      return "uint16";
    case Scalar::int32:
      return "int32";
    case Scalar::uint32:
      return "uint32";
    case Scalar::int64:
      return "int64";
    case Scalar::uint64:
      return "uint64";
    case Scalar::float32:
      return "float32";
    case Scalar::float64:
      return "float64";
  }
  return "unknown";
}

std::string TypeInfo::str() const {
  const std::string bytes =
      fmt::format("{} {}", payload_bytes, payload_bytes == 1 ? "byte" : "bytes");
  return name.empty() ? bytes
                      : fmt::format("'{}' ({}, aligned to {})", name, bytes, alignment_bytes);
}

std::string TypeInfo::description() const {
  std::string text = str();
  if (fields.empty()) return text;
  text += " {";
  for (std::size_t i = 0; i < std::min(fields.size(), kShownFields); ++i) {
    text += " " + text_of(fields[i]) + ";";
  }
  if (fields.size() > kShownFields) {
    text += fmt::format(" and {} more;", fields.size() - kShownFields);
  }
  return text + " }";
}

Result<void> TypeInfo::check_usable_as(const TypeInfo& wanted) const {
  // An untyped side knows no name and no alignment worth comparing.
  const bool both_named = !name.empty() && !wanted.name.empty();
  const bool is_other_type =
      payload_bytes != wanted.payload_bytes ||
      (both_named && (name != wanted.name || alignment_bytes != wanted.alignment_bytes));
  // Lists leave out the fields of many types.
  const bool both_described = both_named && !fields.empty() && !wanted.fields.empty();
  const bool fields_differ = !is_other_type && both_described &&
                             !std::equal(fields.begin(), fields.end(), wanted.fields.begin(),
                                         wanted.fields.end(), is_same);
  if (!is_other_type && !fields_differ) return {};
  return Error{Errc::type_mismatch,
               fmt::format("the stream carries {}, this program wants {}{}; compile both sides "
                           "with the same definition of the type",
                           description(), wanted.description(),
                           fields_differ ? ": " + first_difference(fields, wanted.fields) : "")};
}

bool TypeInfo::is_less_described_than(const TypeInfo& other) const noexcept {
  return (name.empty() && !other.name.empty()) || (fields.empty() && !other.fields.empty());
}

Result<void> TypeInfo::check() const {
  if (name.size() > kMaxTypeNameBytes) {
    return invalid("type name '{}...' is {} bytes long; at most {} are possible",
                   name.substr(0, 40), name.size(), kMaxTypeNameBytes);
  }
  if (!is_utf8(name)) return invalid("type name '{}' is not UTF-8", name);
  if (payload_bytes < 1 || payload_bytes > kMaxPayloadBytes) {
    return invalid("a payload of {} bytes is not possible; it takes 1 byte to 64 MiB",
                   payload_bytes);
  }
  if (!std::has_single_bit(alignment_bytes) || alignment_bytes > 64) {
    return invalid("an alignment of {} bytes is not possible; it takes a power of two up to 64",
                   alignment_bytes);
  }
  if (fields.size() > kMaxFields) {
    return Error{Errc::limit_exceeded,
                 fmt::format("a type with {} fields; at most {} are possible: describe fewer",
                             fields.size(), kMaxFields)};
  }
  for (const Field& field : fields) {
    const std::uint64_t bytes = scalar_bytes(field.kind);
    if (!is_utf8(field.name)) return invalid("field name '{}' is not UTF-8", field.name);
    const bool sane = bytes != 0 && field.count >= 1 && field.count <= payload_bytes &&
                      field.stride_bytes <= payload_bytes && field.offset_bytes < payload_bytes;
    if (!sane ||
        field.offset_bytes + (field.count - 1) * field.stride_bytes + bytes > payload_bytes) {
      return invalid(
          "field '{}' of type {} does not lie inside the payload; check its DSSM_DESCRIBE line",
          field.name, str());
    }
    const bool is_float = field.kind == Scalar::float32 || field.kind == Scalar::float64;
    if (field.bits > 0 && (is_float || last_bit(field) >= 8 * bytes)) {
      return invalid("field '{}' of type {} is not a bit field that its element can hold: {}",
                     field.name, str(), text_of(field));
    }
  }
  return {};
}

Result<History> History::for_life(Duration life, Duration cycle) {
  if (cycle <= Duration::zero()) {
    return invalid(
        "a cycle of {} is not possible; it takes the time between two samples, more than 0",
        text_of(cycle));
  }
  if (life < cycle) {
    return invalid(
        "a life of {} is shorter than the cycle of {}; keep at least one cycle of history",
        text_of(life), text_of(cycle));
  }
  const double slots =
      1.2 * static_cast<double>(to_ns(life)) / static_cast<double>(to_ns(cycle)) + 1;
  if (slots > static_cast<double>(kMaxDepth)) {
    return Error{Errc::limit_exceeded,
                 fmt::format("a life of {} at a cycle of {} needs more than {} slots; keep less "
                             "history",
                             text_of(life), text_of(cycle), kMaxDepth)};
  }
  return History{static_cast<std::uint64_t>(slots), cycle};
}

Duration pause_length(std::span<const Duration> intervals, Duration cycle) noexcept {
  Duration longest{}, second{};
  for (const Duration interval : intervals) {
    if (interval > longest) {
      second = longest;
      longest = interval;
    } else {
      second = std::max(second, interval);
    }
  }
  const Duration usual = intervals.size() < 2 ? std::max(cycle, longest) : second;
  constexpr int kIntervals = 5;
  constexpr Duration kMinPause = std::chrono::seconds(1);
  if (usual > Duration::max() / kIntervals) return Duration::max();
  return std::max(kIntervals * usual, kMinPause);
}

}  // namespace dssm
