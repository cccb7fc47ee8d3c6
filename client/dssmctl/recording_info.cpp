// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/recording_info.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <dssm/recording.hpp>
#include <filesystem>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Of all streams together.
struct Sum {
  std::uint64_t samples = 0, payload_bytes = 0, lost_samples = 0, file_bytes = 0;
  Time first_time = Time::max(), last_time = Time::min();

  Duration duration() const {
    return samples > 0 ? saturating_sub(last_time, first_time) : Duration::zero();
  }
};

Sum sum_of(const Recording& recording) {
  Sum sum;
  for (const RecordedStreamInfo& stream : recording.streams()) {
    sum.samples += stream.samples;
    sum.payload_bytes += stream.payload_bytes;
    sum.lost_samples += stream.lost_samples;
    if (stream.samples == 0) continue;
    sum.first_time = std::min(sum.first_time, stream.first_time);
    sum.last_time = std::max(sum.last_time, stream.last_time);
  }
  for (const std::filesystem::path& file : recording.files()) {
    std::error_code error;
    const std::uintmax_t bytes = std::filesystem::file_size(file, error);
    if (!error) sum.file_bytes += bytes;
  }
  return sum;
}

// 0: unknown.
double rate_hz(const RecordedStreamInfo& stream) {
  const double seconds =
      std::chrono::duration<double>(saturating_sub(stream.last_time, stream.first_time)).count();
  return stream.samples > 1 && seconds > 0 ? static_cast<double>(stream.samples - 1) / seconds : 0;
}

// Besides the property that it had at its beginning.
std::size_t property_changes(const RecordedStreamInfo& stream) {
  const std::vector<Time>& times = stream.property_times;
  return times.size() - (!times.empty() && times.front() == Time::min() ? 1 : 0);
}

Json json_of(const RecordedStreamInfo& stream) {
  const bool has_samples = stream.samples > 0;
  return {{"stream", stream.id.str()},
          {"host", stream.id.host},
          {"incarnation", stream.incarnation},
          {"type", or_null(stream.type.name)},
          {"payload_bytes", stream.type.payload_bytes},
          {"fields", fields_json(stream.type)},
          {"depth", stream.depth},
          {"cycle_ns", to_ns(stream.cycle)},
          {"property_bytes", stream.property.size()},
          {"property_changes", property_changes(stream)},
          {"samples", stream.samples},
          {"samples_bytes", stream.payload_bytes},
          {"lost_samples", stream.lost_samples},
          {"first_tid", has_samples ? Json(stream.first_tid) : Json()},
          {"last_tid", has_samples ? Json(stream.last_tid) : Json()},
          {"first_time_ns", has_samples ? Json(to_ns(stream.first_time)) : Json()},
          {"last_time_ns", has_samples ? Json(to_ns(stream.last_time)) : Json()},
          {"rate_hz", rate_hz(stream) > 0 ? Json(rate_hz(stream)) : Json()}};
}

void print_json(const Recording& recording, const Sum& sum, Output& out) {
  Json files = Json::array(), streams = Json::array(), triggers = Json::array();
  for (const std::filesystem::path& file : recording.files()) files.push_back(file.string());
  for (const RecordedStreamInfo& stream : recording.streams()) streams.push_back(json_of(stream));
  for (const RecordedTrigger& trigger : recording.triggers()) {
    triggers.push_back({{"name", trigger.name},
                        {"reason", or_null(trigger.reason)},
                        {"host", or_null(trigger.host)},
                        {"time_ns", to_ns(trigger.time)}});
  }
  const bool has_samples = sum.samples > 0;
  out.add(json_document({{"files", files},
                         {"file_bytes", sum.file_bytes},
                         {"first_time_ns", has_samples ? Json(to_ns(sum.first_time)) : Json()},
                         {"last_time_ns", has_samples ? Json(to_ns(sum.last_time)) : Json()},
                         {"samples", sum.samples},
                         {"samples_bytes", sum.payload_bytes},
                         {"lost_samples", sum.lost_samples},
                         {"triggers", triggers},
                         {"streams", streams},
                         {"warnings", recording.warnings()}}));
}

void print_text(const Recording& recording, const Sum& sum, bool iso, Output& out) {
  const auto line = [&](const char* key, const std::string& value) {
    out.add(fmt::format("{:<10} {}\n", std::string(key) + ":", value));
  };
  std::vector<std::string> files;
  for (const std::filesystem::path& file : recording.files()) files.push_back(file.string());
  line("files", list_text(files));
  line("size", bytes_text(sum.file_bytes));
  line("duration", duration_text(sum.duration()));
  line("from", sum.samples > 0 ? time_text(sum.first_time, iso) : "-");
  line("to", sum.samples > 0 ? time_text(sum.last_time, iso) : "-");
  line("samples", fmt::format("{}, {}, {} lost", sum.samples, bytes_text(sum.payload_bytes),
                              sum.lost_samples));
  for (const RecordedTrigger& trigger : recording.triggers()) {
    line("trigger", fmt::format("{} at {}, host {}{}", escaped(trigger.name),
                                time_text(trigger.time, iso), or_dash(escaped(trigger.host)),
                                trigger.reason.empty() ? "" : ": " + escaped(trigger.reason)));
  }
  constexpr auto kRight = Table::Align::right;
  Table table({{"STREAM"},
               {"SAMPLES", kRight},
               {"RATE", kRight, 1},
               {"LOST", kRight},
               {"BYTES", kRight, 2},
               {"TYPE", Table::Align::left, 3}});
  for (const RecordedStreamInfo& stream : recording.streams()) {
    table.add_row({escaped(stream.id.str()), std::to_string(stream.samples),
                   rate_hz(stream) > 0 ? fmt::format("{:.3f} Hz", rate_hz(stream)) : "-",
                   std::to_string(stream.lost_samples), bytes_text(stream.payload_bytes),
                   or_dash(escaped(stream.type.name))});
  }
  out.add("\n");
  table.print(out);
}

}  // namespace

bool is_recording(const std::string& name) {
  if (name.ends_with(".mcap") || name.ends_with(".log")) return true;
  for (const char* start : {"/", "./", "../"}) {
    if (name.starts_with(start)) return true;
  }
  std::error_code ignored;  // names of streams may have slashes, too
  return name.find('/') != std::string::npos && std::filesystem::exists(name, ignored);
}

Result<Recording> open_recording(const std::string& file, const std::vector<std::string>& more) {
  if (more.empty()) return Recording::open(file);
  std::vector<std::filesystem::path> files = {file};
  files.insert(files.end(), more.begin(), more.end());
  return Recording::open(files);
}

Result<Recording> open_readable(const std::string& path) {
  Recording recording = DSSM_TRY(Recording::open(path));
  const std::vector<std::string> warnings = recording.warnings();
  if (recording.streams().empty() && !warnings.empty()) {
    return Error{Errc::not_found, fmt::format("'{}' has no stream that can be read; {}",
                                              escaped(path), list_text(warnings))};
  }
  return recording;
}

Compression compression_of(const std::string& name) {
  return name == "none" ? Compression::none : name == "zstd" ? Compression::zstd : Compression::lz4;
}

void print_recording(const Recording& recording, const InfoOptions& options, Output& out) {
  const Sum sum = sum_of(recording);
  if (options.json) return print_json(recording, sum, out);
  print_text(recording, sum, options.iso, out);
  out.flush();
  for (const std::string& warning : recording.warnings()) {
    print_error(fmt::format("dssmctl: info: {}\n", escaped_message(warning)));
  }
}

}  // namespace dssm::ctl
