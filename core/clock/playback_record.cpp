// SPDX-License-Identifier: Apache-2.0
#include "core/clock/playback_record.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <bit>

#include "core/ring/robust_lock.hpp"

namespace dssm::clock {
namespace {

constexpr int kSeals = F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL;

void store_record(PlaybackPage::Record& record, const PlaybackSetting& setting) noexcept {
  // Release: a reader that sees any of these sees the generation that was current before them, and
  // tries again; pairs with the acquire loads in load().
  record.offset_bits.store(std::bit_cast<std::uint64_t>(setting.offset_s),
                           std::memory_order_release);
  record.speed_bits.store(std::bit_cast<std::uint64_t>(setting.speed), std::memory_order_release);
  record.paused.store(setting.paused ? 1 : 0, std::memory_order_release);
  record.paused_at_bits.store(std::bit_cast<std::uint64_t>(setting.paused_at_s),
                              std::memory_order_release);
}

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
  store_record(page.records[0], PlaybackSetting{});
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
    return Error{Errc::protocol, "this is no playback clock: no sealed memory file of one page"};
  }
  void* memory = ::mmap(nullptr, sizeof(PlaybackPage), PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0);
  if (memory == MAP_FAILED) return os_error("map the playback clock");
  std::shared_ptr<PlaybackRecord> record(new PlaybackRecord);
  record->page_ = static_cast<PlaybackPage*>(memory);
  if (record->page_->magic != PlaybackPage::kMagic ||
      record->page_->layout_version != PlaybackPage::kLayoutVersion) {
    return Error{Errc::protocol, "this is no playback clock of layout version 1"};
  }
  return record;
}

PlaybackRecord::~PlaybackRecord() {
  if (page_) ::munmap(page_, sizeof(PlaybackPage));
}

PlaybackSetting PlaybackRecord::load() const noexcept {
  for (;;) {
    const std::uint64_t generation = page_->generation.load(std::memory_order_acquire);
    const PlaybackPage::Record& record = page_->records[generation % 2];
    PlaybackSetting setting;
    setting.offset_s = std::bit_cast<double>(record.offset_bits.load(std::memory_order_acquire));
    setting.speed = std::bit_cast<double>(record.speed_bits.load(std::memory_order_acquire));
    setting.paused = record.paused.load(std::memory_order_acquire) != 0;
    setting.paused_at_s =
        std::bit_cast<double>(record.paused_at_bits.load(std::memory_order_acquire));
    // This record is written again only after the generation moved on, so an unchanged one means
    // that all four belong together. Only two whole updates during four loads lead to another
    // round.
    if (page_->generation.load(std::memory_order_relaxed) == generation) return setting;
  }
}

void PlaybackRecord::store(const PlaybackSetting& setting) noexcept {
  const std::uint64_t next = page_->generation.load(std::memory_order_relaxed) + 1;
  store_record(page_->records[next % 2], setting);
  page_->generation.store(next, std::memory_order_release);
}

bool PlaybackRecord::lock() noexcept {
  // Whatever its last holder left, `generation` still names a whole record: nothing to repair.
  return ring::lock_robust(page_->lock) != ring::LockResult::refused;
}

void PlaybackRecord::unlock() noexcept { pthread_mutex_unlock(&page_->lock); }

}  // namespace dssm::clock
