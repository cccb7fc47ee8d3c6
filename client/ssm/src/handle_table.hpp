// SPDX-License-Identifier: Apache-2.0
//
// Objects that programs close in signal handlers, while the interrupted thread may be using them.
//
// A handle is a number: the place in the table, and a generation that is never used twice, so that
// a closed handle is always recognized. Places are never freed, only reused. close() only marks the
// place, and reap() destroys the object when its use count is 0. The order that makes this safe: a
// call increments the use count and then checks that the place is open; the reaper finds "closed"
// and then checks the use count. Both are seq_cst, so at least one of the two sees the other.
//
//   threads  Use and close() from any thread and from signal handlers; the rest under one lock
#pragma once

#include <semaphore.h>

#include <atomic>
#include <cstdint>
#include <memory>
#include <utility>

namespace dssm::ssm {

struct NothingKept {};

//   Kept  data of a place, which outlive its object
template <class Object, class Kept = NothingKept>
class HandleTable {
  struct Place {
    std::atomic<std::uint64_t> state{0};  // generation << 1 | open
    std::atomic<std::uint32_t> uses{0};
    Object* object = nullptr;   // owned; does not change while open or in use
    std::uint64_t made_in = 0;  // process generation that opened it
    [[no_unique_address]] Kept kept{};
    std::uint64_t index = 0;
    Place* next_free = nullptr;
  };

 public:
  using Handle = std::uint64_t;  // 0: none
  static constexpr std::uint64_t kIndexBits = 18, kGenerationBits = 28;

  // `wake` is posted when there is something to reap.
  explicit HandleTable(sem_t& wake) noexcept : wake_(wake) {}

  // A new handle for the object; 0 when 2^18 are open.
  Handle add(std::unique_ptr<Object> object, std::uint64_t process_generation) {
    if (!free_ && !grow()) return 0;
    Place& place = *free_;
    free_ = place.next_free;
    place.object = object.release();
    place.made_in = process_generation;
    std::uint64_t generation = (place.state.load() >> 1) + 1;
    if (generation >> kGenerationBits) generation = 1;
    place.state.store(open_state(generation));
    return generation << kIndexBits | place.index;
  }

  // Marks the object closed; nothing for a handle that is not open.
  void close(Handle handle) noexcept {
    Place* const place = find(handle);
    if (!place) return;
    std::uint64_t open = open_state(handle >> kIndexBits);
    if (place->state.compare_exchange_strong(open, open & ~kOpen)) ::sem_post(&wake_);
  }

  // Destroys the objects that are closed and whose use count is 0. Those of another process
  // generation belong to a parent process: they stay in their places, which are not reused.
  void reap(std::uint64_t process_generation) {
    for_each([&](Place& place) {
      if ((place.state.load() & kOpen) || place.uses.load() > 0) return;
      if (place.made_in != process_generation) return;
      delete std::exchange(place.object, nullptr);
      place.next_free = std::exchange(free_, &place);
    });
  }

  // Calls visit(object) with each object that is not destroyed.
  template <class Visit>
  void visit_objects(Visit visit) noexcept {
    for_each([&](Place& place) { visit(*place.object); });
  }

  // Holds a use: the object is not destroyed before this one.
  class Use {
   public:
    Use(HandleTable& table, Handle handle) noexcept : table_(table), place_(table.find(handle)) {
      if (!place_) return;
      place_->uses.fetch_add(1);
      if (place_->state.load() == open_state(handle >> kIndexBits)) return;
      table_.release(*place_);
      place_ = nullptr;
    }
    Use(const Use&) = delete;
    Use& operator=(const Use&) = delete;
    ~Use() {
      if (place_) table_.release(*place_);
    }

    // False: the handle was not open.
    explicit operator bool() const noexcept { return place_ != nullptr; }
    Object* operator->() const noexcept { return place_->object; }
    Object& operator*() const noexcept { return *place_->object; }
    Kept& kept() const noexcept { return place_->kept; }
    // Whether it was closed meanwhile.
    bool closed() const noexcept { return (place_->state.load() & kOpen) == 0; }

   private:
    HandleTable& table_;
    Place* place_;
  };

 private:
  static constexpr std::uint64_t kOpen = 1, kChunk = 256;

  static std::uint64_t open_state(std::uint64_t generation) noexcept {
    return generation << 1 | kOpen;
  }

  Place* find(Handle handle) const noexcept {
    if (handle >> (kIndexBits + kGenerationBits)) return nullptr;  // not one of ours
    const std::uint64_t index = handle & ((1ULL << kIndexBits) - 1);
    Place* const chunk = chunks_[index / kChunk].load(std::memory_order_acquire);
    return chunk ? &chunk[index % kChunk] : nullptr;
  }

  bool grow() {
    if (used_ == std::uint64_t{1} << kIndexBits) return false;
    Place* const chunk = new Place[kChunk];
    for (std::uint64_t i = kChunk; i-- > 0;) {
      chunk[i].index = used_ + i;
      chunk[i].next_free = std::exchange(free_, &chunk[i]);
    }
    chunks_[used_ / kChunk].store(chunk, std::memory_order_release);
    used_ += kChunk;
    return true;
  }

  void release(Place& place) noexcept {
    if (place.uses.fetch_sub(1) == 1 && (place.state.load() & kOpen) == 0) ::sem_post(&wake_);
  }

  template <class Visit>
  void for_each(Visit visit) noexcept {
    for (std::uint64_t i = 0; i < used_; ++i) {
      Place& place = chunks_[i / kChunk].load(std::memory_order_relaxed)[i % kChunk];
      if (place.object) visit(place);
    }
  }

  sem_t& wake_;
  std::atomic<Place*> chunks_[(1 << kIndexBits) / kChunk]{};
  std::uint64_t used_ = 0;  // places ever used
  Place* free_ = nullptr;
};

}  // namespace dssm::ssm
