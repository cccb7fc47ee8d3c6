// SPDX-License-Identifier: Apache-2.0
//
// One MCAP file, or a log of SSM (ssm_log_reader.cpp), that is read: what is in it, and its chunks.
// A whole file of ours is opened by its
// summary and the attachment "dssm.index"; all others are read from begin to end, up to the first
// record that is not whole. Nothing in a file is trusted: lengths are checked against the file's,
// chunks are decompressed up to kMaxChunkBytes, and each must have the CRC and the samples that
// were announced.
//
//   threads  one at a time
#pragma once

#include <cstdint>
#include <dssm/recording.hpp>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "client/recording/file_writer.hpp"
#include "client/recording/records.hpp"
#include "core/base/ssm_log.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::recording {

// The largest sample, and some bytes around it. Other programs' chunks have a few MiB.
inline constexpr std::uint64_t kMaxChunkBytes = kMaxPayloadBytes + (8U << 20);

// A sample in a chunk.
struct Message {
  Tid tid = kNoTid;
  std::int64_t time_ns = 0;
  std::int64_t clock_error_ns = 0;
  std::int64_t clock_bound_ns = 0;  // against the recording PC's clock
  std::uint32_t offset = 0;         // of the payload, in the chunk
  std::uint32_t payload_bytes = 0;
  std::uint16_t channel = 0;

  SampleInfo info() const noexcept {
    return {tid, time_from_ns(time_ns), Duration(clock_error_ns), payload_bytes};
  }
};

// A chunk in memory.
struct LoadedChunk {
  struct ChannelMessages {
    Part part;
    std::vector<std::uint32_t> messages;  // indexes into `messages`; tids rise
    bool is_sorted = true;                // the times do not run backwards
  };
  Buffer data;
  std::vector<Message> messages;  // in the order of recording
  std::map<std::uint16_t, ChannelMessages> channels;

  std::uint64_t bytes() const noexcept {
    return data.size() + messages.size() * (sizeof(Message) + sizeof(std::uint32_t));
  }
  std::span<const std::byte> payload(const Message& message) const noexcept {
    return data.span().subspan(message.offset, message.payload_bytes);
  }
};

// A property of a stream, in a file.
struct PropertyPlace {
  Time from{};                          // Time::min(): from the beginning on
  std::uint64_t offset = 0, bytes = 0;  // of the bytes themselves
  std::uint32_t file = 0;               // in a recording of several
};
// Appends one. Those before it that no time has are removed.
void add_property(std::vector<PropertyPlace>& properties, const PropertyPlace& added);

// A channel in a file.
struct FileChannel {
  Channel channel;
  std::optional<RecordedStream> stream;  // with its last property; nullopt: of another program
  std::vector<PropertyPlace> properties;
  bool is_left_out = false;       // no stream can be made of it
  std::vector<RecordedGap> gaps;  // of a log: records that are left out
  std::uint64_t max_bytes = 0;    // of a message, of another program's channel
  std::uint64_t messages = 0;     // of another program's channel: they are counted
  Tid last_tid = kNoTid;          // of our channel
};

class FileReader {
 public:
  //   for_repair  no other process may be writing the file
  //   fails       not_found, protocol (no MCAP file), no_permission, system, unavailable (it is
  //               being written)
  static Result<std::unique_ptr<FileReader>> open(const std::filesystem::path& path,
                                                  bool for_repair = false);

  const std::filesystem::path& path() const noexcept { return path_; }
  const std::string& recording() const noexcept { return recording_; }  // its id; empty: none
  std::uint32_t number() const noexcept { return number_; }             // of the file in it
  bool is_whole() const noexcept { return is_whole_; }                  // it has its end
  std::map<std::uint16_t, FileChannel>& channels() noexcept { return channels_; }
  std::vector<IndexedChunk>& chunks() noexcept { return summary_.chunks; }
  const std::vector<RecordedTrigger>& triggers() const noexcept { return triggers_; }
  std::vector<std::string>& warnings() noexcept { return warnings_; }

  // Reads a chunk of chunks().
  //   fails  protocol (damaged, or not what was announced), system, no_memory
  Result<std::shared_ptr<const LoadedChunk>> load(const IndexedChunk& chunk);

  // The bytes of a property in this file.
  //   fails  protocol (the file became shorter), system
  Result<std::vector<std::byte>> property(const PropertyPlace& place);

  // Writes the end that the file does not have, in place.
  Result<RecordingRepair> repair();

 private:
  FileReader() = default;
  Result<void> begin();
  Result<void> begin_log(std::string_view begin);
  void scan_log();
  void decode_records(LoadedChunk& chunk, const IndexedChunk& about) const;
  bool open_by_summary();
  void scan();
  void scan_record(Op op, std::uint64_t offset, std::span<const std::byte> content);
  void add_chunk(IndexedChunk chunk);
  void add_bare_messages(std::uint64_t offset, std::uint64_t length);
  void add_channel(Channel channel);
  void add_attachment(const AttachmentIndex& about, std::span<const std::byte> content);
  void add_metadata(const MetadataIndex& about, std::span<const std::byte> content);
  void decode_messages(LoadedChunk& chunk, const IndexedChunk* announced);
  Result<void> load_data(const IndexedChunk& chunk, Buffer& out);
  void rebuild_message_indexes(Buffer& out);
  void warn(std::string_view what);

  // Valid until the next call.
  Result<std::span<const std::byte>> read(std::uint64_t offset, std::uint64_t bytes);

  std::filesystem::path path_;
  UniqueFd fd_;
  std::uint64_t bytes_ = 0;
  std::uint64_t data_start_ = 0;  // after the header
  std::uint64_t data_end_ = 0;    // after the last whole record of the data
  bool is_whole_ = false;
  bool is_ours_ = false;           // by its profile
  std::optional<SsmLogHead> log_;  // of a log of SSM
  std::string recording_;
  std::uint32_t number_ = 0;
  Summary summary_;
  std::map<std::uint16_t, FileChannel> channels_;
  std::vector<RecordedTrigger> triggers_;
  std::vector<std::string> warnings_;
  Buffer window_;  // what read() read last
  std::uint64_t window_offset_ = 0;
};

}  // namespace dssm::recording
