// SPDX-License-Identifier: Apache-2.0
#include "client/recording/file_writer.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>

#include "client/recording/stream_channel.hpp"
#include "core/base/try.hpp"

namespace dssm::recording {
namespace {

constexpr std::uint32_t kIndexVersion = 1;
constexpr std::size_t kPartBytes = 2 + 4 + 8 + 8 + 8 + 8 + 8;

// So that a power cut does not take the file's name.
Result<void> sync_folder(const std::filesystem::path& file) {
  const std::filesystem::path folder = file.has_parent_path() ? file.parent_path() : ".";
  const UniqueFd fd(::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!fd) return os_error(fmt::format("open folder '{}'", folder.string()));
  if (::fsync(fd.get()) != 0 && errno != EINVAL) {  // EINVAL: this file system has no fsync for it
    return os_error(fmt::format("sync folder '{}'", folder.string()));
  }
  return {};
}

template <class Items>
void encode_group(Buffer& out, Buffer& offsets, std::uint64_t start, Op op, const Items& items) {
  const std::size_t before = out.size();
  for (const auto& item : items) encode(out, item);
  if (out.size() > before) {
    encode_summary_offset(offsets, op, start + before, out.size() - before);
  }
}

std::vector<ChunkIndex> indexes_of(const std::vector<IndexedChunk>& chunks) {
  std::vector<ChunkIndex> indexes;
  for (const IndexedChunk& chunk : chunks) {
    if (!chunk.is_bare) indexes.push_back(chunk.index);
  }
  return indexes;
}

Statistics statistics_of(const Summary& summary) {
  Statistics statistics;
  statistics.schemas = static_cast<std::uint16_t>(summary.schemas.size());
  statistics.channels = static_cast<std::uint32_t>(summary.channels.size());
  statistics.attachments = static_cast<std::uint32_t>(summary.attachments.size());
  statistics.metadata = static_cast<std::uint32_t>(summary.metadata.size());
  statistics.start_time = UINT64_MAX;
  for (const Channel& channel : summary.channels) statistics.channel_messages[channel.id] = 0;
  for (const IndexedChunk& chunk : summary.chunks) {
    if (!chunk.is_bare) ++statistics.chunks;
    for (const Part& part : chunk.parts) {
      statistics.messages += part.samples;
      statistics.channel_messages[part.channel] += part.samples;
    }
    if (chunk.parts.empty()) continue;
    statistics.start_time = std::min(statistics.start_time, chunk.index.start_time);
    statistics.end_time = std::max(statistics.end_time, chunk.index.end_time);
  }
  if (statistics.messages == 0) statistics.start_time = 0;
  return statistics;
}

}  // namespace

std::uint64_t Summary::samples() const noexcept {
  std::uint64_t samples = 0;
  for (const IndexedChunk& chunk : chunks) {
    for (const Part& part : chunk.parts) samples += part.samples;
  }
  return samples;
}

std::uint64_t Summary::payload_bytes() const noexcept {
  std::uint64_t bytes = 0;
  for (const IndexedChunk& chunk : chunks) {
    for (const Part& part : chunk.parts) bytes += part.payload_bytes;
  }
  return bytes;
}

void Chunk::clear() noexcept {
  begins_file = false;
  descriptions.clear();
  channels.clear();
  properties.clear();
  gaps.clear();
  triggers.clear();
  messages.clear();
  used_parts = 0;
  start_time = UINT64_MAX;
  end_time = payload_bytes = property_bytes = 0;
}

void encode_index(Buffer& out, const std::vector<IndexedChunk>& chunks) {
  Encoder to(out);
  to.number(kIndexVersion).number(static_cast<std::uint32_t>(chunks.size()));
  for (const IndexedChunk& chunk : chunks) {
    to.number(chunk.index.offset).number(static_cast<std::uint32_t>(chunk.parts.size()));
    for (const Part& part : chunk.parts) {
      to.number(part.channel).number(part.samples).number(part.first_tid).number(part.last_tid);
      to.number(part.min_time_ns).number(part.max_time_ns).number(part.payload_bytes);
    }
  }
}

std::optional<std::map<std::uint64_t, std::vector<Part>>> decode_index(
    std::span<const std::byte> data) {
  Decoder from(data);
  if (from.number<std::uint32_t>() != kIndexVersion) return std::nullopt;
  std::map<std::uint64_t, std::vector<Part>> chunks;
  for (std::uint64_t left = from.number<std::uint32_t>(); left > 0 && from.ok(); --left) {
    const auto offset = from.number<std::uint64_t>();
    const std::uint64_t count = from.number<std::uint32_t>();
    if (count > from.rest().size() / kPartBytes) return std::nullopt;
    std::vector<Part>& parts = chunks[offset];
    parts.resize(count);
    for (Part& part : parts) {
      part.channel = from.number<std::uint16_t>();
      part.samples = from.number<std::uint32_t>();
      for (std::int64_t* number :
           {&part.first_tid, &part.last_tid, &part.min_time_ns, &part.max_time_ns}) {
        *number = from.number<std::int64_t>();
      }
      part.payload_bytes = from.number<std::uint64_t>();
    }
  }
  if (!from.ok() || !from.rest().empty()) return std::nullopt;
  return chunks;
}

std::string property_name(const Channel& channel) {
  const auto incarnation = channel.metadata.find("incarnation");
  return fmt::format("{}/{}/{}", kPropertyName,
                     incarnation == channel.metadata.end() ? "0" : incarnation->second,
                     channel.topic);
}

void encode_end(Buffer& out, const Summary& summary, std::uint64_t data_bytes) {
  Summary complete = summary;
  if (summary.has_index) {
    Buffer index;
    encode_index(index, summary.chunks);
    AttachmentIndex about;
    about.offset = data_bytes + out.size();
    about.log_time = statistics_of(summary).end_time;
    about.data_bytes = index.size();
    about.name = kIndexName;
    about.media_type = kIndexMediaType;
    const std::size_t before = out.size();
    encode_attachment(out, about, index.span());
    about.length = out.size() - before;
    complete.attachments.push_back(std::move(about));
  }
  encode_data_end(out);

  const std::size_t summary_start = out.size();
  Buffer offsets;
  encode_group(out, offsets, data_bytes, Op::schema, complete.schemas);
  encode_group(out, offsets, data_bytes, Op::channel, complete.channels);
  encode_group(out, offsets, data_bytes, Op::statistics, std::vector{statistics_of(complete)});
  encode_group(out, offsets, data_bytes, Op::chunk_index, indexes_of(complete.chunks));
  encode_group(out, offsets, data_bytes, Op::attachment_index, complete.attachments);
  encode_group(out, offsets, data_bytes, Op::metadata_index, complete.metadata);
  const std::size_t offsets_start = out.size();
  out.append(offsets.span());

  Encoder footer(out);
  footer.begin(Op::footer).number(data_bytes + summary_start).number(data_bytes + offsets_start);
  put(out.data() + out.size() - 16 - 8, std::uint64_t{kFooterBytes});  // the CRC covers it
  footer.number(crc32(out.span().subspan(summary_start)));
  out.append(std::as_bytes(std::span(kMagic)));
}

Result<FileWriter> FileWriter::create(const std::filesystem::path& path,
                                      const std::string& recording, std::uint32_t number) {
  FileWriter file;
  file.path_ = path;
  file.fd_ =
      std::make_shared<UniqueFd>(::open(path.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0666));
  if (!*file.fd_) {
    const int error = errno;
    if (error == EEXIST) {
      return Error{Errc::conflict, fmt::format("create recording '{}': a file of that name exists; "
                                               "choose another name, or delete it",
                                               path.string())};
    }
    Error failed = os_error(fmt::format("create recording '{}'", path.string()), error);
    if (error == ENOENT) failed.code = Errc::not_found;
    return failed;
  }
  (void)!::flock(file.fd_->get(), LOCK_EX | LOCK_NB);  // it is not to be repaired meanwhile
  file.head_.append(std::as_bytes(std::span(kMagic)));
  encode_header(file.head_, kProfile, "dssm " DSSM_VERSION);
  const std::size_t offset = file.head_.size();
  encode_metadata(file.head_, kRecordingName,
                  {{"recording", recording}, {"file", std::to_string(number)}});
  const MetadataIndex about{offset, file.head_.size() - offset, std::string(kRecordingName)};
  Result<void> begun = file.write({file.head_.span()});
  if (begun) begun = sync_folder(path);
  if (!begun) {
    ::unlink(path.c_str());  // it holds nothing
    return std::move(begun).error();
  }
  file.summary_.metadata.push_back(about);
  return file;
}

Result<void> FileWriter::write(std::initializer_list<std::span<const std::byte>> parts) {
  std::vector<iovec> left;
  for (const std::span<const std::byte> part : parts) {
    if (!part.empty()) left.push_back({const_cast<std::byte*>(part.data()), part.size()});
  }
  std::uint64_t end = bytes_;
  for (std::size_t first = 0; first < left.size();) {
    const ssize_t written =
        ::pwritev(fd_->get(), left.data() + first, static_cast<int>(left.size() - first),
                  static_cast<off_t>(end));
    if (written < 0 && errno == EINTR) continue;
    if (written <= 0) {
      const int error = written < 0 ? errno : EIO;
      Error failed = os_error(fmt::format("write recording '{}'", path_.string()), error);
      disk_full_ = error == ENOSPC || error == EDQUOT || error == EFBIG;
      if (disk_full_) failed.code = Errc::no_memory;
      // What follows the last whole record would hide what is appended next.
      (void)!::ftruncate(fd_->get(), static_cast<off_t>(bytes_));
      return failed;
    }
    end += static_cast<std::uint64_t>(written);
    for (std::size_t done = static_cast<std::size_t>(written); done > 0;) {
      iovec& part = left[first];
      const std::size_t bytes = std::min(done, part.iov_len);
      part.iov_base = static_cast<std::byte*>(part.iov_base) + bytes;
      part.iov_len -= bytes;
      done -= bytes;
      if (part.iov_len == 0) ++first;
    }
  }
  bytes_ = end;
  return {};
}

Result<void> FileWriter::add_channel(const NewChannel& channel) {
  head_.clear();
  const bool is_new = !has_schema_[channel.schema.id];
  if (is_new) encode(head_, channel.schema);
  encode(head_, channel.channel);
  DSSM_TRY(write({head_.span()}));
  if (is_new) summary_.schemas.push_back(channel.schema);
  summary_.channels.push_back(channel.channel);
  has_channel_[channel.channel.id] = has_schema_[channel.schema.id] = true;
  return {};
}

Result<void> FileWriter::add_property(const Channel& channel, const NewProperty& property) {
  AttachmentIndex about;
  about.offset = bytes_;
  about.log_time = property.log_time;
  about.data_bytes = property.property.size();
  about.name = property_name(channel);
  about.media_type = kPropertyMediaType;
  head_.clear();
  encode_attachment(head_, about, property.property);
  about.length = head_.size();
  DSSM_TRY(write({head_.span()}));
  summary_.attachments.push_back(std::move(about));
  return {};
}

Result<void> FileWriter::append(const Chunk& chunk, Compressor& compressor) {
  IndexedChunk indexed;
  std::span<const std::byte> records = chunk.messages.span();
  head_.clear();
  tail_.clear();
  if (!records.empty()) {
    ChunkIndex& index = indexed.index;
    ChunkHead head;
    head.start_time = index.start_time = chunk.start_time;
    head.end_time = index.end_time = chunk.end_time;
    head.uncompressed_bytes = index.uncompressed_bytes = records.size();
    head.crc = crc32(records);
    if (compressor.compress(records, compressed_)) {
      records = compressed_.span();
      index.compression = name_of(compressor.compression());
    }
    head.compression = index.compression;
    head.compressed_bytes = index.compressed_bytes = records.size();
    encode(head_, head);
    index.offset = bytes_;
    index.length = head_.size() + records.size();
    Encoder tail(tail_);
    for (const Chunk::IndexedPart& part : std::span(chunk.parts).first(chunk.used_parts)) {
      index.index_offsets.emplace_back(part.part.channel, bytes_ + index.length + tail_.size());
      tail.begin(Op::message_index).number(part.part.channel);
      tail.number(static_cast<std::uint32_t>(part.index.size()));
      tail_.append(part.index.span());
      tail.end();
      indexed.parts.push_back(part.part);
    }
    index.index_length = tail_.size();
  }
  std::vector<MetadataIndex> metadata;
  const auto add_metadata = [&](std::string_view name,
                                const std::map<std::string, std::string>& entries) {
    const std::size_t offset = tail_.size();
    encode_metadata(tail_, name, entries);
    metadata.push_back({bytes_ + head_.size() + records.size() + offset, tail_.size() - offset,
                        std::string(name)});
  };
  for (const Gaps& gap : chunk.gaps) {
    const auto channel = std::ranges::find(summary_.channels, gap.channel, &Channel::id);
    std::string text;
    for (const auto& [first, count] : gap.gaps) text += fmt::format("{}+{} ", first, count);
    text.pop_back();
    add_metadata(kGapName, {{"topic", channel->topic},
                            {"incarnation", channel->metadata.at("incarnation")},
                            {"gaps", text}});
  }
  for (const RecordedTrigger& trigger : chunk.triggers) {
    add_metadata(kTriggerName, {{"name", trigger.name},
                                {"reason", trigger.reason},
                                {"host", trigger.host},
                                {"time_ns", std::to_string(to_ns(trigger.time))}});
  }
  DSSM_TRY(write({head_.span(), records, tail_.span()}));
  if (!chunk.messages.span().empty()) summary_.chunks.push_back(std::move(indexed));
  summary_.metadata.insert(summary_.metadata.end(), metadata.begin(), metadata.end());
  return {};
}

Result<void> FileWriter::finish() {
  std::optional<Error> failed;
  while (!whole_) {
    head_.clear();
    encode_end(head_, summary_, bytes_);
    Result<void> written = write({head_.span()});
    whole_ = written.has_value();
    if (whole_) break;
    if (!failed) failed = std::move(written).error();
    if (!disk_full_ || summary_.chunks.empty()) break;
    drop_last_chunk();
  }
  (void)!::flock(fd_->get(), LOCK_UN);
  if (failed) return *std::move(failed);
  return {};
}

void FileWriter::drop_last_chunk() {
  bytes_ = summary_.chunks.back().index.offset;
  (void)!::ftruncate(fd_->get(), static_cast<off_t>(bytes_));
  summary_.chunks.pop_back();
  const auto is_gone = [&](const auto& record) { return record.offset >= bytes_; };
  std::erase_if(summary_.attachments, is_gone);
  std::erase_if(summary_.metadata, is_gone);
}

}  // namespace dssm::recording
