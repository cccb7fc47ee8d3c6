// SPDX-License-Identifier: Apache-2.0
#include "client/view/saver.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <stdlib.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <memory>
#include <system_error>
#include <thread>

#include "client/dssmctl/names.hpp"
#include "client/dssmctl/recorder.hpp"
#include "client/dssmctl/recording_folder.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

constexpr const char* kSavedPath = "/saved";

// /var/tmp, unlike /tmp, is on a disk everywhere.
std::filesystem::path temporary_folder() {
  const char* folder = std::getenv("TMPDIR");  // NOLINT(concurrency-mt-unsafe): nothing sets it
  return folder == nullptr || *folder == '\0' ? "/var/tmp" : folder;
}

}  // namespace

Saver::Saver(Session session, Server& server) : session_(std::move(session)), server_(server) {
  std::string name = (temporary_folder() / "dssm-view-XXXXXX").string();
  if (::mkdtemp(name.data()) == nullptr) {
    folder_error_ = Error{Errc::system, fmt::format("create the folder '{}' for recordings: {}",
                                                    name, std::generic_category().message(errno))};
    return;
  }
  folder_ = name;
  lock_ = ::open(name.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  ::flock(lock_, LOCK_SH | LOCK_NB);
  server_.serve_folder(kSavedPath, folder_, ".mcap", "application/octet-stream");
}

Saver::~Saver() {
  is_ending_ = true;
  worker_.reset();
  std::error_code ignored;
  if (!folder_.empty()) std::filesystem::remove_all(folder_, ignored);
  if (lock_ >= 0) ::close(lock_);
}

void Saver::save(WantedRange range, Done done) {
  if (folder_error_) return done(*folder_error_);
  if (is_saving_) {
    return done(Error{Errc::conflict, "another range is being saved; try again in a moment"});
  }
  is_saving_ = true;
  std::error_code ignored;
  if (saved_.size() == kMaxFiles) {
    std::filesystem::remove_all(saved_.front(), ignored);
    saved_.pop_front();
  }
  worker_->add([this, range = std::move(range), done = std::move(done), number = ++last_number_] {
    const Result<SavedRange> saved = record(range, number);
    server_.post([this, saved, done, number] {
      is_saving_ = false;
      const std::filesystem::path folder = folder_ / std::to_string(number);
      if (saved) {
        saved_.push_back(folder);
      } else {
        std::error_code unused;
        std::filesystem::remove_all(folder, unused);
      }
      done(saved);
    });
  });
}

Result<SavedRange> Saver::record(const WantedRange& range, std::uint64_t number) {
  std::vector<std::string> patterns;
  for (const std::string& name : range.streams) patterns.push_back(ctl::pattern_of(name));
  ctl::RecorderPlan plan{ctl::StreamFilter({}, std::move(patterns)), {}, {}, {}, false};
  plan.range = {range.first, range.last};
  const std::filesystem::path folder = folder_ / std::to_string(number);
  const std::string name = ctl::recording_name(WallClock::now());
  std::error_code failed;
  std::filesystem::create_directory(folder, failed);
  if (failed) {
    return Error{Errc::system,
                 fmt::format("create the folder '{}': {}", folder.string(), failed.message())};
  }
  RecordingWriter file = DSSM_TRY(RecordingWriter::create(folder / name));
  const std::unique_ptr<ctl::Recorder> recorder =
      DSSM_TRY(ctl::Recorder::start(session_, std::move(file), plan));
  SavedRange saved;
  while (true) {
    DSSM_TRY(recorder->take());
    if (is_ending_) return Error{Errc::unavailable, "dssm-view ends"};
    if (std::filesystem::space(folder, failed).available < kFreeBytes) {
      return Error{Errc::no_memory,
                   fmt::format("the disk of '{}' has less than 1 GiB left", folder_.string())};
    }
    if (recorder->has_past()) break;
    if (recorder->is_past_late()) {
      saved.notices.emplace_back("not all of the past has come; is another host slow or silent?");
      break;
    }
    std::this_thread::sleep_until(recorder->next_take());
  }
  DSSM_TRY(recorder->finish());
  for (std::string& notice : recorder->take_notices()) saved.notices.push_back(std::move(notice));
  if (const auto hosts = session_.list_hosts(); hosts && range.streams.empty()) {
    for (const HostInfo& host : *hosts) {
      if (host.state != HostState::down || host.name.empty()) continue;
      saved.notices.push_back(
          fmt::format("host '{}' is down: its streams are not in the recording", host.name));
    }
  }
  saved.path = fmt::format("{}/{}/{}", kSavedPath, number, name);
  saved.streams = recorder->streams();
  saved.progress = recorder->progress();
  return saved;
}

}  // namespace dssm::view
