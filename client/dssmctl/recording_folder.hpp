// SPDX-License-Identifier: Apache-2.0
//
// The folder in which a recorder keeps its recordings: their names, and how much they take.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <filesystem>
#include <map>
#include <optional>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace dssm::ctl {

// "dssm_2026_11_27-12_30_00.mcap", as ROS 2 names its recordings, in local time.
std::string recording_name(Time time);
// "incident_2026_11_27-12_30_00_NAME.mcap". What is not a letter, a digit, '-' or '.' of the
// trigger's name is '_', and at most 64 bytes of it are kept.
std::string incident_name(Time time, std::string_view trigger);

// Limits the recordings of one folder: the files with names as above, and the "_1", "_2" ... that
// follow them. Others are left alone. A value; one thread.
class RecordingFolder {
 public:
  //   quota_bytes  of all recordings in the folder; 0: no limit
  RecordingFolder(std::filesystem::path folder, std::uint64_t quota_bytes)
      : folder_(std::move(folder)), quota_bytes_(quota_bytes) {}

  const std::filesystem::path& path() const { return folder_; }

  // Deletes the oldest recordings until the others leave some of the quota free, but never the
  // newest one, which may be open for writing. What was there at the first call is older than what
  // came later, whatever the files' times say. Does nothing while little was written since the last
  // call; the first one finds out whether the folder can be read.
  //   written_bytes  to the folder since this object exists
  //   fails          not_found, no_permission, system (the folder cannot be read, or a file not be
  //                  deleted)
  Result<void> make_room(std::uint64_t written_bytes);

  // What was deleted since the last call, for people.
  std::vector<std::string> take_notices() { return std::exchange(notices_, {}); }

  // Completes the newest recording if its writer was killed.
  //   returns  its path; empty: there was nothing to do
  //   fails    as repair_recording() and make_room()
  Result<std::filesystem::path> repair_newest() const;

 private:
  std::filesystem::path folder_;
  std::uint64_t quota_bytes_;
  std::optional<std::uint64_t> checked_at_bytes_;
  std::map<std::filesystem::path, std::size_t> first_seen_;  // with which number
  std::vector<std::string> notices_;
};

}  // namespace dssm::ctl
