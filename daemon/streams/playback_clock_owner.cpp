// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/playback_clock_owner.hpp"

#include "core/base/sealed_memory.hpp"
#include "core/base/try.hpp"
#include "core/clock/playback_record.hpp"
#include "daemon/streams/memory_files.hpp"

namespace dssm::daemon {

Result<void> PlaybackClockOwner::adopt_untrusted(UniqueFd offered) {
  if (clock_) {
    if (same_file(offered.get(), clock_.get())) return {};
    return Error{Errc::conflict, "another playback clock is in use by now"};
  }
  DSSM_TRY(check_own_memory_file(offered.get(), kSizeSeals, "playback clock"));
  DSSM_TRY(clock::PlaybackRecord::open_untrusted(offered.get()));
  take(std::move(offered));
  return {};
}

Result<UniqueFd> PlaybackClockOwner::get() {
  if (!clock_) {
    take(DSSM_TRY(clock::create_playback_clock()));
  }
  return duplicate(clock_.get());
}

void PlaybackClockOwner::take(UniqueFd clock) {
  clock_ = std::move(clock);
  if (on_new_clock_) on_new_clock_(clock_.get());
}

}  // namespace dssm::daemon
