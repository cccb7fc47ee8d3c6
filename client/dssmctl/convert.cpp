// SPDX-License-Identifier: Apache-2.0
//
// dssmctl convert: recordings and logs of SSM into each other. A log holds one stream, and of a
// sample only the data and the time; what else a recording has is left behind. The first line of a
// log stays in the recording, so that the way back gives the same bytes.
#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>
#include <dssm/recording.hpp>
#include <filesystem>
#include <limits>
#include <optional>

#include "client/dssmctl/names.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/seconds.hpp"
#include "core/base/ssm_log.hpp"
#include "core/base/try.hpp"
#include "core/base/unique_fd.hpp"

namespace dssm::ctl {
namespace {

namespace fs = std::filesystem;

struct Converted {
  std::vector<std::string> files;  // written
  std::uint64_t samples = 0;
};

// --- to MCAP

// Writes samples, properties, gaps and triggers.
class McapOutput {
 public:
  McapOutput(RecordingWriter file, const Recording& recording)
      : file_(std::move(file)),
        recording_(recording),
        numbers_(recording.streams().size()),
        properties_(recording.streams().size()),
        gaps_(recording.streams().size()) {}

  Result<void> add(std::size_t stream) {
    RecordedStream about = recording_.streams()[stream];
    about.property.clear();
    numbers_[stream] = DSSM_TRY(file_.add_stream(about));
    return {};
  }
  Result<void> write(const RecordedSample& sample) {
    DSSM_TRY(write_properties(sample.stream, sample.info.time));
    DSSM_TRY(write_gaps(sample.stream, sample.info.tid));
    return file_.write(*numbers_[sample.stream], sample.info, sample.clock_error, sample.payload);
  }
  bool takes(std::size_t stream) const { return numbers_[stream].has_value(); }
  Result<void> finish() {
    for (std::size_t stream = 0; stream < numbers_.size(); ++stream) {
      if (!takes(stream)) continue;
      DSSM_TRY(write_properties(stream, Time::max()));
      DSSM_TRY(write_gaps(stream, std::numeric_limits<Tid>::max()));
    }
    for (const RecordedTrigger& trigger : recording_.triggers()) {
      DSSM_TRY(file_.add_trigger(trigger));
    }
    return file_.finish();
  }

 private:
  // Those that the stream got up to `t`.
  Result<void> write_properties(std::size_t stream, Time t) {
    const std::vector<Time>& times = recording_.streams()[stream].property_times;
    std::size_t& next = properties_[stream];
    for (; next < times.size() && times[next] <= t; ++next) {
      const std::vector<std::byte> property = DSSM_TRY(recording_.property(stream, next));
      DSSM_TRY(file_.set_property(*numbers_[stream], property, times[next]));
    }
    return {};
  }

  // Those before sample `tid`. Other tids that are missing are no loss: of a black box, what came
  // between two incidents was not to be kept.
  Result<void> write_gaps(std::size_t stream, Tid tid) {
    const std::vector<RecordedGap>& all = recording_.streams()[stream].gaps;
    std::size_t& next = gaps_[stream];
    for (; next < all.size() && all[next].first < tid; ++next) {
      DSSM_TRY(file_.add_gap(*numbers_[stream], all[next].first, all[next].count));
    }
    return {};
  }

  RecordingWriter file_;
  const Recording& recording_;
  std::vector<std::optional<std::uint32_t>> numbers_;  // of each stream of the recording
  std::vector<std::size_t> properties_;                // how many are written
  std::vector<std::size_t> gaps_;                      // the same
};

// --- to logs

// The head of the log of a stream: the one that it had, if it comes from a log.
Result<std::pair<SsmLogHead, std::string>> log_head(const RecordedStreamInfo& stream) {
  const auto kept = stream.metadata.find(kSsmLogKey);
  if (kept != stream.metadata.end()) {
    std::string line = kept->second + "\n";
    Result<SsmLogHead> head = ssm_log_head_untrusted(line, UINT64_MAX);
    if (head && head->stream_name == stream.id.name && head->stream_id == stream.id.id &&
        std::max<std::uint64_t>(head->data_bytes, 1) == stream.type.payload_bytes &&
        head->property_bytes == stream.property.size()) {
      return std::pair(*std::move(head), std::move(line));
    }
  }
  if (!is_ssm_log_name(stream.id.name)) {
    return Error{Errc::invalid_argument,
                 fmt::format("'{}' has a blank in its name, which no log can hold; leave it out "
                             "with --stream",
                             escaped(stream.id.str()))};
  }
  SsmLogHead head;
  head.stream_name = stream.id.name;
  head.stream_id = stream.id.id;
  head.buffer_num = static_cast<std::int32_t>(std::clamp(stream.depth, kMinDepth, kMaxDepth));
  head.data_bytes = stream.type.name == kEmptySsmType ? 0 : stream.type.payload_bytes;
  head.property_bytes = stream.property.size();
  head.cycle_s = seconds_from_ns(to_ns(stream.cycle));
  head.start_time_s = seconds_from_ns(to_ns(stream.first_time));
  std::string line = ssm_log_line(head);
  return std::pair(std::move(head), std::move(line));
}

// A log that is written. It must not exist before.
class LogOutput {
 public:
  static Result<LogOutput> create(const fs::path& path, const RecordedStreamInfo& stream) {
    auto [head, line] = DSSM_TRY(log_head(stream));
    LogOutput log;
    log.path_ = path.string();
    log.data_bytes_ = head.data_bytes;
    log.fd_ = UniqueFd(::open(path.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666));
    if (!log.fd_ && errno == EEXIST) {
      return Error{Errc::conflict, fmt::format("write log '{}': the file exists; remove it, or "
                                               "choose another name",
                                               log.path_)};
    }
    if (!log.fd_) return os_error(fmt::format("write log '{}'", log.path_));
    log.pending_ = std::move(line);
    log.append(stream.property.data(), stream.property.size());
    return log;
  }

  const std::string& path() const { return path_; }

  Result<void> write(const RecordedSample& sample) {
    const double time_s = seconds_from_ns(to_ns(sample.info.time));
    append(&time_s, sizeof time_s);
    const std::size_t bytes = std::min<std::size_t>(sample.payload.size(), data_bytes_);
    append(sample.payload.data(), bytes);
    pending_.append(data_bytes_ - bytes, '\0');  // all records of a log have one length
    if (pending_.size() < kBatchBytes) return {};
    return flush();
  }

  Result<void> flush() {
    for (std::string_view rest = pending_; !rest.empty();) {
      const ssize_t n = ::write(fd_.get(), rest.data(), rest.size());
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) return os_error(fmt::format("write log '{}'", path_));
      rest.remove_prefix(static_cast<std::size_t>(n));
    }
    pending_.clear();
    return {};
  }

 private:
  static constexpr std::size_t kBatchBytes = 1U << 20;
  LogOutput() = default;
  void append(const void* bytes, std::size_t size) {
    if (size > 0) pending_.append(static_cast<const char*>(bytes), size);
  }

  std::string path_;
  UniqueFd fd_;
  std::uint64_t data_bytes_ = 0;
  std::string pending_;
};

// --- the verb

class Converter {
 public:
  Converter(const ConvertOptions& options, const Recording& recording)
      : options_(options), recording_(recording), filter_({}, options.patterns) {
    const auto& streams = recording.streams();
    for (std::size_t i = 0; i < streams.size(); ++i) {
      if (filter_.takes(streams[i].id)) wanted_.push_back(i);
    }
  }

  // What was made of it when it fails is removed: half of a recording looks like a whole one.
  Result<Converted> run() {
    Result<Converted> done = convert();
    const auto has_samples = [&](std::size_t stream) { return info(stream).samples > 0; };
    if (done && done->samples == 0 && std::ranges::any_of(wanted_, has_samples)) {
      done = Error{Errc::protocol,
                   fmt::format("no sample of '{}' can be read", escaped(options_.file))};
    }
    std::error_code ignored;
    // From the end: a folder, which was created before its files, has to be empty.
    for (auto path = created_.rbegin(); !done && path != created_.rend(); ++path) {
      fs::remove(*path, ignored);
    }
    return done;
  }

 private:
  Result<Converted> convert() {
    if (wanted_.empty()) {
      std::vector<std::string> names;
      for (const RecordedStreamInfo& stream : recording_.streams()) {
        names.push_back(escaped(stream.id.str()));
      }
      return Error{Errc::not_found, fmt::format("no stream of the recording fits; it has {}",
                                                names.empty() ? "none" : list_text(names, 20))};
    }
    const fs::path out = options_.out;
    if (out.extension() == ".mcap") return to_mcap();
    if (out.extension() == ".log") {
      if (wanted_.size() == 1) return to_logs({out});
      return Error{Errc::invalid_argument, too_many_for_a_log()};
    }
    std::error_code error;
    if (fs::create_directories(out, error)) created_.push_back(out);
    if (error) return os_error(fmt::format("create folder '{}'", out.string()), error.value());
    return to_logs(log_paths(out));
  }

  const RecordedStreamInfo& info(std::size_t stream) const { return recording_.streams()[stream]; }

  // Why the wanted streams are not one log, and what to do.
  std::string too_many_for_a_log() const {
    std::vector<std::string> names;
    for (const std::size_t i : wanted_) {
      std::string name = escaped(info(i).id.str());
      if (std::ranges::find(names, name) == names.end()) names.push_back(std::move(name));
    }
    if (names.size() > 1) {
      return fmt::format(
          "a log holds one stream, and there are {}; choose one with --stream, or give a folder",
          list_text(names));
    }
    return fmt::format(
        "'{}' was created again during the recording, and a log holds one creation of a stream; "
        "give a folder, in which each of the {} gets a log",
        names.front(), wanted_.size());
  }

  Result<Converted> to_mcap() {
    RecordingOptions how;
    how.compression = compression_of(options_.compression);
    McapOutput file(DSSM_TRY(RecordingWriter::create(options_.out, how)), recording_);
    created_.emplace_back(options_.out);
    for (const std::size_t i : wanted_) DSSM_TRY(file.add(i));
    Converted done{{options_.out}};
    RecordingCursor cursor = recording_.cursor();
    for (RecordedSample sample; cursor.next(sample);) {
      if (!file.takes(sample.stream)) continue;
      DSSM_TRY(file.write(sample));
      ++done.samples;
    }
    DSSM_TRY(file.finish());
    return done;
  }

  // NAME-ID.log, with the host where several have such a stream, and a number where it restarted.
  std::vector<fs::path> log_paths(const fs::path& folder) const {
    std::vector<fs::path> paths;
    for (const std::size_t i : wanted_) {
      const StreamId& id = info(i).id;
      const auto is_other_host = [&](std::size_t other) {
        const StreamId& its = info(other).id;
        return its.name == id.name && its.id == id.id && its.host != id.host;
      };
      std::string name = fmt::format("{}-{}", id.name, id.id);
      std::ranges::replace(name, '/', '_');
      if (!id.host.empty() && std::ranges::any_of(wanted_, is_other_host)) name += "@" + id.host;
      fs::path path = folder / (name + ".log");
      for (int n = 1; std::ranges::find(paths, path) != paths.end(); ++n) {
        path = folder / fmt::format("{}_{}.log", name, n);
      }
      paths.push_back(std::move(path));
    }
    return paths;
  }

  Result<Converted> to_logs(const std::vector<fs::path>& paths) {
    for (const std::size_t i : wanted_) DSSM_TRY(log_head(info(i)));
    std::vector<std::optional<LogOutput>> logs(recording_.streams().size());
    Converted done;
    for (std::size_t i = 0; i < wanted_.size(); ++i) {
      logs[wanted_[i]] = DSSM_TRY(LogOutput::create(paths[i], info(wanted_[i])));
      created_.push_back(paths[i]);
      done.files.push_back(paths[i].string());
    }
    RecordingCursor cursor = recording_.cursor();
    for (RecordedSample sample; cursor.next(sample);) {
      if (!logs[sample.stream]) continue;
      DSSM_TRY(logs[sample.stream]->write(sample));
      ++done.samples;
    }
    for (std::optional<LogOutput>& log : logs) {
      if (log) DSSM_TRY(log->flush());
    }
    return done;
  }

  const ConvertOptions& options_;
  const Recording& recording_;
  StreamFilter filter_;
  std::vector<std::size_t> wanted_;  // numbers of streams
  std::vector<fs::path> created_;
};

}  // namespace

Result<void> run(const ConvertOptions& options, Output& out) {
  const Recording recording = DSSM_TRY(open_recording(options.file, options.more_files));
  const Result<Converted> converted = Converter(options, recording).run();
  for (const std::string& warning : recording.warnings()) {
    print_error(fmt::format("dssmctl: convert: {}\n", escaped_message(warning)));
  }
  const Converted done = DSSM_TRY(converted);
  if (options.json) {
    out.add(json_document({{"files", done.files}, {"samples", done.samples}}));
  } else {
    out.add(
        fmt::format("{}: {}\n", list_text(done.files), counted(done.samples, "sample", "samples")));
  }
  return {};
}

}  // namespace dssm::ctl
