// SPDX-License-Identifier: Apache-2.0
//
// The playback clock's shared segment: one setting for all programs of this PC, a SharedSnapshot.
// Any of them may replace it, one at a time, under a robust lock.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <memory>
#include <utility>

#include "core/base/sealed_memory.hpp"
#include "core/base/shared_snapshot.hpp"
#include "core/ring/robust_lock.hpp"

namespace dssm::clock {

// How the clock runs.
struct PlaybackRun {
  double offset_s = 0;
  double speed = 1;
  std::uint64_t paused = 0;  // not 0: it is
  double paused_at_s = 0;

  // SSM time when the real time is `real_s` (both seconds since 1970).
  double at(double real_s) const noexcept {
    return paused ? paused_at_s : speed * real_s + offset_s;
  }
};

// As it is in the segment: a change at a real time, which may be to come, so that several hosts
// can make it at the same moment.
struct PlaybackSetting {
  PlaybackRun run;          // from change_s on
  double change_s = 0;      // real time; 0: long ago
  PlaybackRun before = {};  // until then

  const PlaybackRun& run_at(double real_s) const noexcept {
    return real_s < change_s ? before : run;
  }
  double at(double real_s) const noexcept { return run_at(real_s).at(real_s); }
};

// Little endian; in one page of the system. The settings are at 64 and 136, the lock is in the
// page's last bytes (robust_lock.hpp).
struct PlaybackPage {
  static constexpr std::uint64_t kMagic = 0x59414c504d535344;  // "DSSMPLAY"
  static constexpr std::uint32_t kLayoutVersion = 4;
  std::uint64_t magic;
  std::uint32_t layout_version;
  std::uint32_t reserved0;
  std::byte reserved1[40];
  SharedSnapshot<PlaybackSetting> setting;
};
static_assert(offsetof(PlaybackPage, setting) == 56 && sizeof(PlaybackPage) == 208);

// Creates the segment (sealed memfd, mode 0600) with the default setting.
Result<UniqueFd> create_playback_clock();

// A mapped segment. Thread-safe; readers are async-signal-safe.
class PlaybackRecord {
 public:
  // Fails with `protocol` when `fd` is no such segment. Does not keep `fd`.
  static Result<std::shared_ptr<PlaybackRecord>> open_untrusted(int fd);
  PlaybackRecord(const PlaybackRecord&) = delete;
  PlaybackRecord& operator=(const PlaybackRecord&) = delete;

  // Real time, where a hostile program keeps changing it.
  PlaybackSetting load() const noexcept;
  // load().at(real_s).
  double at(double real_s) const noexcept {
    PlaybackSetting setting;
    page().setting.load<offsetof(PlaybackSetting, before)>(setting);
    if (real_s < setting.change_s) setting = load();
    return setting.at(real_s);
  }

  // Replaces the setting by change(setting), under the lock. False, and the setting unchanged, when
  // it did not get the lock (RobustLock::kMaxWait).
  template <class Change>
  bool update(Change change) noexcept {
    return finish_update(lock_.lock(), change);
  }
  // The same without waiting for the lock.
  template <class Change>
  bool try_update(Change change) noexcept {
    return finish_update(lock_.try_lock(), change);
  }

 private:
  PlaybackRecord(SharedMapping mapping, ring::RobustLock lock) noexcept
      : mapping_(std::move(mapping)), lock_(std::move(lock)) {}
  template <class Change>
  bool finish_update(ring::LockResult locked, Change change) noexcept {
    if (locked == ring::LockResult::busy) return false;
    // A holder that died left a complete setting: nothing to repair.
    page().setting.store(change(load()));
    lock_.unlock();
    return true;
  }
  PlaybackPage& page() const noexcept { return mapping_.as<PlaybackPage>(); }
  SharedMapping mapping_;
  ring::RobustLock lock_;
};

}  // namespace dssm::clock
