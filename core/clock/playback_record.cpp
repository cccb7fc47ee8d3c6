// SPDX-License-Identifier: Apache-2.0
#include "core/clock/playback_record.hpp"

#include <fcntl.h>
#include <fmt/core.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/ring/robust_lock.hpp"

namespace dssm::clock {
namespace {

constexpr int kSeals = F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL;

}  // namespace

Result<UniqueFd> create_playback_clock() {
  UniqueFd fd(::memfd_create("dssm-playback-clock", MFD_CLOEXEC | MFD_ALLOW_SEALING));
  if (!fd) return os_error("create the playback clock: memfd_create");
  if (::ftruncate(fd.get(), sizeof(PlaybackPage)) || ::fchmod(fd.get(), 0600) ||
      ::fcntl(fd.get(), F_ADD_SEALS, kSeals)) {
    return os_error("create the playback clock");
  }
  void* memory =
      ::mmap(nullptr, sizeof(PlaybackPage), PROT_READ | PROT_WRITE, MAP_SHARED, fd.get(), 0);
  if (memory == MAP_FAILED) return os_error("map the playback clock");
  auto& page = *static_cast<PlaybackPage*>(memory);
  page.setting.store({});
  ring::init_robust_lock(page.lock);
  page.layout_version = PlaybackPage::kLayoutVersion;
  page.magic = PlaybackPage::kMagic;
  ::munmap(memory, sizeof(PlaybackPage));
  return fd;
}

Result<std::shared_ptr<PlaybackRecord>> PlaybackRecord::open_untrusted(int fd) {
  struct stat file {};
  const int seals = ::fcntl(fd, F_GET_SEALS);
  if (seals < 0 || (seals & kSeals) != kSeals || ::fstat(fd, &file) ||
      file.st_size != sizeof(PlaybackPage)) {
    return Error{Errc::protocol,
                 "this is not a playback clock: not a sealed memory file of one page"};
  }
  void* memory = ::mmap(nullptr, sizeof(PlaybackPage), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) return os_error("map the playback clock");
  std::shared_ptr<PlaybackRecord> record(new PlaybackRecord);
  record->page_ = static_cast<PlaybackPage*>(memory);
  if (record->page_->magic != PlaybackPage::kMagic ||
      record->page_->layout_version != PlaybackPage::kLayoutVersion) {
    return Error{Errc::protocol, fmt::format("this is not a playback clock of layout version {}",
                                             PlaybackPage::kLayoutVersion)};
  }
  return record;
}

PlaybackRecord::~PlaybackRecord() {
  if (page_) ::munmap(page_, sizeof(PlaybackPage));
}

PlaybackSetting PlaybackRecord::load() const noexcept {
  PlaybackSetting setting;
  page_->setting.load(setting);
  return setting;
}

bool PlaybackRecord::lock() noexcept {
  // A holder that died left a complete setting: nothing to repair.
  return ring::lock_robust(page_->lock) != ring::LockResult::refused;
}

void PlaybackRecord::unlock() noexcept { pthread_mutex_unlock(&page_->lock); }

}  // namespace dssm::clock
