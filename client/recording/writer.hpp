// SPDX-License-Identifier: Apache-2.0
//
// A recording that is being written. The program's thread encodes samples into the open chunk. A
// second thread takes chunks that are full or old, compresses them, writes them, and begins and
// deletes files. A third one syncs each second, which may take long.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <deque>
#include <dssm/recording.hpp>
#include <filesystem>
#include <map>
#include <memory>
#include <mutex>
#include <optional>
#include <set>
#include <string>
#include <thread>
#include <vector>

#include "client/recording/compression.hpp"
#include "client/recording/file_writer.hpp"

namespace dssm::recording {

class Writer {
 public:
  static Result<std::unique_ptr<Writer>> create(const std::filesystem::path& file,
                                                const RecordingOptions& options);
  Writer(const Writer&) = delete;
  Writer& operator=(const Writer&) = delete;
  ~Writer();

  // As in RecordingWriter.
  Result<std::uint32_t> add_stream(const RecordedStream& stream);
  Result<void> write(std::uint32_t stream, const SampleInfo& info, Duration clock_error,
                     std::span<const std::byte> payload);
  Result<void> add_gap(std::uint32_t stream, Tid first, std::uint64_t count);
  Result<void> set_property(std::uint32_t stream, std::span<const std::byte> property,
                            std::optional<Time> from);
  Result<void> add_trigger(const RecordedTrigger& trigger);
  bool has_fields(std::uint32_t stream) const;
  RecordingProgress progress() const;
  Result<void> finish();

 private:
  struct Stream {
    StreamId id;
    TypeInfo type;
    std::uint64_t incarnation = 0;
    Tid last = kNoTid;
    Time last_time{};         // of sample `last`
    std::uint64_t chunk = 0;  // number of the chunk in which `part` is its part
    std::size_t part = 0;
  };
  // What the disk's thread knows of a stream, to repeat it in the next file.
  struct DiskStream {
    NewChannel channel;
    NewProperty property;
    bool replaced = false;  // by a later incarnation
  };

  Writer(const std::filesystem::path& file, const RecordingOptions& options, std::string recording,
         FileWriter first);

  // --- with mutex_ held
  // The reason why nothing more is written, if there is one.
  Result<void> check() const;
  Result<void> check(std::uint32_t stream) const;
  void take_open_chunk();
  void close_chunk(std::unique_lock<std::mutex>& lock);
  void begin_chunk();
  // Begins a chunk that begins a file, in which described_ hold.
  void begin_described_file();
  const Schema& schema_for(const TypeInfo& type);
  Chunk::IndexedPart& part_of(std::uint32_t stream);

  // --- of the disk's thread
  void run_disk();
  Result<void> store(const Chunk& chunk);
  Result<void> begin_file();
  Result<void> repeat(const DiskStream& stream);
  Result<void> finish_file();
  void delete_oldest();
  void fail(Error error);
  bool is_file_full(const Chunk& chunk) const;

  void run_sync();

  const std::filesystem::path file_;
  const RecordingOptions options_;
  const std::string recording_;  // its id

  mutable std::mutex mutex_;
  std::condition_variable disk_, caller_, sync_;
  std::vector<Stream> streams_;
  std::map<std::pair<std::string, std::uint64_t>, std::uint32_t> numbers_;  // topic, incarnation
  std::map<std::pair<std::string, std::string>, Schema> schemas_;           // by name and text
  std::set<std::string> schema_names_;
  std::map<std::uint32_t, TypeInfo> described_;  // of streams_, from the next file on
  std::unique_ptr<Chunk> open_;
  std::uint64_t chunk_number_ = 1;
  MonoTime open_since_{};                       // of the first thing in open_
  std::deque<std::unique_ptr<Chunk>> waiting_;  // for the disk
  std::uint64_t waiting_bytes_ = 0;             // of waiting_ and the one that is being written
  std::vector<std::unique_ptr<Chunk>> spare_;
  RecordingProgress progress_;
  bool stop_ = false;
  bool finished_ = false;
  bool stored_all_ = false;  // the disk's thread has ended
  std::optional<Error> error_;
  std::shared_ptr<const UniqueFd> to_sync_;  // what was written since the last sync; null: nothing
  std::optional<Error> sync_error_;

  // --- of the disk's thread
  Compressor compressor_;
  FileWriter current_;
  std::uint32_t file_number_ = 0;  // in its name
  std::vector<DiskStream> disk_streams_;
  bool is_ending_file_ = false;  // a chunk with begins_file is to come
  std::deque<std::pair<std::filesystem::path, std::uint64_t>> finished_files_;
  std::uint64_t written_bytes_ = 0;  // to all files but the current one
  std::uint64_t written_samples_ = 0, written_payload_bytes_ = 0;  // the same
  std::uint32_t files_ = 1;                                        // begun
  std::int64_t file_start_ns_ = INT64_MAX;  // least time of a sample in the current file

  std::thread disk_thread_, sync_thread_;
};

}  // namespace dssm::recording
