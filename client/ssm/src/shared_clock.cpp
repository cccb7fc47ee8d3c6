// SPDX-License-Identifier: Apache-2.0
#include "shared_clock.hpp"

#include "../include/libssm.h"

struct ssmtime* timecontrol = nullptr;

namespace dssm::ssm {
namespace {

ssmtime shown;  // what timecontrol points to

template <class T>
void store_changed(T& field, T value) noexcept {
  const std::atomic_ref shared(field);  // programs read it from any thread
  if (shared.load(std::memory_order_relaxed) == value) return;
  shared.store(value, std::memory_order_relaxed);
}

}  // namespace

SharedClock::Use::Use(SharedClock& owner_clock) noexcept : owner(owner_clock) {
  owner.users_.fetch_add(1);
  box = owner.current_.load();
}

SharedClock::Use::~Use() {
  if (owner.users_.fetch_sub(1) == 1 && owner.retired_.load()) ::sem_post(&owner.wake_);
}

void SharedClock::show(const PlaybackClock::Setting& setting) noexcept {
  store_changed(shown.offset, setting.offset_s);
  store_changed(shown.speed, setting.speed);
  store_changed(shown.is_pause, setting.paused ? 1 : 0);
  store_changed(shown.pausetime, setting.paused_at_s);
}

PlaybackClock::Setting SharedClock::setting() noexcept {
  const Use use(*this);
  if (!use.box) return {};
  const PlaybackClock::Setting setting = use.box->clock.setting();
  show(setting);
  return setting;
}

void SharedClock::attach(PlaybackClock clock, std::uint64_t process_generation) {
  show(clock.setting());
  boxes_ = new Box{std::move(clock), process_generation, boxes_};
  if (current_.exchange(boxes_)) retired_.store(true);
  std::atomic_ref(timecontrol).store(&shown);
}

void SharedClock::detach() noexcept {
  std::atomic_ref(timecontrol).store(nullptr);
  if (!current_.exchange(nullptr)) return;
  retired_.store(true);
  ::sem_post(&wake_);
}

void SharedClock::reap(std::uint64_t process_generation) {
  if (!retired_.load() || users_.load() > 0) return;
  retired_.store(false);
  const Box* const current = current_.load();
  for (Box** link = &boxes_; *link;) {
    Box* const box = *link;
    if (box == current || box->made_in != process_generation) {
      link = &box->next;
    } else {
      *link = box->next;
      delete box;
    }
  }
}

}  // namespace dssm::ssm
