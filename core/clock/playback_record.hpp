// SPDX-License-Identifier: Apache-2.0
//
// The playback clock's shared segment: one setting for all programs of this PC, replaced as a
// whole. Two records take turns; `generation` says which one counts (generation % 2). A setter
// fills the other one under a robust lock and then raises the generation, so readers never see a
// mix, never wait, and a setter killed half-way has changed nothing.
#pragma once

#include <pthread.h>

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <memory>

#include "core/base/unique_fd.hpp"

namespace dssm::clock {

struct PlaybackSetting {
  double offset_s = 0;
  double speed = 1;
  bool paused = false;
  double paused_at_s = 0;

  // SSM time when the real time is `real_s` (both seconds since 1970).
  double at(double real_s) const noexcept {
    return paused ? paused_at_s : speed * real_s + offset_s;
  }
};

// Layout version 1, one page, little endian; doubles as their bits.
struct PlaybackPage {
  static constexpr std::uint64_t kMagic = 0x4b434f4c43534d44;  // "DMSCLOCK"
  static constexpr std::uint32_t kLayoutVersion = 1;
  struct Record {
    std::atomic<std::uint64_t> offset_bits, speed_bits, paused, paused_at_bits;
  };
  std::uint64_t magic;
  std::uint32_t layout_version;
  std::uint32_t reserved0;
  std::atomic<std::uint64_t> generation;
  std::byte reserved1[40];
  Record records[2];
  union {
    pthread_mutex_t lock;
    std::byte lock_bytes[64];
  };
  std::byte reserved2[4096 - 192];
};
static_assert(offsetof(PlaybackPage, records) == 64 && offsetof(PlaybackPage, lock) == 128);
static_assert(sizeof(PlaybackPage) == 4096);

// Creates the segment (sealed memfd, mode 0600) with the default setting.
Result<UniqueFd> create_playback_clock();

// A mapped segment. Thread-safe; readers are async-signal-safe.
class PlaybackRecord {
 public:
  // Fails with `protocol` when `fd` is no such segment. Does not keep `fd`.
  static Result<std::shared_ptr<PlaybackRecord>> open_untrusted(int fd);
  PlaybackRecord(const PlaybackRecord&) = delete;
  PlaybackRecord& operator=(const PlaybackRecord&) = delete;
  ~PlaybackRecord();

  PlaybackSetting load() const noexcept;

  // Replaces the setting by change(setting), under the lock. False, and nothing is changed, when a
  // program has damaged the lock.
  template <class Change>
  bool update(Change change) noexcept {
    if (!lock()) return false;
    store(change(load()));
    unlock();
    return true;
  }

 private:
  PlaybackRecord() = default;
  bool lock() noexcept;
  void unlock() noexcept;
  void store(const PlaybackSetting& setting) noexcept;
  PlaybackPage* page_ = nullptr;
};

}  // namespace dssm::clock
