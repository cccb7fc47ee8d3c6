// SPDX-License-Identifier: Apache-2.0
//
// The playback clock that this process has attached, or none, and the `timecontrol` of <libssm.h>.
// endSSM detaches it from a signal handler while the interrupted thread may be reading it, so a
// detached clock is destroyed only when its use count is 0: the same order as in sid_table.hpp.
//
//   threads  attach() and reap() under one lock; the rest from any thread and from signal handlers
#pragma once

#include <semaphore.h>

#include <atomic>
#include <cstdint>
#include <dssm/playback_clock.hpp>

namespace dssm::ssm {

class SharedClock {
 public:
  // `wake` is posted when there is something to reap.
  explicit SharedClock(sem_t& wake) noexcept : wake_(wake) {}

  bool attached() const noexcept { return current_.load() != nullptr; }
  void attach(PlaybackClock clock, std::uint64_t process_generation);
  void detach() noexcept;

  // The setting, which is also shown through timecontrol; offset 0, speed 1 without a clock.
  PlaybackClock::Setting setting() noexcept;

  // Calls change(clock); false without one.
  template <class Change>
  bool update(Change change) noexcept {
    const Use use(*this);
    if (!use.box) return false;
    change(use.box->clock);
    show(use.box->clock.setting());
    return true;
  }

  // Destroys detached clocks when none is in use; keeps those that a parent process attached.
  void reap(std::uint64_t process_generation);

 private:
  struct Box {
    PlaybackClock clock;
    std::uint64_t made_in;
    Box* next;
  };

  // Holds a use: the box is not destroyed before this object.
  struct Use {
    explicit Use(SharedClock& owner_clock) noexcept;
    Use(const Use&) = delete;
    Use& operator=(const Use&) = delete;
    ~Use();
    SharedClock& owner;
    Box* box;  // nullptr: none attached
  };

  static void show(const PlaybackClock::Setting& setting) noexcept;

  sem_t& wake_;
  std::atomic<Box*> current_{nullptr};
  std::atomic<std::uint32_t> users_{0};
  std::atomic<bool> retired_{false};  // there are boxes that are not current
  Box* boxes_ = nullptr;              // all
};

}  // namespace dssm::ssm
