// SPDX-License-Identifier: Apache-2.0
//
// Names, types and histories: parsing, checking, and the words for what is wrong with them.
#include <fmt/format.h>

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
          "stream name '{}': '{}' after ':' is no id; write name:id with an id from 0 to "
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

Result<void> TypeInfo::check_usable_as(const TypeInfo& wanted) const {
  const bool names_differ = !name.empty() && !wanted.name.empty() && name != wanted.name;
  // An untyped side knows no alignment worth comparing.
  const bool alignments_differ =
      !name.empty() && !wanted.name.empty() && alignment_bytes != wanted.alignment_bytes;
  if (payload_bytes == wanted.payload_bytes && !names_differ && !alignments_differ) return {};
  return Error{Errc::type_mismatch,
               fmt::format("the stream carries {}, this program wants {}; compile both sides with "
                           "the same definition of the type",
                           str(), wanted.str())};
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
  }
  return {};
}

Result<History> History::for_life(Duration life, Duration cycle) {
  if (cycle <= Duration::zero()) {
    return invalid(
        "a cycle of {} ns is not possible; it takes the time between two samples, more than 0",
        to_ns(cycle));
  }
  if (life < cycle) {
    return invalid(
        "a life of {} ns is shorter than the cycle of {} ns; keep at least one cycle of history",
        to_ns(life), to_ns(cycle));
  }
  const double slots =
      1.2 * static_cast<double>(to_ns(life)) / static_cast<double>(to_ns(cycle)) + 1;
  if (slots > static_cast<double>(kMaxDepth)) {
    return Error{Errc::limit_exceeded,
                 fmt::format("a life of {} ns at a cycle of {} ns needs more than {} slots; keep "
                             "less history",
                             to_ns(life), to_ns(cycle), kMaxDepth)};
  }
  return History{static_cast<std::uint64_t>(slots), cycle};
}

}  // namespace dssm
