// SPDX-License-Identifier: Apache-2.0
#include "core/clock/playback_record.hpp"

#include <fmt/core.h>

#include "core/base/try.hpp"
#include "core/ring/robust_lock.hpp"

namespace dssm::clock {

Result<UniqueFd> create_playback_clock() {
  const std::string what = "create the playback clock";
  UniqueFd fd =
      DSSM_TRY(create_sealed_memory("dssm-playback-clock", sizeof(PlaybackPage), 0600), what);
  const SharedMapping mapping = DSSM_TRY(
      SharedMapping::map_sealed_untrusted(fd.get(), sizeof(PlaybackPage), "playback clock"), what);
  auto& page = mapping.as<PlaybackPage>();
  page.setting.store({});
  ring::init_robust_lock(page.lock);
  page.layout_version = PlaybackPage::kLayoutVersion;
  page.magic = PlaybackPage::kMagic;
  return fd;
}

Result<std::shared_ptr<PlaybackRecord>> PlaybackRecord::open_untrusted(int fd) {
  SharedMapping mapping =
      DSSM_TRY(SharedMapping::map_sealed_untrusted(fd, sizeof(PlaybackPage), "playback clock"));
  const auto& page = mapping.as<PlaybackPage>();
  if (page.magic != PlaybackPage::kMagic || page.layout_version != PlaybackPage::kLayoutVersion) {
    return Error{Errc::protocol, fmt::format("this is not a playback clock of layout version {}",
                                             PlaybackPage::kLayoutVersion)};
  }
  return std::shared_ptr<PlaybackRecord>(new PlaybackRecord(std::move(mapping)));
}

PlaybackSetting PlaybackRecord::load() const noexcept {
  PlaybackSetting setting;
  page().setting.load(setting);
  return setting;
}

bool PlaybackRecord::lock() noexcept {
  // A holder that died left a complete setting: nothing to repair.
  return ring::lock_robust(page().lock) != ring::LockResult::refused;
}

void PlaybackRecord::unlock() noexcept { pthread_mutex_unlock(&page().lock); }

}  // namespace dssm::clock
