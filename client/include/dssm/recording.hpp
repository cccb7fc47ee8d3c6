// SPDX-License-Identifier: Apache-2.0
//
// Recordings: streams in files that MCAP tools read, too (https://mcap.dev). docs/recording.md
// describes what is in them beyond MCAP, and has examples. Link with libdssm-recording
// and libdssm (pkg-config dssm-recording; in CMake dssm-recording::dssm-recording and dssm::dssm).
// No dssmd is needed.
//
//   errors  invalid_argument (wrong use, or an option), not_found (no such file or stream),
//           protocol (a file that is damaged or is not a recording), conflict (the file exists, or
//           two files hold the same samples), and those of the operating system: no_memory (also a
//           full disk), no_permission, system
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/reader.hpp>
#include <dssm/typed_reads.hpp>
#include <filesystem>
#include <map>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::recording {
class Writer;
struct Content;
struct CursorState;
struct ReaderState;
}  // namespace dssm::recording

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// Of the chunks of a file. A chunk that does not get smaller is stored as it is.
enum class Compression : std::uint8_t { none, lz4, zstd };

// What a recording holds of a stream besides its samples.
struct RecordedStream {
  StreamId id;  // with its owner's host; without one, that is not known
  TypeInfo type;
  std::uint64_t depth = 0;
  Duration cycle{};
  std::uint64_t incarnation = 0;    // a stream that restarts is added again, with another one
  std::vector<std::byte> property;  // empty: none
  // What else its channel has as metadata, which is kept. Of a log of SSM: "ssm_log", its first
  // line.
  std::map<std::string, std::string> metadata = {};
};

// Why something was recorded: an event for which a recorder waited (docs/recording.md "The black
// box").
struct RecordedTrigger {
  std::string name;    // of the trigger
  std::string reason;  // in a sentence, for people; may be empty
  std::string host;    // where it happened or was requested
  Time time{};

  friend bool operator==(const RecordedTrigger&, const RecordedTrigger&) = default;
};

struct RecordingOptions {
  Compression compression = Compression::lz4;
  // A chunk is closed, compressed and written at this size or age, whichever is first. A larger
  // sample has a chunk of its own. 1 to kMaxPayloadBytes. With max_file_bytes, chunks have at most
  // an eighth of that.
  std::uint64_t chunk_bytes = 1U << 20;
  Duration chunk_age = std::chrono::seconds(1);
  // Of chunks that wait for the disk. With more, write() waits.
  std::uint64_t queue_bytes = 64U << 20;
  // A file that has so many bytes, or holds samples of so long a time, is followed by another one:
  // NAME.mcap, NAME_1.mcap, NAME_2.mcap ... A file may become longer than this by one chunk and its
  // summary. When add_stream() has described a type, what was written before still comes into files
  // without that description, the last of which may also be an eighth larger, and have samples of a
  // longer time, by what waited for the disk. 0: one file.
  std::uint64_t max_file_bytes = 0;
  Duration max_file_duration{};
  // Of all files of this recording: the oldest ones are deleted when there are more. Without
  // max_file_bytes, that is an eighth of this then. 0: no limit.
  std::uint64_t max_total_bytes = 0;
  // For a recording by several writers, one after the other: an id that they share, and how many
  // files the earlier ones have begun (RecordingProgress::files). Recording::open() has their
  // samples in the order in which they were written. Empty: an id of its own.
  std::string recording = {};
  std::uint32_t earlier_files = 0;
};

struct RecordingProgress {
  std::uint64_t samples = 0;
  std::uint64_t payload_bytes = 0;
  std::uint64_t lost_samples = 0;   // of add_gap()
  std::uint64_t file_bytes = 0;     // written to all files, also to those that are deleted
  std::uint32_t files = 0;          // begun, by this writer
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
  // incarnation) again: the same number. A name or fields that its type lacked hold then from the
  // file on that begins after all that was written before; what else `stream` has is ignored.
  //   fails  invalid_argument (a name or type that is not allowed), limit_exceeded
  //          (more than 65,535 streams), and as write()
  Result<std::uint32_t> add_stream(const RecordedStream& stream);

  // Whether a file that has begun, or begins with what waits for the disk, has fields of the
  // stream: those of the first add_stream() or of a later one. No such stream: false.
  bool has_fields(std::uint32_t stream) const;

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

  // The stream gets that property (empty: none). The one of add_stream() is that of the beginning.
  //   from   the time of its first sample that has it; samples from there on may have been written.
  //          Empty: 1 ns after the last one that was written, or the beginning if there is none.
  //          A time before 1970 counts as the beginning
  //   fails  as write()
  Result<void> set_property(std::uint32_t stream, std::span<const std::byte> property,
                            std::optional<Time> from = {});

  // Adds what made the recorder write. Samples need not have been added before.
  //   fails  as write()
  Result<void> add_trigger(const RecordedTrigger& trigger);

  RecordingProgress progress() const;

  // Everything to the disk, summary and footer. Only progress() may be called afterwards.
  //   fails  as write(), also for what was written before and failed later
  Result<void> finish();

 private:
  explicit RecordingWriter(std::unique_ptr<recording::Writer> writer) noexcept;
  std::unique_ptr<recording::Writer> writer_;
};

// --- reading

// Samples first .. first + count - 1 that could not be kept.
struct RecordedGap {
  Tid first = 0;
  std::uint64_t count = 0;
  friend bool operator==(const RecordedGap&, const RecordedGap&) = default;
};

// A stream in a recording, of one incarnation.
struct RecordedStreamInfo : RecordedStream {  // with the last property that it had
  std::uint64_t samples = 0;
  std::uint64_t payload_bytes = 0;
  std::uint64_t lost_samples = 0;  // of add_gap(), and records of a log that are no samples
  std::vector<RecordedGap> gaps;   // of add_gap(), in the order of tids
  Tid first_tid = kNoTid, last_tid = kNoTid;
  Time first_time{}, last_time{};  // the least and the greatest; meaningless without samples
  // Since when it had each of its properties, which Recording::property() returns by their index
  // here; Time::min(): since the beginning. They rise: a property that another one replaced for all
  // of its time is not among them. Empty: it never had one.
  std::vector<Time> property_times;

  // The index of the property that it had at `t`; empty: it had none yet.
  //   cost  O(log of their number)
  std::optional<std::size_t> property_at(Time t) const noexcept;
};

// A sample as RecordingCursor returns it.
struct RecordedSample {
  std::size_t stream = 0;  // index in Recording::streams()
  SampleInfo info;
  // Bound on the distance of info.time from the recording PC's clock; kUnknownClockError: unknown.
  Duration clock_error = kUnknownClockError;
  std::span<const std::byte> payload;  // valid until the next call
};

// Goes through all samples of all streams, in the order in which they were recorded. Several
// recordings that are opened together, as logs of SSM, are merged by time. The property that a
// stream had with a sample is the one with RecordedStreamInfo::property_at(info.time).
//
//   threads   one at a time
//   lifetime  usable without its Recording
//   moved     a moved-from cursor may only be assigned to or destroyed
class RecordingCursor {
 public:
  RecordingCursor(RecordingCursor&&) noexcept;
  RecordingCursor& operator=(RecordingCursor&&) noexcept;
  ~RecordingCursor();

  // The next sample; false after the last one.
  bool next(RecordedSample& out) noexcept;

  // The sample before; false at the beginning. After next() it is that one again, and the reverse;
  // of several recordings only if their samples are in the order of times.
  bool previous(RecordedSample& out) noexcept;

  // Goes to the first sample, in the order of recording, with time >= `t`; before the first one for
  // Time::min().
  void seek(Time t) noexcept;

 private:
  friend class Recording;
  explicit RecordingCursor(std::unique_ptr<recording::CursorState> state) noexcept;
  std::unique_ptr<recording::CursorState> state_;
};

class RecordedRawReader;
template <Payload T>
class RecordedReader;

// A recording that is open for reading: one file, or several that belong together. It has what was
// in the files when it was opened, also when they are still written, or were cut off: up to the
// last whole chunk.
//
//   threads   any; readers and cursors are independent of each other
//   memory    some dozen bytes for each stream in each chunk, and up to 64 MiB (or two chunks) of
//             samples
class Recording {
 public:
  // Opens a file, or all files of a folder whose names end with ".mcap". MCAP files of other
  // programs are recordings, too, as far as their topics are names of streams: with plain bytes,
  // as they are in the messages, and tids that count them. So are logs of SSM (docs/ssm.md "Logs"),
  // each with one stream; of a folder without *.mcap those whose names end with ".log".
  //   fails  not_found, protocol (not an MCAP file and no log), conflict (two files have the same
  //          samples of a stream), no_permission, system
  static Result<Recording> open(const std::filesystem::path& path);
  // The same with these files, in any order.
  static Result<Recording> open(std::span<const std::filesystem::path> files);

  // In the order in which they were added. A stream that restarted is in it several times.
  //   lifetime  valid as long as a copy of this object is
  const std::vector<RecordedStreamInfo>& streams() const noexcept;

  // The files, in the order in which they were written.
  const std::vector<std::filesystem::path>& files() const noexcept;

  // What made the recorder write, in the order of times. Empty: it did not wait for anything.
  //   lifetime  as streams()
  const std::vector<RecordedTrigger>& triggers() const noexcept;

  // A property that a stream had, from the file.
  //   stream  index in streams()
  //   index   in RecordedStreamInfo::property_times
  //   returns its bytes; none: it had none from then on
  //   fails   invalid_argument (there is no such property), protocol (the file is shorter than when
  //           it was opened), system
  Result<std::vector<std::byte>> property(std::size_t stream, std::size_t index) const;

  // What could not be read, a sentence each: damaged chunks, channels that are no streams, files
  // without an end. More come when samples are read.
  std::vector<std::string> warnings() const;

  // A reader of all incarnations of a stream.
  //   id       without a host: of the only host that has a stream of that name here
  //   wanted   fails with type_mismatch unless TypeInfo::check_usable_as(wanted)
  //   fails    not_found, type_mismatch, conflict (several hosts have a stream of that name, or its
  //            incarnations have different types)
  Result<RecordedRawReader> open_raw_reader(const StreamId& id,
                                            const TypeInfo* wanted = nullptr) const;
  // The same with a type; `name` is parsed by StreamId::parse(), whose errors it also returns.
  template <Payload T>
  Result<RecordedReader<T>> open_reader(std::string_view name) const;

  // A cursor before the first sample.
  RecordingCursor cursor() const;

 private:
  explicit Recording(std::shared_ptr<recording::Content> content) noexcept;
  std::shared_ptr<recording::Content> content_;
};

// What repair_recording() did.
struct RecordingRepair {
  bool was_whole = false;           // nothing was done
  std::uint64_t removed_bytes = 0;  // of an incomplete record at the end
  std::uint64_t samples = 0;        // in the file
};

// Completes a file that was not finished, in place: removes what follows the last whole record, and
// appends what finish() would. Recordings open without it, but take as long as it takes to read all
// of the file; tools other than DSSM's may refuse such files.
//   fails  as Recording::open(), unavailable (RecordingWriter is still writing it) and
//          invalid_argument (another program's)
Result<RecordingRepair> repair_recording(const std::filesystem::path& file);

// Reads a stream in a recording as RawReader reads one in its ring. Everything is as there, except:
//
//   start      a new reader has its cursor before the first sample: read_next() returns that
//   newest     is the last one of the recording; there is no waiting, and not_yet means the end
//   lost       a result of read_tid() and read_info(): the sample was not recorded. The other reads
//              pass over it, as they do over damaged parts of a file
//   restarted  the reader goes from one incarnation to another, in both directions: read_next()
//              after the last sample of one, read_previous() before the first, and read_newest()
//              and reads by time, which search all, when they find the sample in another one. The
//              call returns `restarted`, once; then the cursor is kNoTid, after read_previous()
//              behind the last sample
//   clocks     no read returns clock_out_of_bounds but read_joint_at()
//
//   threads  one at a time; others may use other readers of the recording
//   cost     a lock, and the reading of a chunk where it is not in memory
class RecordedRawReader {
 public:
  RecordedRawReader(RecordedRawReader&&) noexcept;
  RecordedRawReader& operator=(RecordedRawReader&&) noexcept;
  ~RecordedRawReader();

  // By tid, in the incarnation that is being read. `payload` is exactly payload_bytes() long.
  ReadStatus read_newest(std::span<std::byte> payload, SampleInfo& info) noexcept;
  ReadStatus read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) noexcept;
  ReadStatus read_next(std::span<std::byte> payload, SampleInfo& info) noexcept;
  ReadStatus read_previous(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // By time. Exact for every sequence of times, also one that runs backwards.
  ReadStatus read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                     Duration max_age = kAnyAge) noexcept;
  ReadStatus read_at_or_after(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;
  ReadStatus read_nearest(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;
  ReadStatus read_neighbours(Time t, std::span<std::byte> before, std::span<std::byte> after,
                             Neighbours& infos) noexcept;

  // Without payloads. These never return `restarted`: the sample may be of another incarnation.
  ReadStatus read_info(Tid tid, SampleInfo& info) const noexcept;
  ReadStatus find(Time t, SampleInfo& info) const noexcept;
  ReadStatus find_neighbours(Time t, Neighbours& out) const noexcept;

  // The bound [ns, >= 0] on the distance of info.time from the recording PC's clock at the time of
  // the recording; kUnknownClockError: unknown. `info` comes from this reader.
  Duration clock_error(const SampleInfo& info) const noexcept;

  // Of the incarnation that is being read.
  Tid newest_tid() const noexcept;
  Tid oldest_tid() const noexcept;
  Tid cursor() const noexcept;
  void seek(Tid tid) noexcept;
  const StreamId& id() const noexcept;
  const TypeInfo& type() const noexcept;
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;  // of the ring
  Duration cycle() const noexcept;
  std::uint64_t incarnation() const noexcept;
  // The one that it had at the time of the sample at cursor(): before the first read, of its first
  // one. If that was not recorded, of the next one, and after all of them the last property.
  //   fails  not_found (none), and as Recording::property()
  Result<std::vector<std::byte>> property() const;

  // Samples that read_next() skipped because they are not in the recording.
  std::uint64_t lost_samples() const noexcept;
  // How often a read returned `restarted`.
  std::uint64_t restarts() const noexcept;

 private:
  friend class Recording;
  explicit RecordedRawReader(std::unique_ptr<recording::ReaderState> state) noexcept;
  std::unique_ptr<recording::ReaderState> state_;
};

// As JointSample and read_joint_at() of RawReader: from each stream the sample that read_at(t)
// copies, from all or from none.
struct RecordedJointSample {
  RecordedRawReader* reader = nullptr;
  std::span<std::byte> payload;  // exactly reader->payload_bytes() long
  SampleInfo info{};
};
JointRead read_joint_at(Time t, std::span<RecordedJointSample> samples,
                        Duration max_error = kUnknownClockError,
                        Duration max_age = kAnyAge) noexcept;

// The same with a T in place of bytes, as Reader<T> (dssm/typed_reads.hpp).
template <Payload T>
class RecordedReader : public TypedReads<T, RecordedRawReader> {
 public:
  explicit RecordedReader(RecordedRawReader raw) noexcept
      : TypedReads<T, RecordedRawReader>(std::move(raw)) {}

  // This reader's part of a read_joint_at(), which copies the sample to `out`.
  RecordedJointSample joint_sample(T& out) noexcept { return {this, detail::bytes_of(out), {}}; }
};

template <Payload T>
Result<RecordedReader<T>> Recording::open_reader(std::string_view name) const {
  Result<StreamId> id = StreamId::parse(name);
  if (!id) return std::move(id).error();
  const TypeInfo type = type_of<T>();
  Result<RecordedRawReader> raw = open_raw_reader(*id, &type);
  if (!raw) return std::move(raw).error();
  return RecordedReader<T>(*std::move(raw));
}

}  // namespace dssm
#pragma GCC visibility pop
