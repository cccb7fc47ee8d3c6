// SPDX-License-Identifier: Apache-2.0
#include "client/recording/file_reader.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <charconv>

#include "client/recording/stream_channel.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"

namespace dssm::recording {
namespace {

constexpr std::uint64_t kWindowBytes = 256U << 10;
constexpr std::size_t kMaxWarnings = 100;
constexpr std::uint64_t kMaxBareBytes = 1U << 20;  // of message records that are read together
constexpr std::uint64_t kEndBytes = kRecordHeadBytes + kFooterBytes + kMagic.size();

struct RecordHead {
  Op op;
  std::uint64_t length;
};

RecordHead head_of(std::span<const std::byte> bytes) noexcept {
  Decoder from(bytes);
  const Op op = from.number<Op>();
  return {op, from.number<std::uint64_t>()};
}

std::optional<Channel> decode_channel(std::span<const std::byte> content) {
  Decoder from(content);
  Channel channel;
  channel.id = from.number<std::uint16_t>();
  channel.schema_id = from.number<std::uint16_t>();
  channel.topic = from.text();
  channel.message_encoding = from.text();
  channel.metadata = from.map();
  if (!from.ok()) return std::nullopt;
  return channel;
}

std::optional<Schema> decode_schema(std::span<const std::byte> content) {
  Decoder from(content);
  Schema schema;
  schema.id = from.number<std::uint16_t>();
  schema.name = from.text();
  schema.encoding = from.text();
  schema.data = from.text();
  if (!from.ok()) return std::nullopt;
  return schema;
}

// A chunk's fields up to its data, which remain in `from`.
std::optional<ChunkHead> decode_chunk_head(Decoder& from) noexcept {
  ChunkHead head;
  head.start_time = from.number<std::uint64_t>();
  head.end_time = from.number<std::uint64_t>();
  head.uncompressed_bytes = from.number<std::uint64_t>();
  head.crc = from.number<std::uint32_t>();
  head.compression = from.text();
  head.compressed_bytes = from.number<std::uint64_t>();
  if (!from.ok() || head.compressed_bytes > from.rest().size()) return std::nullopt;
  return head;
}

std::optional<ChunkIndex> decode_chunk_index(std::span<const std::byte> content) {
  Decoder from(content);
  ChunkIndex index;
  index.start_time = from.number<std::uint64_t>();
  index.end_time = from.number<std::uint64_t>();
  index.offset = from.number<std::uint64_t>();
  index.length = from.number<std::uint64_t>();
  (void)from.bytes4();  // where the message indexes are: for other tools
  index.index_length = from.number<std::uint64_t>();
  index.compression = from.text();
  index.compressed_bytes = from.number<std::uint64_t>();
  index.uncompressed_bytes = from.number<std::uint64_t>();
  if (!from.ok()) return std::nullopt;
  return index;
}

// The content of an attachment; nullopt: damaged.
struct Attachment {
  AttachmentIndex about;
  std::span<const std::byte> data;
};
std::optional<Attachment> decode_attachment(std::span<const std::byte> content) {
  Decoder from(content);
  Attachment attachment;
  attachment.about.log_time = from.number<std::uint64_t>();
  attachment.about.create_time = from.number<std::uint64_t>();
  attachment.about.name = from.text();
  attachment.about.media_type = from.text();
  attachment.data = from.bytes8();
  attachment.about.data_bytes = attachment.data.size();
  const std::size_t covered = content.size() - from.rest().size();
  const auto crc = from.number<std::uint32_t>();
  if (!from.ok() || (crc != 0 && crc != crc32(content.first(covered)))) return std::nullopt;
  return attachment;
}

}  // namespace

void add_property(std::vector<PropertyPlace>& properties, const PropertyPlace& added) {
  while (!properties.empty() && properties.back().from >= added.from) properties.pop_back();
  properties.push_back(added);
}

void FileReader::warn(std::string_view what) {
  if (warnings_.size() < kMaxWarnings) {
    warnings_.push_back(fmt::format("'{}': {}", path_.string(), printable(what)));
  }
}

Result<std::span<const std::byte>> FileReader::read(std::uint64_t offset, std::uint64_t bytes) {
  if (offset > bytes_ || bytes > bytes_ - offset) {
    return Error{Errc::protocol, fmt::format("'{}' ends too early", path_.string())};
  }
  const bool is_here = offset >= window_offset_ && offset - window_offset_ <= window_.size() &&
                       bytes <= window_.size() - (offset - window_offset_);
  if (!is_here) {
    const std::uint64_t wanted = std::max(bytes, std::min(kWindowBytes, bytes_ - offset));
    window_.clear();
    window_.resize(wanted);
    std::uint64_t got = 0;
    while (got < wanted) {
      const ssize_t more =
          ::pread(fd_.get(), window_.data() + got, wanted - got, static_cast<off_t>(offset + got));
      if (more < 0 && errno == EINTR) continue;
      if (more <= 0) {
        window_.clear();
        if (more < 0) return os_error(fmt::format("read recording '{}'", path_.string()));
        return Error{Errc::protocol, fmt::format("recording '{}' became shorter while it was read",
                                                 path_.string())};
      }
      got += static_cast<std::uint64_t>(more);
    }
    window_offset_ = offset;
  }
  return window_.span().subspan(offset - window_offset_, bytes);
}

Result<std::unique_ptr<FileReader>> FileReader::open(const std::filesystem::path& path,
                                                     bool for_repair) {
  std::unique_ptr<FileReader> file(new FileReader);
  file->path_ = path;
  file->fd_ = UniqueFd(::open(path.c_str(), (for_repair ? O_RDWR : O_RDONLY) | O_CLOEXEC));
  const std::string what = fmt::format("open recording '{}'", path.string());
  if (!file->fd_) {
    const int error = errno;
    Error failed = os_error(what, error);
    if (error == ENOENT) failed.code = Errc::not_found;
    return failed;
  }
  if (for_repair && ::flock(file->fd_.get(), LOCK_EX | LOCK_NB) != 0 && errno == EWOULDBLOCK) {
    return Error{Errc::unavailable,
                 fmt::format("repair recording '{}': a process is still writing it; end that first",
                             path.string())};
  }
  struct stat about {};
  if (::fstat(file->fd_.get(), &about) != 0) return os_error(what);
  if (!S_ISREG(about.st_mode)) {
    return Error{Errc::invalid_argument, fmt::format("{}: it is not a regular file", what)};
  }
  file->bytes_ = static_cast<std::uint64_t>(about.st_size);
  DSSM_TRY(file->begin(), what);
  if (file->log_) {
    file->scan_log();
    return file;
  }
  if (file->data_start_ == 0 || file->open_by_summary()) return file;
  file->scan();
  return file;
}

// Magic and header, or the head of a log. An MCAP file that was cut off within them holds nothing.
Result<void> FileReader::begin() {
  const std::uint64_t known = std::min<std::uint64_t>(bytes_, kMagic.size());
  const auto magic = DSSM_TRY(read(0, known));
  if (!std::ranges::equal(magic, std::as_bytes(std::span(kMagic)).first(known))) {
    const auto begin = DSSM_TRY(read(0, std::min<std::uint64_t>(bytes_, kMaxSsmLogLineBytes)));
    const std::string text(reinterpret_cast<const char*>(begin.data()), begin.size());
    if (Result<void> log = begin_log(text); !log) {
      return Error{Errc::protocol, fmt::format("it is not an MCAP file, and as a log of SSM: {}",
                                               printable(log.error().message))};
    }
    return {};
  }
  if (bytes_ < kMagic.size() + kRecordHeadBytes) {
    warn("it is empty: its writer was ended before it had written anything");
    return {};
  }
  const RecordHead head = head_of(DSSM_TRY(read(kMagic.size(), kRecordHeadBytes)));
  if (head.op != Op::header) return Error{Errc::protocol, "it has no MCAP header"};
  const std::uint64_t start = kMagic.size() + kRecordHeadBytes;
  if (head.length > bytes_ - start) {
    warn("it is empty: its writer was ended before it had written anything");
    return {};
  }
  Decoder from(DSSM_TRY(read(start, head.length)));
  is_ours_ = from.text() == kProfile;
  if (!from.ok()) return Error{Errc::protocol, "its MCAP header is damaged"};
  summary_.has_index = is_ours_;
  data_start_ = data_end_ = start + head.length;
  return {};
}

// --- by the summary

// False: it has to be read from begin to end.
bool FileReader::open_by_summary() {
  if (bytes_ < data_start_ + kEndBytes) return false;
  const auto end = read(bytes_ - kEndBytes, kEndBytes);
  if (!end) return false;
  const RecordHead head = head_of(*end);
  if (head.op != Op::footer || head.length != kFooterBytes ||
      !std::ranges::equal(end->last(kMagic.size()), std::as_bytes(std::span(kMagic)))) {
    return false;
  }
  is_whole_ = true;
  Decoder footer(end->subspan(kRecordHeadBytes));
  const auto start = footer.number<std::uint64_t>();
  (void)footer.number<std::uint64_t>();
  const auto crc = footer.number<std::uint32_t>();
  if (!is_ours_ || start < data_start_ || start > bytes_ - kEndBytes) return false;

  const auto records = read(start, bytes_ - start - kMagic.size());
  if (!records || crc32(records->first(records->size() - 4)) != crc) return false;
  const std::vector<std::byte> kept(records->begin(), records->end());  // read() is used below
  std::vector<MetadataIndex> metadata;
  std::vector<AttachmentIndex> attachments;
  std::map<std::uint64_t, ChunkIndex> chunks;
  for (std::span<const std::byte> rest = kept; rest.size() >= kRecordHeadBytes;) {
    const RecordHead record = head_of(rest);
    rest = rest.subspan(kRecordHeadBytes);
    if (record.length > rest.size()) return false;
    const auto content = rest.first(record.length);
    rest = rest.subspan(record.length);
    Decoder from(content);
    if (record.op == Op::channel) {
      std::optional<Channel> channel = decode_channel(content);
      if (!channel) return false;
      add_channel(*std::move(channel));
    } else if (record.op == Op::chunk_index) {
      std::optional<ChunkIndex> index = decode_chunk_index(content);
      if (!index) return false;
      const std::uint64_t offset = index->offset;
      chunks[offset] = *std::move(index);
    } else if (record.op == Op::attachment_index) {
      AttachmentIndex about;
      about.offset = from.number<std::uint64_t>();
      about.length = from.number<std::uint64_t>();
      attachments.push_back(about);
    } else if (record.op == Op::metadata_index) {
      MetadataIndex about;
      about.offset = from.number<std::uint64_t>();
      about.length = from.number<std::uint64_t>();
      metadata.push_back(about);
    }
    if (!from.ok()) return false;
  }
  const auto content_of = [&](const auto& about, Op op) -> std::span<const std::byte> {
    if (about.length < kRecordHeadBytes || about.offset > start ||
        about.length > start - about.offset) {
      return {};
    }
    const auto record = read(about.offset, about.length);
    if (!record) return {};
    const RecordHead found = head_of(*record);
    if (found.op != op || found.length != about.length - kRecordHeadBytes) return {};
    return record->subspan(kRecordHeadBytes);
  };
  for (const MetadataIndex& about : metadata) {
    add_metadata(about, content_of(about, Op::metadata));
  }
  std::optional<std::map<std::uint64_t, std::vector<Part>>> parts;
  for (const AttachmentIndex& about : attachments) {
    const auto content = content_of(about, Op::attachment);
    add_attachment(about, content);
    const std::optional<Attachment> attachment = decode_attachment(content);
    if (attachment && attachment->about.name == kIndexName) parts = decode_index(attachment->data);
  }

  // Each chunk must have what the index says, in the order of tids: what is read relies on it.
  bool is_good = parts && parts->size() == chunks.size();
  std::uint64_t last_end = data_start_;
  std::map<std::uint16_t, Tid> last_tids;
  for (auto chunk = chunks.begin(); is_good && chunk != chunks.end(); ++chunk) {
    const ChunkIndex& index = chunk->second;
    const auto found = parts->find(index.offset);
    is_good = found != parts->end() && index.offset >= last_end && index.offset <= start &&
              index.length <= start - index.offset && !found->second.empty();
    if (!is_good) break;
    last_end = index.offset + index.length;
    for (const Part& part : found->second) {
      const auto channel = channels_.find(part.channel);
      const Tid last = last_tids.try_emplace(part.channel, kNoTid).first->second;
      is_good = is_good && channel != channels_.end() && channel->second.stream &&
                part.samples > 0 && part.first_tid > last && part.last_tid >= part.first_tid &&
                part.min_time_ns <= part.max_time_ns;
      last_tids[part.channel] = part.last_tid;
    }
    summary_.chunks.push_back({index, std::move(found->second)});
  }
  for (const auto& [id, channel] : channels_) is_good = is_good && channel.stream;
  if (!is_good) {
    summary_ = {};
    summary_.has_index = is_ours_;
    channels_.clear();
    warnings_.clear();
  }
  return is_good;
}

// --- from begin to end

void FileReader::scan() {
  std::uint64_t offset = data_start_;
  std::uint64_t bare_start = 0, bare_bytes = 0;  // message records outside of chunks
  const auto add_bare = [&] {
    if (bare_bytes > 0) add_bare_messages(bare_start, bare_bytes);
    bare_bytes = 0;
  };
  while (bytes_ - offset >= kRecordHeadBytes) {
    const auto bytes = read(offset, kRecordHeadBytes);
    if (!bytes) return warn(bytes.error().message);
    const RecordHead head = head_of(*bytes);
    const std::uint64_t start = offset + kRecordHeadBytes;
    const bool is_data = head.op != Op::data_end && head.op != Op::footer && head.op != Op{};
    if (!is_data || head.length > bytes_ - start) break;
    if (head.op == Op::message) {
      if (bare_bytes == 0) bare_start = offset;
      bare_bytes += kRecordHeadBytes + head.length;
      if (bare_bytes >= kMaxBareBytes) add_bare();
    } else {
      add_bare();
      // What is larger can only be an attachment of another program.
      if (head.length <= kMaxChunkBytes + kWindowBytes) {
        const auto record = read(offset, kRecordHeadBytes + head.length);
        if (!record) return warn(record.error().message);
        scan_record(head.op, offset, record->subspan(kRecordHeadBytes));
      } else {
        warn(fmt::format("the record at byte {} has {} bytes, which is too long: it is left out",
                         offset, head.length));
      }
    }
    offset = start + head.length;
    // The index of a file that was cut after it is written again.
    const bool is_index = head.op == Op::attachment && !summary_.attachments.empty() &&
                          summary_.attachments.back().name == kIndexName;
    if (is_index) {
      summary_.attachments.pop_back();
      break;
    }
    data_end_ = offset;
  }
  add_bare();
  if (!is_whole_) {
    const std::uint64_t rest = bytes_ - data_end_;
    warn(fmt::format("it has no end: it is still being written, or was cut off{}",
                     rest == 0
                         ? ""
                         : fmt::format("; the last {} left out, after the last whole record",
                                       rest == 1 ? "byte is" : fmt::format("{} bytes are", rest))));
  }
}

void FileReader::scan_record(Op op, std::uint64_t offset, std::span<const std::byte> content) {
  const std::uint64_t length = kRecordHeadBytes + content.size();
  if (op == Op::schema) {
    const std::optional<Schema> schema = decode_schema(content);
    if (schema &&
        std::ranges::find(summary_.schemas, schema->id, &Schema::id) == summary_.schemas.end()) {
      summary_.schemas.push_back(*schema);
    }
  } else if (op == Op::channel) {
    std::optional<Channel> channel = decode_channel(content);
    if (channel) add_channel(*std::move(channel));
  } else if (op == Op::chunk) {
    Decoder from(content);
    const std::optional<ChunkHead> head = decode_chunk_head(from);
    if (!head) return warn(fmt::format("the chunk at byte {} is damaged", offset));
    IndexedChunk chunk;
    chunk.index.start_time = head->start_time;
    chunk.index.end_time = head->end_time;
    chunk.index.offset = offset;
    chunk.index.length = length;
    chunk.index.compression = head->compression;
    chunk.index.compressed_bytes = head->compressed_bytes;
    chunk.index.uncompressed_bytes = head->uncompressed_bytes;
    add_chunk(std::move(chunk));
  } else if (op == Op::message_index && !summary_.chunks.empty()) {
    ChunkIndex& index = summary_.chunks.back().index;
    if (index.offset + index.length + index.index_length != offset || content.size() < 2) return;
    index.index_offsets.emplace_back(Decoder(content).number<std::uint16_t>(), offset);
    index.index_length += length;
  } else if (op == Op::attachment) {
    add_attachment({offset, length, 0, 0, 0, {}, {}}, content);
  } else if (op == Op::metadata) {
    add_metadata({offset, length, {}}, content);
  }
}

void FileReader::add_chunk(IndexedChunk chunk) {
  LoadedChunk loaded;
  if (Result<void> data = load_data(chunk, loaded.data); !data) return warn(data.error().message);
  decode_messages(loaded, nullptr);
  for (auto& [channel, messages] : loaded.channels) chunk.parts.push_back(messages.part);
  if (chunk.parts.empty()) return;  // nothing for us
  summary_.chunks.push_back(std::move(chunk));
}

void FileReader::add_bare_messages(std::uint64_t offset, std::uint64_t length) {
  IndexedChunk chunk;
  chunk.is_bare = true;
  chunk.index.offset = offset;
  chunk.index.length = chunk.index.uncompressed_bytes = chunk.index.compressed_bytes = length;
  chunk.index.start_time = UINT64_MAX;
  add_chunk(std::move(chunk));
}

void FileReader::add_channel(Channel channel) {
  const auto [at, is_new] = channels_.try_emplace(channel.id);
  FileChannel& known = at->second;
  if (!is_new) {
    if (known.channel != channel) warn(fmt::format("channel {} is there twice", channel.id));
    return;
  }
  Result<std::optional<RecordedStream>> stream = stream_of(channel);
  if (stream) {
    known.stream = *std::move(stream);
  } else {
    warn(stream.error().message);
    known.is_left_out = true;
  }
  if (const auto id = StreamId::parse(channel.topic); !known.stream && !known.is_left_out && !id) {
    warn(fmt::format("channel {} is left out: {}", channel.id, id.error().message));
    known.is_left_out = true;
  }
  known.channel = channel;
  summary_.channels.push_back(std::move(channel));
}

void FileReader::add_attachment(const AttachmentIndex& about, std::span<const std::byte> content) {
  const std::optional<Attachment> attachment = decode_attachment(content);
  if (!attachment) return warn(fmt::format("the attachment at byte {} is damaged", about.offset));
  summary_.attachments.push_back(attachment->about);
  summary_.attachments.back().offset = about.offset;
  summary_.attachments.back().length = about.length;
  if (!attachment->about.name.starts_with(kPropertyName)) return;
  const std::uint64_t log_time = attachment->about.log_time;
  const Time from = log_time == 0           ? Time::min()
                    : log_time >= INT64_MAX ? Time::max()
                                            : time_from_ns(static_cast<std::int64_t>(log_time));
  const auto offset = static_cast<std::uint64_t>(attachment->data.data() - content.data());
  for (auto& [id, channel] : channels_) {
    if (!channel.stream || property_name(channel.channel) != attachment->about.name) continue;
    std::vector<std::byte>& last = channel.stream->property;
    if (std::ranges::equal(last, attachment->data)) continue;
    last.assign(attachment->data.begin(), attachment->data.end());
    add_property(channel.properties,
                 {from, about.offset + kRecordHeadBytes + offset, last.size(), 0});
  }
}

Result<std::vector<std::byte>> FileReader::property(const PropertyPlace& place) {
  const auto bytes = DSSM_TRY(read(place.offset, place.bytes));
  return std::vector<std::byte>(bytes.begin(), bytes.end());
}

void FileReader::add_metadata(const MetadataIndex& about, std::span<const std::byte> content) {
  Decoder from(content);
  const std::string_view name = from.text();
  const std::map<std::string, std::string> entries = from.map();
  if (!from.ok()) return warn(fmt::format("the metadata at byte {} is damaged", about.offset));
  summary_.metadata.push_back({about.offset, about.length, std::string(name)});
  const auto entry = [&](const char* key) {
    const auto found = entries.find(key);
    return found == entries.end() ? std::string_view() : std::string_view(found->second);
  };
  if (name == kRecordingName) {
    recording_ = entry("recording");
    const std::string_view number = entry("file");
    (void)std::from_chars(number.data(), number.data() + number.size(), number_);
  } else if (name == kTriggerName) {
    std::int64_t time_ns = 0;
    const std::string_view time = entry("time_ns");
    (void)std::from_chars(time.data(), time.data() + time.size(), time_ns);
    triggers_.push_back({std::string(entry("name")), std::string(entry("reason")),
                         std::string(entry("host")), time_from_ns(time_ns)});
  } else if (name == kGapName) {
    std::vector<RecordedGap> gaps;
    for (std::string_view rest = entry("gaps"); !rest.empty();) {
      const std::size_t plus = rest.find('+');
      if (plus == rest.npos) break;
      RecordedGap gap;
      const auto first = std::from_chars(rest.data(), rest.data() + plus, gap.first);
      const auto [end, error] =
          std::from_chars(rest.data() + plus + 1, rest.data() + rest.size(), gap.count);
      if (first.ec != std::errc() || error != std::errc() || gap.first < 0 ||
          gap.count > static_cast<std::uint64_t>(INT64_MAX - gap.first)) {
        break;
      }
      gaps.push_back(gap);
      rest.remove_prefix(
          std::min<std::size_t>(static_cast<std::size_t>(end - rest.data()) + 1, rest.size()));
    }
    for (auto& [id, channel] : channels_) {
      const auto incarnation = channel.channel.metadata.find("incarnation");
      if (channel.channel.topic == entry("topic") && channel.stream &&
          incarnation != channel.channel.metadata.end() &&
          incarnation->second == entry("incarnation")) {
        channel.gaps.insert(channel.gaps.end(), gaps.begin(), gaps.end());
      }
    }
  }
}

// --- chunks

Result<void> FileReader::load_data(const IndexedChunk& chunk, Buffer& out) {
  const ChunkIndex& index = chunk.index;
  const auto damaged = [&](std::string_view what) {
    return Error{Errc::protocol, fmt::format("the chunk at byte {} is damaged ({}): its samples "
                                             "are left out",
                                             index.offset, what)};
  };
  if (index.length > kMaxChunkBytes + kWindowBytes) return damaged("too long");
  const auto record = DSSM_TRY(read(index.offset, index.length));
  if (chunk.is_bare) return decompress("", record, record.size(), out);
  if (record.size() < kRecordHeadBytes || head_of(record).op != Op::chunk) {
    return damaged("it is not a chunk");
  }
  Decoder from(record.subspan(kRecordHeadBytes));
  const std::optional<ChunkHead> head = decode_chunk_head(from);
  if (!head) return damaged("its head");
  if (head->uncompressed_bytes > kMaxChunkBytes) {
    return damaged(fmt::format("it claims to have {} bytes; at most {} are possible",
                               head->uncompressed_bytes, kMaxChunkBytes));
  }
  Result<void> data = decompress(head->compression, from.rest().first(head->compressed_bytes),
                                 head->uncompressed_bytes, out);
  if (!data) return damaged(data.error().message);
  if (head->crc != 0 && crc32(out.span()) != head->crc) return damaged("its CRC is wrong");
  return {};
}

// Those of unknown channels, those that are no samples, and those whose tids do not rise are left
// out.
//   announced  what the chunk had when the file was opened; null: that is now
void FileReader::decode_messages(LoadedChunk& chunk, const IndexedChunk* announced) {
  std::uint64_t left_out = 0;
  for (std::span<const std::byte> rest = chunk.data.span(); rest.size() >= kRecordHeadBytes;) {
    const RecordHead head = head_of(rest);
    rest = rest.subspan(kRecordHeadBytes);
    if (head.length > rest.size()) {
      ++left_out;
      break;
    }
    const auto content = rest.first(head.length);
    rest = rest.subspan(head.length);
    if (announced == nullptr && (head.op == Op::channel || head.op == Op::schema)) {
      scan_record(head.op, 0, content);
    }
    if (head.op != Op::message) continue;
    Decoder from(content);
    const auto id = from.number<std::uint16_t>();
    const auto sequence = from.number<std::uint32_t>();
    const auto log_time = from.number<std::uint64_t>();
    (void)from.number<std::uint64_t>();  // publish_time
    const auto channel = channels_.find(id);
    if (!from.ok() || channel == channels_.end()) {
      ++left_out;
      continue;
    }
    FileChannel& about = channel->second;
    if (about.is_left_out) continue;
    const auto [at, is_new] = chunk.channels.try_emplace(id);
    LoadedChunk::ChannelMessages& messages = at->second;
    if (is_new) {
      messages.part.channel = id;
      if (announced != nullptr) {
        const auto part = std::ranges::find(announced->parts, id, &Part::channel);
        messages.part.last_tid = part == announced->parts.end() ? INT64_MAX : part->first_tid - 1;
      } else {
        messages.part.last_tid =
            about.stream ? about.last_tid : static_cast<Tid>(about.messages) - 1;
      }
    }
    MessageSample sample;
    if (about.stream) {
      const auto decoded = decode_message(about.stream->type, sequence, log_time, from.rest());
      if (!decoded || decoded->info.tid <= messages.part.last_tid) {
        ++left_out;
        continue;
      }
      sample = *decoded;
    } else {
      if (log_time > INT64_MAX || messages.part.last_tid == INT64_MAX) {
        ++left_out;
        continue;
      }
      sample.info.tid = messages.part.last_tid + 1;
      sample.info.time = time_from_ns(static_cast<std::int64_t>(log_time));
      sample.info.payload_bytes = from.rest().size();
      about.max_bytes = std::max<std::uint64_t>(about.max_bytes, from.rest().size());
    }
    const auto offset = static_cast<std::uint64_t>(from.rest().data() - chunk.data.data());
    Message message;
    message.tid = sample.info.tid;
    message.time_ns = to_ns(sample.info.time);
    message.clock_error_ns = to_ns(sample.info.clock_error);
    message.clock_bound_ns = to_ns(sample.clock_error);
    message.offset = static_cast<std::uint32_t>(offset + sample.payload_offset);
    message.payload_bytes = static_cast<std::uint32_t>(sample.info.payload_bytes);
    message.channel = id;
    if (!messages.messages.empty() &&
        message.time_ns < chunk.messages[messages.messages.back()].time_ns) {
      messages.is_sorted = false;
    }
    messages.messages.push_back(static_cast<std::uint32_t>(chunk.messages.size()));
    messages.part.add(message.info());
    chunk.messages.push_back(message);
    if (announced == nullptr) {
      about.last_tid = message.tid;
      ++about.messages;
    }
  }
  std::erase_if(chunk.channels, [](const auto& entry) { return entry.second.messages.empty(); });
  if (left_out > 0 && announced == nullptr) {
    warn(
        fmt::format("{} messages that are no samples of the streams in it are left out", left_out));
  }
}

Result<std::shared_ptr<const LoadedChunk>> FileReader::load(const IndexedChunk& chunk) {
  const auto loaded = std::make_shared<LoadedChunk>();
  DSSM_TRY(load_data(chunk, loaded->data), fmt::format("'{}'", path_.string()));
  log_ ? decode_records(*loaded, chunk) : decode_messages(*loaded, &chunk);
  const bool is_as_announced =
      loaded->channels.size() == chunk.parts.size() &&
      std::ranges::all_of(chunk.parts, [&](const Part& part) {
        const auto found = loaded->channels.find(part.channel);
        return found != loaded->channels.end() && found->second.part == part;
      });
  if (!is_as_announced) {
    return Error{Errc::protocol,
                 fmt::format("'{}': the chunk at byte {} has other samples than the file's index "
                             "says: they are left out",
                             path_.string(), chunk.index.offset)};
  }
  return std::shared_ptr<const LoadedChunk>(loaded);
}

// --- repair

// Where the file was cut within the message indexes of its last chunk, appends them to `out`, which
// comes after the chunk.
void FileReader::rebuild_message_indexes(Buffer& out) {
  if (summary_.chunks.empty() || summary_.chunks.back().is_bare) return;
  IndexedChunk& last = summary_.chunks.back();
  ChunkIndex& index = last.index;
  const std::uint64_t end = index.offset + index.length;
  Buffer data;
  if (end + index.index_length != data_end_ || !load_data(last, data)) return;
  std::map<std::uint16_t, Buffer> entries;
  Decoder from(data.span());
  while (from.rest().size() >= kRecordHeadBytes) {
    const std::uint64_t offset = data.size() - from.rest().size();
    const RecordHead head = head_of(from.take(kRecordHeadBytes));
    Decoder content(from.take(head.length));
    if (head.op != Op::message) continue;
    const auto channel = content.number<std::uint16_t>();
    (void)content.number<std::uint32_t>();
    const auto log_time = content.number<std::uint64_t>();
    if (content.ok()) put(put(entries[channel].grow(16), log_time), offset);
  }
  if (entries.size() == index.index_offsets.size()) return;
  index.index_offsets.clear();
  for (const auto& [channel, entry] : entries) {
    index.index_offsets.emplace_back(channel, end + out.size());
    Encoder record(out);
    record.begin(Op::message_index).number(channel);
    record.number(static_cast<std::uint32_t>(entry.size()));
    out.append(entry.span());
    record.end();
  }
  index.index_length = out.size();
  data_end_ = end;
}

Result<RecordingRepair> FileReader::repair() {
  RecordingRepair report;
  report.was_whole = is_whole_;
  report.samples = summary_.samples();
  const std::string what = fmt::format("repair recording '{}'", path_.string());
  if (log_) {
    return Error{Errc::invalid_argument,
                 fmt::format("{}: it is a log of SSM, which needs no repair: a part of a record at "
                             "its end does not count",
                             what)};
  }
  if (is_whole_) return report;
  if (data_start_ == 0) {
    return Error{Errc::protocol, fmt::format("{}: it is empty; delete it", what)};
  }
  // Whose writer may still be at work, and of whose channels some may be unknown here.
  if (!is_ours_) {
    return Error{Errc::invalid_argument,
                 fmt::format("{}: another program's; `mcap recover` repairs it", what)};
  }
  Buffer out;
  rebuild_message_indexes(out);
  encode_end(out, summary_, data_end_);
  report.removed_bytes = bytes_ - std::min(bytes_, data_end_);
  if (::ftruncate(fd_.get(), static_cast<off_t>(data_end_)) != 0) return os_error(what);
  for (std::uint64_t done = 0; done < out.size();) {
    const ssize_t written = ::pwrite(fd_.get(), out.data() + done, out.size() - done,
                                     static_cast<off_t>(data_end_ + done));
    if (written < 0 && errno == EINTR) continue;
    if (written <= 0) {
      Error failed = os_error(what, written < 0 ? errno : EIO);
      failed.message += "; the file has no end as before. Free space on that disk, and try again";
      (void)!::ftruncate(fd_.get(), static_cast<off_t>(data_end_));
      return failed;
    }
    done += static_cast<std::uint64_t>(written);
  }
  if (::fsync(fd_.get()) != 0) return os_error(what);
  return report;
}

}  // namespace dssm::recording
