// SPDX-License-Identifier: Apache-2.0
#include "client/recording/writer.hpp"

#include <fmt/format.h>
#include <sys/random.h>
#include <unistd.h>

#include <algorithm>

#include "client/recording/ros2_schema.hpp"
#include "client/recording/stream_channel.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/text.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::recording {
namespace {

constexpr Duration kSyncInterval = std::chrono::seconds(1);
constexpr std::size_t kMaxStreams = 65535;  // ids of channels have 16 bits, and 0 is not used
constexpr std::size_t kMaxSpareChunks = 4;
constexpr std::uint64_t kMaxSpareBytes = 4U << 20;  // a chunk of a large sample is freed

template <class... Values>
Error invalid(fmt::format_string<Values...> text, Values&&... values) {
  return Error{Errc::invalid_argument, fmt::format(text, std::forward<Values>(values)...)};
}

Result<void> check_options(const RecordingOptions& options) {
  if (options.chunk_bytes < 1 || options.chunk_bytes > kMaxPayloadBytes) {
    return invalid("chunk_bytes is {}; it takes 1 to {}", options.chunk_bytes, kMaxPayloadBytes);
  }
  if (options.chunk_age <= Duration::zero()) {
    return invalid("chunk_age is {} ns; it takes more than 0", to_ns(options.chunk_age));
  }
  if (options.max_file_duration < Duration::zero()) {
    return invalid("max_file_duration is {} ns; it takes 0 (no limit) or more",
                   to_ns(options.max_file_duration));
  }
  if (options.max_total_bytes > 0 && options.max_file_bytes > options.max_total_bytes / 2) {
    return invalid(
        "max_file_bytes is {}, which is more than half of max_total_bytes ({}): the "
        "newest file is never deleted, so the total needs to hold two of them",
        options.max_file_bytes, options.max_total_bytes);
  }
  return {};
}

RecordingOptions completed(RecordingOptions options) {
  if (options.max_total_bytes > 0 && options.max_file_bytes == 0) {
    options.max_file_bytes = std::max<std::uint64_t>(options.max_total_bytes / 8, 1);
  }
  if (options.max_file_bytes > 0) {  // a file may become longer by one chunk
    const std::uint64_t most = std::max<std::uint64_t>(options.max_file_bytes / 8, 1);
    options.chunk_bytes = std::min(options.chunk_bytes, most);
  }
  return options;
}

// The name of file `number`: NAME.mcap, NAME_1.mcap ...
std::filesystem::path numbered(const std::filesystem::path& file, std::uint32_t number) {
  if (number == 0) return file;
  std::filesystem::path result = file;
  result.replace_filename(
      fmt::format("{}_{}{}", file.stem().string(), number, file.extension().string()));
  return result;
}

}  // namespace

Result<std::unique_ptr<Writer>> Writer::create(const std::filesystem::path& file,
                                               const RecordingOptions& options) {
  DSSM_TRY(check_options(options), fmt::format("create recording '{}'", file.string()));
  std::string recording = options.recording;
  if (recording.empty()) {
    std::uint64_t random = 0;
    (void)!::getrandom(&random, sizeof random, 0);
    recording = hex(random);
  }
  FileWriter first = DSSM_TRY(FileWriter::create(file, recording, options.earlier_files));
  std::unique_ptr<Writer> writer(new Writer(file, completed(options), recording, std::move(first)));
  writer->disk_thread_ =
      DSSM_TRY(quiet_thread("the recording", [raw = writer.get()] { raw->run_disk(); }));
  writer->sync_thread_ =
      DSSM_TRY(quiet_thread("the recording", [raw = writer.get()] { raw->run_sync(); }));
  return writer;
}

Writer::Writer(const std::filesystem::path& file, const RecordingOptions& options,
               std::string recording, FileWriter first)
    : file_(file),
      options_(options),
      recording_(std::move(recording)),
      open_(std::make_unique<Chunk>()),
      compressor_(options.compression),
      current_(std::move(first)) {
  progress_.files = 1;
  progress_.file_bytes = current_.bytes();
}

Writer::~Writer() { (void)finish(); }

Result<void> Writer::check() const {
  if (error_) return *error_;
  if (finished_) return invalid("recording '{}' is finished", file_.string());
  return {};
}

Result<void> Writer::check(std::uint32_t stream) const {
  DSSM_TRY(check());
  if (stream >= streams_.size()) {
    return invalid("recording '{}' has no stream number {}; add_stream() returns the numbers",
                   file_.string(), stream);
  }
  return {};
}

Result<std::uint32_t> Writer::add_stream(const RecordedStream& stream) {
  const std::string what = "record stream '" + stream.id.str() + "'";
  DSSM_TRY(stream.id.check(), what);
  DSSM_TRY(stream.type.check(), what);
  const std::unique_lock lock(mutex_);
  const std::pair key(topic_of(stream.id), stream.incarnation);
  if (const auto known = numbers_.find(key); known != numbers_.end()) {
    const TypeInfo& type = streams_[known->second].type;
    if (type.is_less_described_than(stream.type) && stream.type.check_usable_as(type)) {
      described_[known->second] = stream.type;
    }
    return known->second;
  }
  DSSM_TRY(check());
  if (streams_.size() == kMaxStreams) {
    return Error{Errc::limit_exceeded,
                 fmt::format("{}: recording '{}' has {} streams, and restarts of them; more are "
                             "not possible in one",
                             what, file_.string(), kMaxStreams)};
  }

  NewChannel added{{}, channel_of(stream)};
  const auto number = static_cast<std::uint32_t>(streams_.size());
  added.channel.id = static_cast<std::uint16_t>(number + 1);
  added.schema = schema_for(stream.type);
  added.channel.schema_id = added.schema.id;
  begin_chunk();
  open_->channels.push_back(std::move(added));
  if (!stream.property.empty()) {
    open_->properties.push_back({static_cast<std::uint16_t>(number + 1), stream.property, 0});
  }
  streams_.push_back({.id = stream.id, .type = stream.type, .incarnation = stream.incarnation});
  numbers_.emplace(key, number);
  return number;
}

// The schema of `type`: one for all equal ones.
const Schema& Writer::schema_for(const TypeInfo& type) {
  Ros2Schema text = ros2_schema(type);
  Schema& schema = schemas_[{text.name, text.text}];
  if (schema.id != 0) return schema;
  // Tools keep schemas by name.
  std::string name = text.name;
  for (int i = 2; !schema_names_.insert(name).second; ++i) name = fmt::format("{}{}", text.name, i);
  schema = {static_cast<std::uint16_t>(schemas_.size()), std::move(name), "ros2msg",
            std::move(text.text)};
  return schema;
}

// Notes the time when something comes into an empty chunk; to be called before.
void Writer::begin_chunk() {
  if (!open_->is_empty()) return;
  open_since_ = MonoClock::now();
  disk_.notify_one();
}

// What is already encoded has the earlier descriptions, and comes into the files before.
void Writer::begin_described_file() {
  if (!open_->is_empty()) take_open_chunk();
  open_->begins_file = true;
  for (auto& [number, type] : described_) {
    open_->descriptions.push_back({static_cast<std::uint16_t>(number + 1), schema_for(type), type});
    streams_[number].type = std::move(type);
  }
  described_.clear();
}

// Hands the open chunk to the disk's thread.
void Writer::take_open_chunk() {
  waiting_bytes_ += open_->bytes();
  waiting_.push_back(std::move(open_));
  if (spare_.empty()) {
    open_ = std::make_unique<Chunk>();
  } else {
    open_ = std::move(spare_.back());
    spare_.pop_back();
  }
  ++chunk_number_;
}

// The same, and waits while more than queue_bytes wait.
void Writer::close_chunk(std::unique_lock<std::mutex>& lock) {
  const std::uint64_t most = std::max<std::uint64_t>(options_.queue_bytes, open_->bytes());
  take_open_chunk();
  disk_.notify_one();
  caller_.wait(lock, [&] { return waiting_bytes_ <= most || error_; });
}

Chunk::IndexedPart& Writer::part_of(std::uint32_t number) {
  Stream& stream = streams_[number];
  if (stream.chunk != chunk_number_) {
    stream.chunk = chunk_number_;
    stream.part = open_->used_parts++;
    if (stream.part == open_->parts.size()) open_->parts.emplace_back();
    Chunk::IndexedPart& part = open_->parts[stream.part];
    part.part = {};
    part.part.channel = static_cast<std::uint16_t>(number + 1);
    part.index.clear();
  }
  return open_->parts[stream.part];
}

Result<void> Writer::write(std::uint32_t number, const SampleInfo& info, Duration clock_error,
                           std::span<const std::byte> payload) {
  std::unique_lock lock(mutex_);
  DSSM_TRY(check(number));
  Stream& stream = streams_[number];
  if (payload.size() != info.payload_bytes || payload.size() > stream.type.payload_bytes) {
    return invalid(
        "record stream '{}': sample {} has {} bytes and a payload of {}; both must be "
        "the same, and at most {}",
        stream.id.str(), info.tid, info.payload_bytes, payload.size(), stream.type.payload_bytes);
  }
  if (info.tid <= stream.last) {
    return invalid(
        "record stream '{}': sample {} comes after sample {}; write samples in the "
        "order of their tids, and add the stream again when it restarted",
        stream.id.str(), info.tid, stream.last);
  }
  const std::size_t most = message_bytes(stream.type, payload.size());
  if (open_->messages.size() > 0 && open_->messages.size() + most > options_.chunk_bytes) {
    close_chunk(lock);
    if (error_) return *error_;
  }
  begin_chunk();
  Chunk& chunk = *open_;
  Chunk::IndexedPart& part = part_of(number);
  const std::uint64_t log_time = log_time_of(info.time);
  std::byte* index = part.index.grow(16);
  put(put(index, log_time), static_cast<std::uint64_t>(chunk.messages.size()));
  encode_message(chunk.messages, part.part.channel, stream.type, info, clock_error, payload);
  part.part.add(info);
  chunk.start_time = std::min(chunk.start_time, log_time);
  chunk.end_time = std::max(chunk.end_time, log_time);
  chunk.payload_bytes += payload.size();
  stream.last = info.tid;
  stream.last_time = info.time;
  ++progress_.samples;
  progress_.payload_bytes += payload.size();
  progress_.waiting_bytes += payload.size();
  if (chunk.messages.size() >= options_.chunk_bytes) close_chunk(lock);
  return {};
}

Result<void> Writer::add_gap(std::uint32_t number, Tid first, std::uint64_t count) {
  const std::unique_lock lock(mutex_);
  DSSM_TRY(check(number));
  if (count == 0) return {};
  begin_chunk();
  const auto channel = static_cast<std::uint16_t>(number + 1);
  auto gaps = std::ranges::find(open_->gaps, channel, &Gaps::channel);
  if (gaps == open_->gaps.end()) gaps = open_->gaps.insert(gaps, {channel, {}});
  if (!gaps->gaps.empty() &&
      gaps->gaps.back().first + static_cast<Tid>(gaps->gaps.back().second) == first) {
    gaps->gaps.back().second += count;
  } else {
    gaps->gaps.emplace_back(first, count);
  }
  progress_.lost_samples += count;
  return {};
}

Result<void> Writer::set_property(std::uint32_t number, std::span<const std::byte> property,
                                  std::optional<Time> from) {
  std::unique_lock lock(mutex_);
  DSSM_TRY(check(number));
  const Stream& stream = streams_[number];
  if (!from && stream.last != kNoTid) {
    from = stream.last_time == Time::max() ? Time::max() : stream.last_time + Duration(1);
  }
  begin_chunk();
  open_->properties.push_back({static_cast<std::uint16_t>(number + 1),
                               {property.begin(), property.end()},
                               from ? log_time_of(*from) : 0});
  open_->property_bytes += property.size();
  if (open_->bytes() >= options_.chunk_bytes) close_chunk(lock);
  return {};
}

Result<void> Writer::add_trigger(const RecordedTrigger& trigger) {
  const std::lock_guard lock(mutex_);
  DSSM_TRY(check());
  begin_chunk();
  open_->triggers.push_back(trigger);
  return {};
}

bool Writer::has_fields(std::uint32_t stream) const {
  const std::lock_guard lock(mutex_);
  return stream < streams_.size() && !streams_[stream].type.fields.empty();
}

RecordingProgress Writer::progress() const {
  const std::lock_guard lock(mutex_);
  return progress_;
}

Result<void> Writer::finish() {
  {
    const std::lock_guard lock(mutex_);
    finished_ = stop_ = true;
    disk_.notify_one();
  }
  if (disk_thread_.joinable()) disk_thread_.join();
  {
    const std::lock_guard lock(mutex_);
    stored_all_ = true;
    sync_.notify_one();
  }
  if (sync_thread_.joinable()) sync_thread_.join();
  const std::lock_guard lock(mutex_);
  if (error_) return *error_;
  if (sync_error_) return *sync_error_;  // the kernel reports it once, and there it was
  return {};
}

// --- the disk's thread

void Writer::run_disk() {
  std::unique_lock lock(mutex_);
  while (!error_) {
    if (waiting_.empty() && !open_->is_empty()) {
      const MonoTime old = open_since_ + options_.chunk_age;
      if (!stop_ && MonoClock::now() < old) {
        disk_.wait_until(lock, old);
        continue;
      }
      take_open_chunk();
    }
    if (waiting_.empty()) {
      if (stop_) break;
      disk_.wait(lock);
      continue;
    }
    if (!described_.empty() && !is_ending_file_ && is_file_full(*waiting_.front())) {
      begin_described_file();
      is_ending_file_ = true;
    }
    std::unique_ptr<Chunk> chunk = std::move(waiting_.front());
    waiting_.pop_front();
    std::optional<Error> failed = sync_error_;
    lock.unlock();
    if (!failed) {
      if (Result<void> stored = store(*chunk); !stored) failed = std::move(stored).error();
    }
    if (failed) {
      fail(*std::move(failed));
      lock.lock();
      break;
    }
    lock.lock();
    waiting_bytes_ -= chunk->bytes();
    progress_.waiting_bytes -= chunk->payload_bytes;
    progress_.file_bytes = written_bytes_ + current_.bytes();
    progress_.files = files_;
    to_sync_ = current_.fd();
    if (spare_.size() < kMaxSpareChunks && chunk->messages.capacity() <= kMaxSpareBytes) {
      chunk->clear();
      spare_.push_back(std::move(chunk));
    }
    sync_.notify_one();
    caller_.notify_one();
  }
  if (error_) return;
  std::optional<Error> failed = sync_error_;
  lock.unlock();
  if (!failed) {
    if (Result<void> finished = finish_file(); !finished) failed = std::move(finished).error();
  }
  if (failed) fail(*std::move(failed));
  lock.lock();
  progress_.file_bytes = written_bytes_ + current_.bytes();
}

// Writes what `chunk` holds, in the next file if the current one is full.
Result<void> Writer::store(const Chunk& chunk) {
  for (const NewDescription& described : chunk.descriptions) {
    NewChannel& channel = disk_streams_[described.channel - 1U].channel;
    channel.schema = described.schema;
    channel.channel.schema_id = described.schema.id;
    set_type(channel.channel, described.type);
  }
  if (chunk.begins_file || is_file_full(chunk)) DSSM_TRY(begin_file());
  if (chunk.begins_file) is_ending_file_ = false;
  for (const NewChannel& channel : chunk.channels) {
    for (DiskStream& earlier : disk_streams_) {
      if (earlier.channel.channel.topic == channel.channel.topic) earlier.replaced = true;
    }
    disk_streams_.push_back({channel, {}, false});
    DSSM_TRY(current_.add_channel(channel));
  }
  // Of a stream that had restarted before the file began, and is written to all the same.
  const auto add = [&](std::uint16_t channel) {
    return current_.has_channel(channel) ? Result<void>() : repeat(disk_streams_[channel - 1U]);
  };
  for (const auto& part : std::span(chunk.parts).first(chunk.used_parts)) {
    DSSM_TRY(add(part.part.channel));
    file_start_ns_ = std::min(file_start_ns_, part.part.min_time_ns);
  }
  for (const Gaps& gaps : chunk.gaps) DSSM_TRY(add(gaps.channel));
  for (const NewProperty& property : chunk.properties) {
    DSSM_TRY(add(property.channel));
    DiskStream& stream = disk_streams_[property.channel - 1U];
    if (stream.property.property == property.property) continue;
    stream.property = property;
    DSSM_TRY(current_.add_property(stream.channel.channel, property));
  }
  DSSM_TRY(current_.append(chunk, compressor_));
  delete_oldest();
  return {};
}

bool Writer::is_file_full(const Chunk& chunk) const {
  if (current_.summary().chunks.empty()) return false;
  // Where little waits before a chunk with begins_file, that needs no file of its own.
  const std::uint64_t more = is_ending_file_ ? options_.max_file_bytes / 8 : 0;
  const std::uint64_t most = options_.max_file_bytes;
  if (most > 0 && current_.bytes() >= most + more) return true;
  if (options_.max_file_duration == Duration::zero() || is_ending_file_) return false;
  std::int64_t end_ns = file_start_ns_;
  for (const auto& part : std::span(chunk.parts).first(chunk.used_parts)) {
    end_ns = std::max(end_ns, part.part.max_time_ns);
  }
  return distance_ns(time_from_ns(file_start_ns_), time_from_ns(end_ns)) >=
         static_cast<std::uint64_t>(to_ns(options_.max_file_duration));
}

Result<void> Writer::begin_file() {
  DSSM_TRY(finish_file());
  while (true) {
    ++file_number_;
    Result<FileWriter> next = FileWriter::create(numbered(file_, file_number_), recording_,
                                                 options_.earlier_files + files_);
    if (!next && next.error().code == Errc::conflict) continue;  // of another recording
    FileWriter created = DSSM_TRY(std::move(next));
    finished_files_.emplace_back(current_.path(), current_.bytes());
    written_bytes_ += current_.bytes();
    written_samples_ += current_.summary().samples();
    written_payload_bytes_ += current_.summary().payload_bytes();
    current_ = std::move(created);
    break;
  }
  ++files_;
  file_start_ns_ = INT64_MAX;
  for (const DiskStream& stream : disk_streams_) {
    if (!stream.replaced) DSSM_TRY(repeat(stream));
  }
  return {};
}

// In a file that does not have the stream yet.
Result<void> Writer::repeat(const DiskStream& stream) {
  DSSM_TRY(current_.add_channel(stream.channel));
  if (stream.property.property.empty()) return {};
  return current_.add_property(stream.channel.channel, stream.property);
}

Result<void> Writer::finish_file() {
  DSSM_TRY(current_.finish());
  if (::fsync(current_.fd()->get()) != 0) {
    return os_error(fmt::format("sync recording '{}'", current_.path().string()));
  }
  return {};
}

void Writer::delete_oldest() {
  if (options_.max_total_bytes == 0) return;
  std::uint64_t total = current_.bytes();
  for (const auto& [path, bytes] : finished_files_) total += bytes;
  while (total > options_.max_total_bytes && !finished_files_.empty()) {
    const auto& [path, bytes] = finished_files_.front();
    ::unlink(path.c_str());  // one that was moved away does not count any more, either
    total -= bytes;
    finished_files_.pop_front();
  }
}

// Ends the recording after a failure, with a file that is as complete as possible.
void Writer::fail(Error error) {
  (void)finish_file();
  const std::lock_guard lock(mutex_);
  // What was waiting, or was removed to make room, is not in a file.
  progress_.file_bytes = written_bytes_ + current_.bytes();
  progress_.samples = written_samples_ + current_.summary().samples();
  progress_.payload_bytes = written_payload_bytes_ + current_.summary().payload_bytes();
  progress_.waiting_bytes = 0;
  error.message += fmt::format(
      "; nothing more is recorded. '{}' {}. {}", current_.path().string(),
      current_.is_whole() ? "is a whole file with what was written before"
                          : "has no summary, but opens all the same with what was written before",
      error.code == Errc::no_memory ? "Free space on that disk, or record to another one"
                                    : "Check that disk, or record to another one");
  error_ = std::move(error);
  waiting_.clear();
  caller_.notify_one();
}

// --- the sync's thread

void Writer::run_sync() {
  std::unique_lock lock(mutex_);
  while (!stored_all_) {
    if (to_sync_ == nullptr) {
      sync_.wait(lock);
      continue;
    }
    const std::shared_ptr<const UniqueFd> fd = std::exchange(to_sync_, nullptr);
    lock.unlock();
    const int error = ::fdatasync(fd->get()) == 0 ? 0 : errno;
    lock.lock();
    if (error != 0 && !sync_error_) {
      sync_error_ = os_error(fmt::format("sync recording '{}'", file_.string()), error);
      disk_.notify_one();
    }
    sync_.wait_until(lock, deadline_in(kSyncInterval), [&] { return stored_all_; });
  }
}

}  // namespace dssm::recording

namespace dssm {

RecordingWriter::RecordingWriter(std::unique_ptr<recording::Writer> writer) noexcept
    : writer_(std::move(writer)) {}
RecordingWriter::RecordingWriter(RecordingWriter&&) noexcept = default;
RecordingWriter& RecordingWriter::operator=(RecordingWriter&&) noexcept = default;
RecordingWriter::~RecordingWriter() = default;

Result<RecordingWriter> RecordingWriter::create(const std::filesystem::path& file,
                                                const RecordingOptions& options) {
  return RecordingWriter(DSSM_TRY(recording::Writer::create(file, options)));
}

Result<std::uint32_t> RecordingWriter::add_stream(const RecordedStream& stream) {
  return writer_->add_stream(stream);
}

Result<void> RecordingWriter::write(std::uint32_t stream, const SampleInfo& info,
                                    Duration clock_error, std::span<const std::byte> payload) {
  return writer_->write(stream, info, clock_error, payload);
}

Result<void> RecordingWriter::add_gap(std::uint32_t stream, Tid first, std::uint64_t count) {
  return writer_->add_gap(stream, first, count);
}

Result<void> RecordingWriter::set_property(std::uint32_t stream,
                                           std::span<const std::byte> property,
                                           std::optional<Time> from) {
  return writer_->set_property(stream, property, from);
}

Result<void> RecordingWriter::add_trigger(const RecordedTrigger& trigger) {
  return writer_->add_trigger(trigger);
}

bool RecordingWriter::has_fields(std::uint32_t stream) const { return writer_->has_fields(stream); }

RecordingProgress RecordingWriter::progress() const { return writer_->progress(); }

Result<void> RecordingWriter::finish() { return writer_->finish(); }

}  // namespace dssm
