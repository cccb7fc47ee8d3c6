// SPDX-License-Identifier: Apache-2.0
//
// Recordings of what the rings hold of a range of time, which pages ask for and download: made as
// by `dssmctl record --past`, so no writer waits. They are in a folder of this process, which is
// removed with it.
#pragma once

#include <atomic>
#include <cstdint>
#include <deque>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <filesystem>
#include <functional>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "client/view/server.hpp"
#include "client/view/worker.hpp"

namespace dssm::view {

// What is to be saved.
struct WantedRange {
  std::vector<std::string> streams;  // full names; empty: all
  Time first{}, last{};
};

struct SavedRange {
  std::string path;  // of the file, at the server: "/saved/1/dssm_2026_11_28-12_30_00.mcap"
  std::size_t streams = 0;
  RecordingProgress progress;
  std::vector<std::string> notices;  // what is missing, and why; for people
};

class Saver {
 public:
  // Before server.listen(). `server` outlives it.
  Saver(Session session, Server& server);
  Saver(const Saver&) = delete;
  Saver& operator=(const Saver&) = delete;
  ~Saver();  // ends what is being saved

  // Calls `done` in the server's thread, which is the one that calls this, with the result.
  //   fails  conflict (another range is being saved), no_memory (the disk has less than 1 GiB
  //          left), no_permission, unavailable (dssmd does not answer), system
  using Done = std::function<void(const Result<SavedRange>&)>;
  void save(WantedRange range, Done done);

 private:
  static constexpr std::size_t kMaxFiles = 4;             // with more, the oldest is deleted
  static constexpr std::uintmax_t kFreeBytes = 1U << 30;  // of the disk; what others need

  Result<SavedRange> record(const WantedRange& range, std::uint64_t number);  // the worker's

  Session session_;
  Server& server_;
  std::optional<Error> folder_error_;
  std::filesystem::path folder_;  // empty: there is none
  int lock_ = -1;                 // of the folder: systemd-tmpfiles leaves it alone
  bool is_saving_ = false;
  std::uint64_t last_number_ = 0;
  std::deque<std::filesystem::path> saved_;  // folders with one recording each
  std::atomic<bool> is_ending_ = false;
  std::optional<Worker> worker_{std::in_place};  // until the folder is removed
};

}  // namespace dssm::view
