// SPDX-License-Identifier: Apache-2.0
//
// Service instances to TXT records and back. What is written here is read by other versions for
// years: a key keeps its meaning, and a change that old readers would misunderstand takes another
// txtvers. What is read here any PC on the network may have written.
#include "daemon/fleet/service_record.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>
#include <limits>

#include "core/base/sha256.hpp"
#include "core/base/text.hpp"
#include "daemon/base/log.hpp"
#include "daemon/service/config_values.hpp"

namespace dssm::daemon {
namespace {

constexpr std::string_view kTxtVersion = "1";
constexpr std::size_t kHexDigits = 16;  // of 64 bits

// The longest value of ours: with its key and '=' it fits into one string of a TXT record.
static_assert(std::string_view("type=").size() + kMaxTypeNameBytes <= 255);

// A label as it is written inside the text of a domain name; equal to what avahi_escape_label()
// makes of it.
std::string escaped_label(std::string_view label) {
  std::string text;
  for (const char c : label) {
    if (is_letter_or_digit(c) || c == '-' || c == '_') {
      text += c;
    } else if (c == '.' || c == '\\') {
      text.append(1, '\\').append(1, c);
    } else {
      const unsigned byte = static_cast<unsigned char>(c);
      text += '\\';
      for (const unsigned unit : {100U, 10U, 1U}) text += static_cast<char>('0' + byte / unit % 10);
    }
  }
  return text;
}

char lower_case(char c) { return c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c; }

// RFC 6763 section 6.4: the case of keys does not count.
bool is_key(std::string_view found, std::string_view key) {
  return std::equal(found.begin(), found.end(), key.begin(), key.end(),
                    [](char a, char b) { return lower_case(a) == lower_case(b); });
}

std::size_t txt_bytes(const TxtRecord& txt) {
  std::size_t bytes = 0;
  for (const auto& [key, value] : txt) {
    bytes += 1 + key.size() + (value.empty() ? 0 : 1 + value.size());
  }
  return bytes;
}

// Takes values out of a record; keeps the first failure, after which values mean nothing.
class TxtReader {
 public:
  explicit TxtReader(const TxtRecord& txt) : txt_(txt) {}

  // The first of that key, RFC 6763 section 6.4; nullptr: there is none.
  const std::string* find(std::string_view key) const {
    const auto found =
        std::find_if(txt_.begin(), txt_.end(), [&](const auto& p) { return is_key(p.first, key); });
    return found == txt_.end() ? nullptr : &found->second;
  }

  std::string text(std::string_view key) {
    if (const std::string* value = find(key)) return *value;
    fail("the key '" + std::string(key) + "' is missing");
    return {};
  }

  std::uint64_t number(std::string_view key, std::uint64_t least, std::uint64_t most) {
    const Result<std::uint64_t> value = parse_count(text(key), least, most);
    if (value) return *value;
    fail(fmt::format("key '{}': {}", key, value.error().message));
    return 0;
  }

  // Exactly 16 hexadecimal digits.
  std::uint64_t hex(std::string_view key) { return hex_digits(key, text(key)); }

  wire::HostId host_id(std::string_view key) {
    const std::string digits = text(key);
    wire::HostId id{};
    if (digits.size() != 2 * id.size()) {
      fail(fmt::format("key '{}': {} is not {} hexadecimal digits long", key, in_quotes(digits),
                       2 * id.size()));
      return id;
    }
    for (std::size_t half = 0; half < 2; ++half) {
      const std::uint64_t value =
          hex_digits(key, std::string_view(digits).substr(half * kHexDigits, kHexDigits));
      for (std::size_t i = 0; i < 8; ++i) {
        id[half * 8 + i] = static_cast<std::uint8_t>(value >> (56 - 8 * i));
      }
    }
    return id;
  }

  void check(const Result<void>& checked) {
    if (!checked) fail(checked.error().message);
  }

  void fail(std::string reason) {
    if (!status_) return;
    // It may quote the record, and becomes part of messages that must be UTF-8.
    if (!is_utf8(reason)) {
      std::replace_if(
          reason.begin(), reason.end(), [](char c) { return (c & 0x80) != 0; }, '?');
    }
    status_ = Error{Errc::protocol, "its TXT record cannot be used: " + printable(reason)};
  }

  const Result<void>& status() const { return status_; }

 private:
  std::uint64_t hex_digits(std::string_view key, std::string_view digits) {
    std::uint64_t value = 0;
    const char* const end = digits.data() + digits.size();
    const auto [rest, error] = std::from_chars(digits.data(), end, value, 16);
    if (digits.size() == kHexDigits && error == std::errc() && rest == end) return value;
    fail(fmt::format("key '{}': {} is not {} hexadecimal digits", key, in_quotes(digits),
                     kHexDigits));
    return 0;
  }

  const TxtRecord& txt_;
  Result<void> status_;
};

ServiceRecord::Stream announced_stream_untrusted(TxtReader& txt, const std::string& host) {
  ServiceRecord::Stream stream;
  stream.name = txt.text("name");
  stream.id =
      static_cast<std::int32_t>(txt.number("id", 0, std::numeric_limits<std::int32_t>::max()));
  txt.check(StreamId{stream.name, stream.id, host}.check());
  stream.payload_bytes = txt.number("bytes", 1, kMaxPayloadBytes);
  stream.depth = txt.number("depth", kMinDepth, kMaxDepth);
  stream.cycle = Duration(
      static_cast<std::int64_t>(txt.number("cycle", 1, std::numeric_limits<std::int64_t>::max())));
  // Without a name it is "just bytes", TypeInfo::name.
  if (const std::string* type = txt.find("type")) stream.type = *type;
  if (stream.type.size() > kMaxTypeNameBytes || !is_utf8(stream.type)) {
    txt.fail(fmt::format("key 'type': {} is not UTF-8, or longer than {} bytes",
                         in_quotes(stream.type), kMaxTypeNameBytes));
  }
  stream.type_hash = txt.hex("hash");
  stream.incarnation = txt.hex("ring");
  return stream;
}

}  // namespace

std::string ServiceRecord::instance() const {
  return stream ? StreamId{stream->name, stream->id, host}.str() : host;
}

std::string ServiceRecord::subtype() const {
  if (!stream) return std::string(kHostSubtype);
  // Avahi takes no label of two bytes for a subtype; no name holds a colon, so this one is free.
  const std::string_view end = stream->name.size() == 1 ? ":" : "";
  return fmt::format("_{}{}._sub.{}", escaped_label(stream->name), end, kServiceType);
}

TxtRecord ServiceRecord::txt() const {
  TxtRecord txt = {{"txtvers", std::string(kTxtVersion)},
                   {"host", host},
                   {"hid", hex(host_id)},
                   {"proto", std::to_string(protocol_version)}};
  if (closed) txt.emplace_back("closed", "");
  if (!stream) return txt;
  txt.emplace_back("name", stream->name);
  txt.emplace_back("id", std::to_string(stream->id));
  txt.emplace_back("bytes", std::to_string(stream->payload_bytes));
  txt.emplace_back("depth", std::to_string(stream->depth));
  txt.emplace_back("cycle", std::to_string(to_ns(stream->cycle)));
  if (!stream->type.empty()) txt.emplace_back("type", stream->type);
  txt.emplace_back("hash", hex(stream->type_hash));
  txt.emplace_back("ring", hex(stream->incarnation));
  return txt;
}

std::uint64_t type_hash(const TypeInfo& type) {
  // Names by their lengths, since they may hold any character.
  const auto word = [](const auto number) { return std::to_string(number) + " "; };
  std::string text = fmt::format("{}{} {}{}", word(type.name.size()), type.name,
                                 word(type.payload_bytes), word(type.alignment_bytes));
  for (const Field& field : type.fields) {
    text += fmt::format("{}{} {}{}{}{}", word(field.name.size()), field.name,
                        word(static_cast<unsigned>(field.kind)), word(field.offset_bytes),
                        word(field.count), word(field.stride_bytes));
    if (field.bits > 0) text += word(unsigned{field.bits}) + word(unsigned{field.first_bit});
  }
  const Sha256 digest = sha256(text);
  std::uint64_t hash = 0;
  for (std::size_t i = 0; i < sizeof hash; ++i) hash = hash << 8 | digest[i];
  return hash;
}

Result<ServiceRecord> service_record_untrusted(const TxtRecord& txt) {
  TxtReader reader(txt);
  if (const std::size_t bytes = txt_bytes(txt); bytes > kMaxTxtBytes) {
    reader.fail(fmt::format("it is {} bytes long, which is more than {}", bytes, kMaxTxtBytes));
    return reader.status().error();
  }
  // First of all: another version may use the other keys in another way.
  if (const std::string version = reader.text("txtvers");
      reader.status() && version != kTxtVersion) {
    reader.fail(
        fmt::format("it has the version (txtvers) {}, and this dssmd knows {} only; install the "
                    "same DSSM on both",
                    in_quotes(version), kTxtVersion));
  }
  if (!reader.status()) return reader.status().error();
  ServiceRecord record;
  record.host = reader.text("host");
  reader.check(check_host_name(record.host));
  record.host_id = reader.host_id("hid");
  record.protocol_version = static_cast<std::uint32_t>(
      reader.number("proto", 1, std::numeric_limits<std::uint32_t>::max()));
  record.closed = reader.find("closed") != nullptr;
  if (reader.find("name")) record.stream = announced_stream_untrusted(reader, record.host);
  if (!reader.status()) return reader.status().error();
  return record;
}

}  // namespace dssm::daemon
