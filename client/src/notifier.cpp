// SPDX-License-Identifier: Apache-2.0
#include "client/src/notifier.hpp"

#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>

#include "client/src/lockstep.hpp"
#include "client/src/states.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/try.hpp"

namespace dssm::detail {

std::shared_ptr<const SharedRing> ReadyFd::ring() {
  const std::lock_guard guard(mutex_);
  return ring_.ring;
}

bool ReadyFd::poll() noexcept {
  const std::lock_guard guard(mutex_);
  const ring::RingReader reader(*ring_.ring->mapping);
  const Tid newest = reader.newest(), hole_end = reader.hole().end;
  const MonoTime now = MonoClock::now();
  const bool restarts = ring_.superseded->load(std::memory_order_acquire) && now >= next_restart_;
  if (newest <= ring_.seen && hole_end == seen_hole_end_ && !restarts) return false;
  ring_.seen = newest;
  seen_hole_end_ = hole_end;
  times_ = times();
  if (restarts) {
    if (superseded_since_ == MonoTime{}) superseded_since_ = now;
    next_restart_ = now + std::clamp<Duration>(now - superseded_since_, kRestartPause,
                                               ring::SleepTimes::kMaxSleep);
  }
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(event_.get(), &one, sizeof one);
  return true;
}

void ReadyFd::follow(ReadyRing ring) {
  const std::lock_guard guard(mutex_);
  ring_ = std::move(ring);
  superseded_since_ = next_restart_ = MonoTime{};
  times_ = times();
}

Duration ReadyFd::next_sleep(MonoTime now) noexcept {
  const std::lock_guard guard(mutex_);
  const Duration sleep = times_.next(now);
  return superseded_since_ == MonoTime{}
             ? sleep
             : std::min(sleep, std::max(next_restart_ - now, Duration::zero()));
}

void ReadyFd::clear() noexcept {
  std::uint64_t count = 0;
  [[maybe_unused]] const ssize_t got = ::read(event_.get(), &count, sizeof count);
}

Result<std::unique_ptr<Notifier>> Notifier::start() {
  const UniqueFd fd = DSSM_TRY(ring::create_bell("notifier"));
  std::unique_ptr<Notifier> notifier(new Notifier);
  notifier->control_ = DSSM_TRY(ring::Bell::open_untrusted(fd.get()));
  notifier->thread_ =
      DSSM_TRY(quiet_thread("pollable descriptors", [self = notifier.get()] { self->run(); }));
  return notifier;
}

Notifier::~Notifier() {
  {
    const std::lock_guard guard(mutex_);
    stopping_ = true;
  }
  wake();
  thread_.join();
}

bool Notifier::add(const std::shared_ptr<ReadyFd>& ready) {
  {
    const std::lock_guard guard(mutex_);
    std::erase_if(watched_, [](const auto& entry) { return entry.expired(); });
    if (watched_.size() == kMaxWatched) return false;
    watched_.push_back(ready);
  }
  wake();
  return true;
}

void Notifier::wake() noexcept {
  wakes_.fetch_add(1);
  control_->notify();
  if (Lockstep* const lockstep = Lockstep::of_process()) lockstep->recheck();
}

void Notifier::run() {
  Lockstep* const lockstep = Lockstep::of_process();
  std::vector<std::shared_ptr<ReadyFd>> awake;
  std::vector<std::shared_ptr<const SharedRing>> rings;  // what the bells belong to
  std::vector<ring::Bell*> bells;
  std::vector<std::uint32_t> announced;
  for (;;) {
    awake.clear(), rings.clear(), bells.clear(), announced.clear();
    // Announce before polling, so that no change in between is missed.
    bells.push_back(control_.get());
    announced.push_back(control_->announce());
    const std::uint32_t wakes = wakes_.load();
    {
      const std::lock_guard guard(mutex_);
      if (stopping_) return;
      for (const auto& entry : watched_) {
        if (auto ready = entry.lock()) awake.push_back(std::move(ready));
      }
    }
    bool changed = false;
    Duration sleep = ring::SleepTimes::kMaxSleep;
    for (const auto& ready : awake) {
      rings.push_back(ready->ring());
      bells.push_back(rings.back()->bell.get());
      announced.push_back(bells.back()->announce());
      changed |= ready->poll();
      sleep = std::min(sleep, ready->next_sleep(MonoClock::now()));
    }
    if (changed) continue;
    // Rings of readers that are destroyed meanwhile stay mapped until the next wake-up.
    const auto has_changed = [&] {
      return wakes_.load() != wakes ||
             std::count_if(awake.begin(), awake.end(),
                           [](const auto& ready) { return ready->poll(); }) > 0;
    };
    if (lockstep && lockstep->wait_until(kNever, has_changed)) continue;
    [[maybe_unused]] const WaitStatus woken =
        ring::Bell::sleep_any(bells, announced, kNever, sleep);
  }
}

void NotifierPool::follow(ReadyFd& ready, ReadyRing ring) {
  ready.follow(std::move(ring));
  const std::lock_guard guard(mutex_);
  for (const auto& notifier : notifiers_) notifier->wake();
}

Result<std::shared_ptr<ReadyFd>> NotifierPool::watch(ReadyRing ring) {
  UniqueFd event(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
  if (!event) return os_error("create an eventfd for a reader");
  auto ready = std::make_shared<ReadyFd>(std::move(ring), std::move(event));
  const std::lock_guard guard(mutex_);
  for (const auto& notifier : notifiers_) {
    if (notifier->add(ready)) return ready;
  }
  notifiers_.push_back(DSSM_TRY(Notifier::start()));
  notifiers_.back()->add(ready);
  return ready;
}

}  // namespace dssm::detail
