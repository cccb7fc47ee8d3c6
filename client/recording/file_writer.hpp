// SPDX-License-Identifier: Apache-2.0
//
// One file of a recording: records at its end, and at last the summary, which it collects. After
// each call the file ends with a whole record.
//
//   Magic, Header, Metadata "dssm.recording"
//   for each chunk: new Schemas, Channels and properties (Attachments); Chunk; its MessageIndexes;
//     Metadata "dssm.gap" and "dssm.trigger"
//   Attachment "dssm.index", DataEnd, summary, Footer, Magic
//
//   threads  one at a time; fd() may be synced by another one
#pragma once

#include <cstdint>
#include <dssm/recording.hpp>
#include <filesystem>
#include <map>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "client/recording/compression.hpp"
#include "client/recording/records.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::recording {

inline constexpr std::string_view kProfile = "dssm";
inline constexpr std::string_view kRecordingName = "dssm.recording";  // a metadata record
inline constexpr std::string_view kGapName = "dssm.gap";              // metadata records
inline constexpr std::string_view kTriggerName = "dssm.trigger";      // metadata records
inline constexpr std::string_view kIndexName = "dssm.index";          // an attachment
inline constexpr std::string_view kPropertyName = "dssm.property";    // attachments, with more
inline constexpr std::string_view kIndexMediaType = "application/x-dssm-index";
inline constexpr std::string_view kPropertyMediaType = "application/octet-stream";

// The samples of one channel in one chunk.
struct Part {
  std::uint16_t channel = 0;
  std::uint32_t samples = 0;
  Tid first_tid = kNoTid, last_tid = kNoTid;
  std::int64_t min_time_ns = INT64_MAX, max_time_ns = INT64_MIN;
  std::uint64_t payload_bytes = 0;

  friend bool operator==(const Part&, const Part&) = default;
  void add(const SampleInfo& info) noexcept {
    if (samples++ == 0) first_tid = info.tid;
    last_tid = info.tid;
    min_time_ns = std::min(min_time_ns, to_ns(info.time));
    max_time_ns = std::max(max_time_ns, to_ns(info.time));
    payload_bytes += info.payload_bytes;
  }
};

struct IndexedChunk {
  ChunkIndex index;
  std::vector<Part> parts;
  bool is_bare = false;  // another program's message records, which are in no chunk
};

// What the end of a file describes. Gathered while it is written, or by reading all of it.
struct Summary {
  std::vector<Schema> schemas;
  std::vector<Channel> channels;
  std::vector<IndexedChunk> chunks;
  std::vector<AttachmentIndex> attachments;
  std::vector<MetadataIndex> metadata;
  bool has_index = true;  // dssm.index, which only our files have

  std::uint64_t samples() const noexcept;
  std::uint64_t payload_bytes() const noexcept;
};

// The data of the attachment "dssm.index", and back: parts of the chunk at each offset. nullopt: it
// is not such data.
void encode_index(Buffer& out, const std::vector<IndexedChunk>& chunks);
std::optional<std::map<std::uint64_t, std::vector<Part>>> decode_index(
    std::span<const std::byte> data);

// The name of a property's attachment, "dssm.property/INCARNATION/TOPIC", and back.
std::string property_name(const Channel& channel);

// Appends index, DataEnd, summary, footer and magic of a file whose data has `data_bytes` up to
// here.
void encode_end(Buffer& out, const Summary& summary, std::uint64_t data_bytes);

// Samples that could not be kept: of one channel, (first tid, count).
struct Gaps {
  std::uint16_t channel = 0;
  std::vector<std::pair<Tid, std::uint64_t>> gaps;
};

// A channel with its schema, and a property.
struct NewChannel {
  Schema schema;
  Channel channel;
};
// A channel whose type has another description than before.
struct NewDescription {
  std::uint16_t channel = 0;
  Schema schema;
  TypeInfo type;
};
struct NewProperty {
  std::uint16_t channel = 0;
  std::vector<std::byte> property;
  std::uint64_t log_time = 0;  // of the first sample with it; 0: from the beginning on
};

// What one chunk of the file is made from. `messages` are whole message records.
struct Chunk {
  // It is the first one of a file, in which these descriptions hold.
  bool begins_file = false;
  std::vector<NewDescription> descriptions;
  // Come before the messages.
  std::vector<NewChannel> channels;
  std::vector<NewProperty> properties;
  std::uint64_t property_bytes = 0;
  std::vector<Gaps> gaps;
  std::vector<RecordedTrigger> triggers;

  Buffer messages;
  // One for each channel that is in it; the first `used_parts`, the others keep their memory.
  struct IndexedPart {
    Part part;
    Buffer index;  // of the MessageIndex: log_time and offset of each message
  };
  std::vector<IndexedPart> parts;
  std::size_t used_parts = 0;
  std::uint64_t start_time = UINT64_MAX, end_time = 0;  // log times
  std::uint64_t payload_bytes = 0;

  bool is_empty() const noexcept {
    return messages.size() == 0 && channels.empty() && properties.empty() && gaps.empty() &&
           triggers.empty();
  }
  // What it takes in memory, about.
  std::uint64_t bytes() const noexcept { return messages.size() + property_bytes; }
  // Keeps the memory.
  void clear() noexcept;
};

class FileWriter {
 public:
  // Creates the file, which must not exist, and syncs its folder.
  //   recording  hexadecimal id of the recording that the file belongs to
  //   number     of the file in it, from 0 on
  static Result<FileWriter> create(const std::filesystem::path& path, const std::string& recording,
                                   std::uint32_t number);

  bool has_channel(std::uint16_t id) const { return has_channel_[id]; }
  // Of a channel that the file does not have, and of one that it has.
  //   fails  as append()
  Result<void> add_channel(const NewChannel& channel);
  Result<void> add_property(const Channel& channel, const NewProperty& property);

  // Appends the messages, gaps and triggers of `chunk`, whose channels were added.
  //   fails  no_memory (a full disk), system, no_permission. The file is as before then
  Result<void> append(const Chunk& chunk, Compressor& compressor);

  // Appends index and summary. When the disk has no space for them, removes chunks at the end.
  //   fails  as append(), also when is_whole() all the same, with fewer chunks
  Result<void> finish();
  bool is_whole() const noexcept { return whole_; }

  const std::filesystem::path& path() const noexcept { return path_; }
  std::uint64_t bytes() const noexcept { return bytes_; }
  const Summary& summary() const noexcept { return summary_; }
  std::shared_ptr<const UniqueFd> fd() const noexcept { return fd_; }

 private:
  Result<void> write(std::initializer_list<std::span<const std::byte>> parts);
  void drop_last_chunk();

  std::filesystem::path path_;
  std::shared_ptr<const UniqueFd> fd_;
  std::uint64_t bytes_ = 0;  // all whole records
  bool whole_ = false;
  bool disk_full_ = false;  // the last write() failed for that
  Summary summary_;
  std::vector<bool> has_channel_ = std::vector<bool>(UINT16_MAX + 1);  // by id
  std::vector<bool> has_schema_ = std::vector<bool>(UINT16_MAX + 1);
  Buffer head_, compressed_, tail_;
};

}  // namespace dssm::recording
