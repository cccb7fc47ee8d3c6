// SPDX-License-Identifier: Apache-2.0
#include "core/clock/playback_record.hpp"

#include <fmt/core.h>

#include "core/base/try.hpp"

namespace dssm::clock {

Result<UniqueFd> create_playback_clock() {
  const std::string what = "create the playback clock";
  UniqueFd fd =
      DSSM_TRY(create_sealed_memory("dssm-playback-clock", system_page_bytes(), 0600), what);
  const SharedMapping mapping = DSSM_TRY(
      SharedMapping::map_sealed_untrusted(fd.get(), system_page_bytes(), "playback clock"), what);
  auto& page = mapping.as<PlaybackPage>();
  page.setting.store({});
  page.layout_version = PlaybackPage::kLayoutVersion;
  page.magic = PlaybackPage::kMagic;
  return fd;
}

Result<std::shared_ptr<PlaybackRecord>> PlaybackRecord::open_untrusted(int fd) {
  SharedMapping mapping =
      DSSM_TRY(SharedMapping::map_sealed_untrusted(fd, system_page_bytes(), "playback clock"));
  const auto& page = mapping.as<PlaybackPage>();
  if (page.magic != PlaybackPage::kMagic || page.layout_version != PlaybackPage::kLayoutVersion) {
    return Error{Errc::protocol, fmt::format("this is not a playback clock of layout version {}",
                                             PlaybackPage::kLayoutVersion)};
  }
  ring::RobustLock lock = DSSM_TRY(ring::RobustLock::map(fd));
  return std::shared_ptr<PlaybackRecord>(new PlaybackRecord(std::move(mapping), std::move(lock)));
}

PlaybackSetting PlaybackRecord::load() const noexcept {
  PlaybackSetting setting;
  page().setting.load(setting);
  return setting;
}

}  // namespace dssm::clock
