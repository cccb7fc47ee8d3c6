// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/recording_folder.hpp"

#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>
#include <array>
#include <ctime>
#include <dssm/recording.hpp>
#include <system_error>
#include <tuple>
#include <vector>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

namespace fs = std::filesystem;

// So much of the quota may be written between two checks, and twice that stays free at each.
constexpr std::uint64_t kPartsOfQuota = 64;
constexpr std::size_t kMaxTriggerBytes = 64;  // in a file's name
constexpr const char* kPatterns[] = {
    "dssm_[0-9][0-9][0-9][0-9]_[0-9][0-9]_[0-9][0-9]-*.mcap",
    "incident_[0-9][0-9][0-9][0-9]_[0-9][0-9]_[0-9][0-9]-*.mcap",
};

std::string date_text(Time time) {
  const std::time_t seconds = static_cast<std::time_t>(to_ns(time) / 1'000'000'000);
  std::tm local{};
  ::localtime_r(&seconds, &local);
  std::array<char, 64> text{};
  return {text.data(), std::strftime(text.data(), text.size(), "%Y_%m_%d-%H_%M_%S", &local)};
}

Error folder_error(const fs::path& folder, const std::string& what, std::error_code error) {
  Errc code = Errc::system;
  if (error == std::errc::no_such_file_or_directory) code = Errc::not_found;
  if (error == std::errc::permission_denied) code = Errc::no_permission;
  return {code, fmt::format("{} in '{}': {}", what, folder.string(), error.message())};
}

struct RecordingFile {
  fs::file_time_type time;
  fs::path path;
  std::uint64_t bytes = 0;
};

// The recordings of `folder`, the oldest first.
Result<std::vector<RecordingFile>> files_of(const fs::path& folder) {
  std::vector<RecordingFile> files;
  std::error_code error;
  fs::directory_iterator entry(folder, error);
  for (; !error && entry != fs::directory_iterator(); entry.increment(error)) {
    const std::string name = entry->path().filename();
    if (std::none_of(std::begin(kPatterns), std::end(kPatterns), [&](const char* pattern) {
          return ::fnmatch(pattern, name.c_str(), 0) == 0;
        })) {
      continue;
    }
    std::error_code gone;  // another process deletes it at this moment
    RecordingFile file{entry->last_write_time(gone), entry->path(), 0};
    if (!gone) file.bytes = entry->file_size(gone);
    if (!gone && entry->is_regular_file(gone)) files.push_back(std::move(file));
  }
  if (error) return folder_error(folder, "list the recordings", error);
  std::ranges::sort(files, {},
                    [](const RecordingFile& file) { return std::tie(file.time, file.path); });
  return files;
}

}  // namespace

std::string recording_name(Time time) { return fmt::format("dssm_{}.mcap", date_text(time)); }

std::string incident_name(Time time, std::string_view trigger) {
  std::string name(trigger.substr(0, kMaxTriggerBytes));
  for (char& c : name) {
    const bool is_plain = (c >= 'a' && c <= 'z') || (c >= 'A' && c <= 'Z') ||
                          (c >= '0' && c <= '9') || c == '-' || c == '.';
    if (!is_plain) c = '_';
  }
  return fmt::format("incident_{}_{}.mcap", date_text(time), name);
}

Result<void> RecordingFolder::make_room(std::uint64_t written_bytes) {
  const std::uint64_t part = quota_bytes_ / kPartsOfQuota;
  if (checked_at_bytes_ && (quota_bytes_ == 0 || written_bytes < *checked_at_bytes_ + part)) {
    return {};
  }
  checked_at_bytes_ = written_bytes;
  std::vector<RecordingFile> files = DSSM_TRY(files_of(folder_));
  if (quota_bytes_ == 0) return {};
  // The clock may have been set, or have been wrong since the PC's start.
  for (const RecordingFile& file : files) first_seen_.try_emplace(file.path, first_seen_.size());
  std::ranges::sort(files, {}, [this](const auto& file) { return first_seen_.at(file.path); });
  std::uint64_t total = 0;
  for (const RecordingFile& file : files) total += file.bytes;
  for (std::size_t i = 0; i + 1 < files.size() && total > quota_bytes_ - 2 * part; ++i) {
    std::error_code error;
    fs::remove(files[i].path, error);
    if (error) {
      return folder_error(folder_,
                          fmt::format("delete '{}' to keep the quota of {} bytes",
                                      files[i].path.filename().string(), quota_bytes_),
                          error);
    }
    total -= files[i].bytes;
    notices_.push_back(
        fmt::format("'{}' is deleted, because of --quota", escaped(files[i].path.string())));
  }
  return {};
}

Result<std::filesystem::path> RecordingFolder::repair_newest() const {
  const std::vector<RecordingFile> files = DSSM_TRY(files_of(folder_));
  if (files.empty()) return fs::path();
  const RecordingRepair repair = DSSM_TRY(repair_recording(files.back().path));
  return repair.was_whole ? fs::path() : files.back().path;
}

}  // namespace dssm::ctl
