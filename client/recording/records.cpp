// SPDX-License-Identifier: Apache-2.0
#include "client/recording/records.hpp"

#include <libdeflate.h>

#include <bit>

namespace dssm::recording {

static_assert(std::endian::native == std::endian::little);

Encoder& Encoder::map(const std::map<std::string, std::string>& entries) {
  std::size_t bytes = 0;
  for (const auto& [key, value] : entries) bytes += 4 + key.size() + 4 + value.size();
  number(static_cast<std::uint32_t>(bytes));
  for (const auto& [key, value] : entries) text(key).text(value);
  return *this;
}

std::map<std::string, std::string> Decoder::map() {
  std::map<std::string, std::string> entries;
  Decoder inner(bytes4());
  while (inner.ok() && !inner.rest().empty()) {
    const std::string_view key = inner.text();
    const std::string_view value = inner.text();
    if (inner.ok()) entries.emplace(key, value);
  }
  ok_ = ok_ && inner.ok();
  return entries;
}

void encode_header(Buffer& out, std::string_view profile, std::string_view library) {
  Encoder record(out);
  record.begin(Op::header).text(profile).text(library).end();
}

void encode(Buffer& out, const Schema& schema) {
  Encoder record(out);
  record.begin(Op::schema).number(schema.id).text(schema.name).text(schema.encoding);
  record.text(schema.data).end();
}

void encode(Buffer& out, const Channel& channel) {
  Encoder record(out);
  record.begin(Op::channel).number(channel.id).number(channel.schema_id).text(channel.topic);
  record.text(channel.message_encoding).map(channel.metadata).end();
}

void encode(Buffer& out, const ChunkIndex& index) {
  Encoder record(out);
  record.begin(Op::chunk_index).number(index.start_time).number(index.end_time);
  record.number(index.offset).number(index.length);
  record.number(static_cast<std::uint32_t>(index.index_offsets.size() * (2 + 8)));
  for (const auto& [channel, offset] : index.index_offsets) record.number(channel).number(offset);
  record.number(index.index_length).text(index.compression);
  record.number(index.compressed_bytes).number(index.uncompressed_bytes).end();
}

void encode(Buffer& out, const AttachmentIndex& index) {
  Encoder record(out);
  record.begin(Op::attachment_index).number(index.offset).number(index.length);
  record.number(index.log_time).number(index.create_time).number(index.data_bytes);
  record.text(index.name).text(index.media_type).end();
}

void encode(Buffer& out, const MetadataIndex& index) {
  Encoder record(out);
  record.begin(Op::metadata_index).number(index.offset).number(index.length).text(index.name).end();
}

void encode(Buffer& out, const Statistics& statistics) {
  Encoder record(out);
  record.begin(Op::statistics).number(statistics.messages).number(statistics.schemas);
  record.number(statistics.channels).number(statistics.attachments).number(statistics.metadata);
  record.number(statistics.chunks).number(statistics.start_time).number(statistics.end_time);
  record.number(static_cast<std::uint32_t>(statistics.channel_messages.size() * (2 + 8)));
  for (const auto& [channel, count] : statistics.channel_messages) {
    record.number(channel).number(count);
  }
  record.end();
}

void encode_attachment(Buffer& out, const AttachmentIndex& about, std::span<const std::byte> data) {
  Encoder record(out);
  record.begin(Op::attachment);
  const std::size_t start = out.size();
  record.number(about.log_time).number(about.create_time).text(about.name).text(about.media_type);
  record.number(static_cast<std::uint64_t>(data.size()));
  out.append(data);
  record.number(crc32(out.span().subspan(start))).end();
}

void encode_metadata(Buffer& out, std::string_view name,
                     const std::map<std::string, std::string>& entries) {
  Encoder record(out);
  record.begin(Op::metadata).text(name).map(entries).end();
}

void encode_summary_offset(Buffer& out, Op group, std::uint64_t start, std::uint64_t length) {
  Encoder record(out);
  record.begin(Op::summary_offset).number(group).number(start).number(length).end();
}

void encode_data_end(Buffer& out) {
  Encoder record(out);
  record.begin(Op::data_end).number(std::uint32_t{0}).end();  // no CRC: each chunk has one
}

void encode(Buffer& out, const ChunkHead& head) {
  const std::uint64_t length =
      8 + 8 + 8 + 4 + 4 + head.compression.size() + 8 + head.compressed_bytes;
  Encoder record(out);
  record.number(Op::chunk).number(length).number(head.start_time).number(head.end_time);
  record.number(head.uncompressed_bytes).number(head.crc).text(head.compression);
  record.number(head.compressed_bytes);
}

std::uint32_t crc32(std::span<const std::byte> bytes, std::uint32_t before) noexcept {
  return bytes.empty() ? before : libdeflate_crc32(before, bytes.data(), bytes.size());
}

}  // namespace dssm::recording
