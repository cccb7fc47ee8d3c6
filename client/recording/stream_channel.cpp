// SPDX-License-Identifier: Apache-2.0
#include "client/recording/stream_channel.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <charconv>

#include "core/base/try.hpp"

namespace dssm::recording {
namespace {

// The version of the layout that docs/recording.md describes.
constexpr std::string_view kVersionKey = "dssm_version";
constexpr std::string_view kVersion = "1";

Error bad_channel(const Channel& channel, std::string_view what) {
  return {Errc::protocol, fmt::format("channel {} ('{}'): {}", channel.id, channel.topic, what)};
}

// Names of fields come last on their line, with their control characters and '%' as %XX.
std::string escaped(std::string_view name) {
  std::string text;
  for (const char c : name) {
    if (static_cast<unsigned char>(c) < 0x20 || c == '%' || c == 0x7f) {
      text += fmt::format("%{:02x}", static_cast<unsigned char>(c));
    } else {
      text += c;
    }
  }
  return text;
}

std::optional<std::string> unescaped(std::string_view text) {
  std::string name;
  for (std::size_t i = 0; i < text.size(); ++i) {
    if (text[i] != '%') {
      name += text[i];
      continue;
    }
    unsigned value = 0;
    if (text.size() - i < 3) return std::nullopt;
    const char* first = text.data() + i + 1;
    if (std::from_chars(first, first + 2, value, 16).ptr != first + 2) return std::nullopt;
    name += static_cast<char>(value);
    i += 2;
  }
  return name;
}

// "float64 0 1 8 x\n": kind, offset, count, stride, name. Of a bit field the kind is followed by
// its first bit and the number of its bits: "uint32:5:3".
std::string text_of(const std::vector<Field>& fields) {
  std::string text;
  for (const Field& field : fields) {
    const std::string bits =
        field.bits == 0 ? "" : fmt::format(":{}:{}", field.first_bit, field.bits);
    text += fmt::format("{}{} {} {} {} {}\n", name_of(field.kind), bits, field.offset_bytes,
                        field.count, field.stride_bytes, escaped(field.name));
  }
  return text;
}

template <class Number>
bool parse(std::string_view text, Number& number) {
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
  return error == std::errc() && end == text.data() + text.size();
}

// Removes and returns what is before the first `separator`; nullopt without one.
std::optional<std::string_view> take_until(std::string_view& text, char separator) {
  const std::size_t at = text.find(separator);
  if (at == text.npos) return std::nullopt;
  const std::string_view part = text.substr(0, at);
  text.remove_prefix(at + 1);
  return part;
}

std::optional<Field> field_of(std::string_view line) {
  Field field;
  std::optional<std::string_view> kind = take_until(line, ' ');
  if (!kind) return std::nullopt;
  if (std::string_view bits = *kind; const auto name = take_until(bits, ':')) {
    const auto first = take_until(bits, ':');
    if (!first || !parse(*first, field.first_bit) || !parse(bits, field.bits)) return std::nullopt;
    kind = name;
  }
  bool known = false;
  for (int i = static_cast<int>(Scalar::boolean); i <= static_cast<int>(Scalar::float64); ++i) {
    if (name_of(static_cast<Scalar>(i)) != *kind) continue;
    field.kind = static_cast<Scalar>(i);
    known = true;
  }
  for (std::uint64_t* number : {&field.offset_bytes, &field.count, &field.stride_bytes}) {
    const auto text = take_until(line, ' ');
    if (!text || !parse(*text, *number)) return std::nullopt;
  }
  std::optional<std::string> name = unescaped(line);
  if (!known || !name) return std::nullopt;
  field.name = *std::move(name);
  return field;
}

std::byte* put_varint(std::byte* to, std::uint64_t value) noexcept {
  for (; value >= 0x80; value >>= 7) *to++ = static_cast<std::byte>(value | 0x80);
  *to++ = static_cast<std::byte>(value);
  return to;
}

std::uint64_t varint(Decoder& from) noexcept {
  std::uint64_t value = 0;
  for (unsigned shift = 0; shift < 64; shift += 7) {
    const auto byte = from.number<std::uint8_t>();
    value |= static_cast<std::uint64_t>(byte & 0x7f) << shift;
    if (byte < 0x80) return value;
  }
  (void)from.take(UINT64_MAX);  // too long: not ok any more
  return 0;
}

Duration duration_of(std::uint64_t ns) noexcept {
  return Duration(static_cast<std::int64_t>(std::min<std::uint64_t>(ns, INT64_MAX)));
}

}  // namespace

std::string topic_of(const StreamId& id) {
  return fmt::format("{}{}{}{}", id.name, id.id == 0 ? "" : fmt::format(":{}", id.id),
                     id.host.empty() ? "" : "@", id.host);
}

Channel channel_of(const RecordedStream& stream) {
  Channel channel;
  channel.topic = topic_of(stream.id);
  channel.message_encoding = "cdr";
  channel.metadata = stream.metadata;
  const std::map<std::string, std::string> own = {
      {std::string(kVersionKey), std::string(kVersion)},
      {"name", stream.id.name},
      {"id", std::to_string(stream.id.id)},
      {"host", stream.id.host},
      {"incarnation", std::to_string(stream.incarnation)},
      {"depth", std::to_string(stream.depth)},
      {"cycle_ns", std::to_string(to_ns(stream.cycle))},
  };
  for (const auto& [key, value] : own) channel.metadata[key] = value;
  set_type(channel, stream.type);
  return channel;
}

void set_type(Channel& channel, const TypeInfo& type) {
  channel.metadata["type"] = type.name;
  channel.metadata["payload_bytes"] = std::to_string(type.payload_bytes);
  channel.metadata["alignment_bytes"] = std::to_string(type.alignment_bytes);
  channel.metadata["fields"] = text_of(type.fields);
}

Result<std::optional<RecordedStream>> stream_of(const Channel& channel) {
  const auto& metadata = channel.metadata;
  const auto version = metadata.find(std::string(kVersionKey));
  if (version == metadata.end()) return std::optional<RecordedStream>{};
  if (version->second != kVersion) {
    return bad_channel(channel, fmt::format("its dssm_version '{}' is not known here; read it with "
                                            "a later version of DSSM",
                                            version->second));
  }
  const auto text = [&](const char* key) {
    const auto found = metadata.find(key);
    return found == metadata.end() ? std::string_view() : std::string_view(found->second);
  };
  RecordedStream stream;
  std::int64_t cycle_ns = 0;
  if (!parse(text("id"), stream.id.id) || !parse(text("incarnation"), stream.incarnation) ||
      !parse(text("depth"), stream.depth) || !parse(text("cycle_ns"), cycle_ns) ||
      !parse(text("payload_bytes"), stream.type.payload_bytes) ||
      !parse(text("alignment_bytes"), stream.type.alignment_bytes)) {
    return bad_channel(channel, "a number in its metadata is missing or wrong");
  }
  stream.id.name = text("name");
  stream.id.host = text("host");
  stream.cycle = Duration(cycle_ns);
  stream.type.name = text("type");
  for (std::string_view lines = text("fields"); !lines.empty();) {
    const auto line = take_until(lines, '\n');
    std::optional<Field> field = line ? field_of(*line) : std::nullopt;
    if (!field) return bad_channel(channel, "the fields in its metadata are wrong");
    stream.type.fields.push_back(*std::move(field));
  }
  const Channel known = channel_of(stream);
  for (const auto& [key, value] : metadata) {
    if (!known.metadata.contains(key)) stream.metadata[key] = value;
  }
  const std::string what = fmt::format("channel {} ('{}')", channel.id, channel.topic);
  for (Result<void> checked : {stream.id.check(), stream.type.check()}) {
    if (checked) continue;
    return Error{Errc::protocol, std::move(checked).error().context(what).message};
  }
  return std::optional(std::move(stream));
}

void encode_message(Buffer& out, std::uint16_t channel, const TypeInfo& type,
                    const SampleInfo& info, Duration clock_error,
                    std::span<const std::byte> payload) {
  const std::size_t start = out.size();
  std::byte* const first = out.grow(message_bytes(type, payload.size()));
  const std::uint64_t log_time = log_time_of(info.time);
  const auto tid = static_cast<std::uint64_t>(info.tid);
  std::byte* to = put(first + kRecordHeadBytes, channel);
  to = put(to, static_cast<std::uint32_t>(tid));
  to = put(to, log_time);
  to = put(to, log_time);
  to = put(to, kCdrHead);
  unsigned flags = 0;
  if (is_sequence(type)) to = put(to, static_cast<std::uint32_t>(payload.size()));
  if (!payload.empty()) std::memcpy(to, payload.data(), payload.size());
  to += payload.size();
  if (!is_sequence(type) && payload.size() < type.payload_bytes) {
    std::memset(to, 0, type.payload_bytes - payload.size());
    to += type.payload_bytes - payload.size();
    flags |= has_payload_bytes;
  }
  if (info.clock_error != kUnknownClockError) flags |= has_clock_error;
  if (clock_error != kUnknownClockError) flags |= has_clock_bound;
  if (tid >> 32 != 0) flags |= has_tid_high;
  if (info.time < Time{}) flags |= has_early_time;
  if (flags != 0) {
    to = put(to, static_cast<std::uint8_t>(flags));
    const auto add = [&](TrailerFlag flag, std::uint64_t value) {
      if ((flags & flag) != 0) to = put_varint(to, value);
    };
    add(has_clock_error, static_cast<std::uint64_t>(to_ns(info.clock_error)));
    add(has_clock_bound, static_cast<std::uint64_t>(to_ns(clock_error)));
    add(has_tid_high, tid >> 32);
    add(has_payload_bytes, payload.size());
    add(has_early_time, static_cast<std::uint64_t>(to_ns(info.time)));
  }
  put(put(first, Op::message), static_cast<std::uint64_t>(to - first) - kRecordHeadBytes);
  out.resize(start + static_cast<std::size_t>(to - first));
}

std::optional<MessageSample> decode_message(const TypeInfo& type, std::uint32_t sequence,
                                            std::uint64_t log_time,
                                            std::span<const std::byte> data) noexcept {
  Decoder from(data);
  MessageSample sample;
  if (from.number<std::uint32_t>() != kCdrHead) return std::nullopt;
  sample.info.payload_bytes = type.payload_bytes;
  if (is_sequence(type)) sample.info.payload_bytes = from.number<std::uint32_t>();
  if (sample.info.payload_bytes > type.payload_bytes) return std::nullopt;
  sample.payload_offset = data.size() - from.rest().size();
  const std::uint64_t held_bytes = sample.info.payload_bytes;
  (void)from.take(held_bytes);
  const std::uint8_t flags = from.rest().empty() ? std::uint8_t{0} : from.number<std::uint8_t>();
  const auto value = [&](TrailerFlag flag, std::uint64_t otherwise) {
    return (flags & flag) != 0 ? varint(from) : otherwise;
  };
  sample.info.clock_error = duration_of(value(has_clock_error, INT64_MAX));
  sample.clock_error = duration_of(value(has_clock_bound, INT64_MAX));
  const std::uint64_t tid_high = value(has_tid_high, 0);
  sample.info.payload_bytes = value(has_payload_bytes, sample.info.payload_bytes);
  sample.info.time = time_from_ns(static_cast<std::int64_t>(value(has_early_time, log_time)));
  sample.info.tid = static_cast<Tid>(tid_high << 32 | sequence);
  if (!from.ok() || tid_high > INT32_MAX || sample.info.payload_bytes > held_bytes ||
      (log_time > INT64_MAX && (flags & has_early_time) == 0)) {
    return std::nullopt;
  }
  return sample;
}

}  // namespace dssm::recording
