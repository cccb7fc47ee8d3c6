// SPDX-License-Identifier: Apache-2.0
//
// Recordings: streams in files that MCAP tools read, too (https://mcap.dev). docs/recording.md
// describes what is in them beyond MCAP, and has examples. Link with libdssm-recording
// (pkg-config dssm-recording) besides libdssm. No dssmd is needed.
//
//   errors  invalid_argument (wrong use, or an option), not_found (no such file or stream),
//           protocol (a file that is damaged or is not a recording), conflict (the file exists, or
//           two files hold the same samples), and those of the operating system: no_memory (also a
//           full disk), no_permission, system
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/reader.hpp>
#include <filesystem>
#include <memory>
#include <span>
#include <vector>

namespace dssm::recording {
class Writer;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// Of the chunks of a file. A chunk that does not get smaller is stored as it is.
enum class Compression : std::uint8_t { none, lz4, zstd };

// What a recording holds of a stream besides its samples.
struct RecordedStream {
  StreamId id;  // with its owner's host
  TypeInfo type;
  std::uint64_t depth = 0;
  Duration cycle{};
  std::uint64_t incarnation = 0;    // a stream that restarts is added again, with another one
  std::vector<std::byte> property;  // empty: none
};

struct RecordingOptions {
  Compression compression = Compression::lz4;
  // A chunk is closed, compressed and written at this size or age, whichever is first. A larger
  // sample has a chunk of its own. 1 to kMaxPayloadBytes.
  std::uint64_t chunk_bytes = 1U << 20;
  Duration chunk_age = std::chrono::seconds(1);
  // Of chunks that wait for the disk. With more, write() waits.
  std::uint64_t queue_bytes = 64U << 20;
  // A file that has so many bytes, or holds samples of so long a time, is followed by another one:
  // NAME.mcap, NAME_1.mcap, NAME_2.mcap ... A file may become longer than this by one chunk and its
  // summary. 0: one file.
  std::uint64_t max_file_bytes = 0;
  Duration max_file_duration{};
  // Of all files of this recording: the oldest ones are deleted when there are more. Without
  // max_file_bytes, a file then has an eighth of this. 0: no limit.
  std::uint64_t max_total_bytes = 0;
};

struct RecordingProgress {
  std::uint64_t samples = 0;
  std::uint64_t payload_bytes = 0;
  std::uint64_t lost_samples = 0;   // of add_gap()
  std::uint64_t file_bytes = 0;     // written to all files, also to those that are deleted
  std::uint32_t files = 0;          // begun
  std::uint64_t waiting_bytes = 0;  // of samples that are not yet in a file
};

// Writes a recording. What was written is on the disk at most about two seconds later (chunk_age,
// and an fdatasync() each second), and a file that is not finished opens all the same.
//
//   threads  one at a time; threads of its own compress, write and sync
//   moved    a moved-from writer may only be assigned to or destroyed
class RecordingWriter {
 public:
  // `file` must not exist; its folder must. The name usually ends with ".mcap".
  //   fails  conflict (a file of that name exists), invalid_argument (an option), not_found (no
  //          such folder), no_permission, no_memory, system
  static Result<RecordingWriter> create(const std::filesystem::path& file,
                                        const RecordingOptions& options = {});
  RecordingWriter(RecordingWriter&&) noexcept;
  RecordingWriter& operator=(RecordingWriter&&) noexcept;
  // Does what finish() does, if it was not called; its error is lost.
  ~RecordingWriter();

  // The number of the stream in this recording, for the other calls. The same stream (id and
  // incarnation) again: the same number; what else `stream` has is ignored then.
  //   fails  invalid_argument (no host, or a name or type that is not allowed), limit_exceeded
  //          (more than 65,535 streams), and as write()
  Result<std::uint32_t> add_stream(const RecordedStream& stream);

  // Adds a sample, with the tid, time and clock error of `info`.
  //   stream       of add_stream()
  //   clock_error  bound on the distance of info.time from the recording PC's clock
  //                (RawReader::clock_error())
  //   payload      info.payload_bytes long, at most those of the stream's type
  //   fails        invalid_argument (no such stream, a payload of another length, or a tid that is
  //                not greater than the stream's last one). no_memory (a full disk) or system once
  //                the file could not be written: what was written before is a whole file, and
  //                nothing more is written
  Result<void> write(std::uint32_t stream, const SampleInfo& info, Duration clock_error,
                     std::span<const std::byte> payload);

  // Samples first .. first + count - 1 could not be kept.
  //   fails  as write()
  Result<void> add_gap(std::uint32_t stream, Tid first, std::uint64_t count);

  // From here on the stream has that property (empty: none).
  //   fails  as write()
  Result<void> set_property(std::uint32_t stream, std::span<const std::byte> property);

  RecordingProgress progress() const;

  // Everything to the disk, summary and footer. Only progress() may be called afterwards.
  //   fails  as write(), also for what was written before and failed later
  Result<void> finish();

 private:
  explicit RecordingWriter(std::unique_ptr<recording::Writer> writer) noexcept;
  std::unique_ptr<recording::Writer> writer_;
};

}  // namespace dssm
#pragma GCC visibility pop
