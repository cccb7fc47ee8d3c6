// SPDX-License-Identifier: Apache-2.0
//
// The records of an MCAP file (https://mcap.dev/spec): encoding and decoding. A record is an
// opcode (1 byte), the length of its content (8 bytes), and the content. Numbers are little endian.
// What is decoded comes from outside: it is checked here, and refers to the bytes given.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <cstring>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <type_traits>
#include <utility>
#include <vector>

namespace dssm::recording {

enum class Op : std::uint8_t {
  header = 1,
  footer,
  schema,
  channel,
  message,
  chunk,
  message_index,
  chunk_index,
  attachment,
  attachment_index,
  statistics,
  metadata,
  metadata_index,
  summary_offset,
  data_end,
};

inline constexpr std::array<std::uint8_t, 8> kMagic = {0x89, 'M', 'C', 'A', 'P', '0', '\r', '\n'};
inline constexpr std::size_t kRecordHeadBytes = 1 + 8;
inline constexpr std::size_t kMessageHeadBytes = 2 + 4 + 8 + 8;  // of a message, before its data
inline constexpr std::size_t kFooterBytes = 8 + 8 + 4;

// Bytes that grow at the end, without being set to 0 first.
class Buffer {
 public:
  std::byte* data() noexcept { return bytes_.get(); }
  const std::byte* data() const noexcept { return bytes_.get(); }
  std::size_t size() const noexcept { return size_; }
  std::size_t capacity() const noexcept { return capacity_; }
  std::span<const std::byte> span() const noexcept { return {bytes_.get(), size_}; }
  void clear() noexcept { size_ = 0; }
  void resize(std::size_t size) {
    if (size > capacity_) reserve(size);
    size_ = size;
  }
  // Appends `bytes` bytes, which the caller sets. Valid until the next call.
  std::byte* grow(std::size_t bytes) {
    if (bytes > capacity_ - size_) reserve(size_ + bytes + capacity_ / 2);
    std::byte* end = bytes_.get() + size_;
    size_ += bytes;
    return end;
  }
  void append(std::span<const std::byte> bytes) {
    if (!bytes.empty()) std::memcpy(grow(bytes.size()), bytes.data(), bytes.size());
  }
  void append(std::string_view text) { append(std::as_bytes(std::span(text))); }
  void reserve(std::size_t capacity) {
    if (capacity <= capacity_) return;
    auto larger = std::make_unique_for_overwrite<std::byte[]>(capacity);
    if (size_ > 0) std::memcpy(larger.get(), bytes_.get(), size_);
    bytes_ = std::move(larger);
    capacity_ = capacity;
  }

 private:
  std::unique_ptr<std::byte[]> bytes_;
  std::size_t size_ = 0;
  std::size_t capacity_ = 0;
};

// All machines that Debian's amd64 and arm64 run on are little endian: a copy is the encoding.
template <class Number>
std::byte* put(std::byte* to, Number number) noexcept {
  static_assert(std::is_integral_v<Number> || std::is_enum_v<Number>);
  std::memcpy(to, &number, sizeof number);
  return to + sizeof number;
}

// Appends fields, and records around them.
class Encoder {
 public:
  explicit Encoder(Buffer& out) noexcept : out_(out) {}

  template <class Number>
  Encoder& number(Number value) {
    put(out_.grow(sizeof value), value);
    return *this;
  }
  Encoder& text(std::string_view text) {
    number(static_cast<std::uint32_t>(text.size()));
    out_.append(text);
    return *this;
  }
  Encoder& map(const std::map<std::string, std::string>& entries);

  // Begins a record; end() sets its length.
  Encoder& begin(Op op) {
    number(op);
    number(std::uint64_t{0});
    start_ = out_.size();
    return *this;
  }
  void end() { put(out_.data() + start_ - 8, static_cast<std::uint64_t>(out_.size() - start_)); }

 private:
  Buffer& out_;
  std::size_t start_ = 0;  // of the record's content
};

// Takes fields from untrusted bytes. After one that does not fit, ok() is false and all further
// ones are empty.
class Decoder {
 public:
  explicit Decoder(std::span<const std::byte> bytes) noexcept : rest_(bytes) {}

  bool ok() const noexcept { return ok_; }
  std::span<const std::byte> rest() const noexcept { return rest_; }

  template <class Number>
  Number number() noexcept {
    Number value{};
    if (const auto bytes = take(sizeof value); bytes.size() == sizeof value) {
      std::memcpy(&value, bytes.data(), sizeof value);
    }
    return value;
  }
  // With a length of 4 (text, arrays, maps) or 8 bytes before them.
  std::span<const std::byte> bytes4() noexcept { return take(number<std::uint32_t>()); }
  std::span<const std::byte> bytes8() noexcept { return take(number<std::uint64_t>()); }
  std::string_view text() noexcept {
    const auto bytes = bytes4();
    return {reinterpret_cast<const char*>(bytes.data()), bytes.size()};
  }
  std::map<std::string, std::string> map();
  std::span<const std::byte> take(std::uint64_t bytes) noexcept {
    if (bytes > rest_.size()) {
      ok_ = false;
      rest_ = {};
      return {};
    }
    const auto taken = rest_.first(bytes);
    rest_ = rest_.subspan(bytes);
    return taken;
  }

 private:
  std::span<const std::byte> rest_;
  bool ok_ = true;
};

// --- what is in the records

struct Schema {
  std::uint16_t id = 0;
  std::string name, encoding, data;
  friend bool operator==(const Schema&, const Schema&) = default;
};

struct Channel {
  std::uint16_t id = 0;
  std::uint16_t schema_id = 0;
  std::string topic, message_encoding;
  std::map<std::string, std::string> metadata;
  friend bool operator==(const Channel&, const Channel&) = default;
};

// Where a chunk is and what it holds, as the summary has it.
struct ChunkIndex {
  std::uint64_t start_time = 0, end_time = 0;                          // of its messages
  std::uint64_t offset = 0, length = 0;                                // of the chunk's record
  std::vector<std::pair<std::uint16_t, std::uint64_t>> index_offsets;  // channel, message index
  std::uint64_t index_length = 0;                                      // of all message indexes
  std::string compression;
  std::uint64_t compressed_bytes = 0, uncompressed_bytes = 0;
};

struct AttachmentIndex {
  std::uint64_t offset = 0, length = 0, log_time = 0, create_time = 0, data_bytes = 0;
  std::string name, media_type;
};

struct MetadataIndex {
  std::uint64_t offset = 0, length = 0;
  std::string name;
};

struct Statistics {
  std::uint64_t messages = 0;
  std::uint16_t schemas = 0;
  std::uint32_t channels = 0, attachments = 0, metadata = 0, chunks = 0;
  std::uint64_t start_time = 0, end_time = 0;
  std::map<std::uint16_t, std::uint64_t> channel_messages;
};

// Each appends one record.
void encode_header(Buffer& out, std::string_view profile, std::string_view library);
void encode(Buffer& out, const Schema& schema);
void encode(Buffer& out, const Channel& channel);
void encode(Buffer& out, const ChunkIndex& index);
void encode(Buffer& out, const AttachmentIndex& index);
void encode(Buffer& out, const MetadataIndex& index);
void encode(Buffer& out, const Statistics& statistics);
void encode_attachment(Buffer& out, const AttachmentIndex& about, std::span<const std::byte> data);
void encode_metadata(Buffer& out, std::string_view name,
                     const std::map<std::string, std::string>& entries);
void encode_summary_offset(Buffer& out, Op group, std::uint64_t start, std::uint64_t length);
void encode_data_end(Buffer& out);

// A chunk's record up to its `compressed_bytes` bytes, which follow.
struct ChunkHead {
  std::uint64_t start_time = 0, end_time = 0;
  std::uint64_t uncompressed_bytes = 0;
  std::uint32_t crc = 0;  // of the uncompressed bytes; 0: none
  std::string_view compression;
  std::uint64_t compressed_bytes = 0;
};
void encode(Buffer& out, const ChunkHead& head);

// CRC-32 as in zlib, of `bytes` after those that gave `before`.
std::uint32_t crc32(std::span<const std::byte> bytes, std::uint32_t before = 0) noexcept;

}  // namespace dssm::recording
