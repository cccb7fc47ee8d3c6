// SPDX-License-Identifier: Apache-2.0
//
// Objects that programs close in signal handlers, while the interrupted thread may be using them.
//
// A Use keeps an object from being destroyed; a Turn is also alone with it, as long as only one
// thread takes turns with it, which is what most programs do. Then it costs a few plain stores:
// what else would need an atomic operation for each call is left to those who come rarely, the
// reaper and the first other thread. They write a mark, make all threads of the process pass a
// barrier (membarrier(2)), and then see whether the thread is inside, while from now on it sees the
// mark. The other thread waits until it is outside; from then on all threads take turns as uses,
// and lock what they need. This is biased locking (Kawachiya et al., "Lock reservation", OOPSLA
// 2002), with the kernel's barrier in place of stopping the thread.
//
// A handle is a number: the place in the table, and a generation that is never used twice, so that
// a closed handle is always recognized. Places are never freed, only reused. close() only marks the
// place, and reap() destroys the object when its use count is 0. The order that makes this safe: a
// call increments the use count and then checks that the place is open; the reaper finds "closed"
// and then checks the use count. Both are seq_cst, so at least one of the two sees the other.
//
//   threads  Use, Turn and close() from any thread and from signal handlers; the rest under one
//            lock
#pragma once

#include <linux/membarrier.h>
#include <semaphore.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <atomic>
#include <cstdint>
#include <ctime>
#include <memory>
#include <utility>

#include "signal_safe.hpp"

namespace dssm::ssm {

struct NothingKept {};

//   Kept  data of a place, which outlive its object
template <class Object, class Kept = NothingKept>
class HandleTable {
  struct Place {
    std::atomic<std::uint64_t> state{0};  // generation << 1 | open
    std::atomic<std::uint32_t> uses{0};
    std::atomic<std::uint64_t> sole{0};    // the only thread that takes turns, kNobody or kShared
    std::atomic<std::uint32_t> inside{0};  // of that thread: kTrying, kInside + turns; it stores it
    bool was_closed = false;               // of the reaper: before its barrier
    Object* object = nullptr;              // owned; does not change while open or in use
    std::uint64_t made_in = 0;             // process generation that opened it
    [[no_unique_address]] Kept kept{};
    std::uint64_t index = 0;
    Place* next_free = nullptr;
  };

 public:
  using Handle = std::uint64_t;  // 0: none
  static constexpr std::uint64_t kIndexBits = 18, kGenerationBits = 28;

  // `wake` is posted when there is something to reap.
  explicit HandleTable(sem_t& wake) noexcept
      : wake_(wake), has_barrier_(barrier(MEMBARRIER_CMD_REGISTER_PRIVATE_EXPEDITED)) {}

  // A new handle for the object; 0 when 2^18 are open.
  Handle add(std::unique_ptr<Object> object, std::uint64_t process_generation) {
    if (!free_ && !grow()) return 0;
    Place& place = *free_;
    free_ = place.next_free;
    place.object = object.release();
    place.made_in = process_generation;
    place.sole.store(has_barrier_ ? kNobody : kShared);
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
    const auto may_be_reaped = [&](const Place& place) {
      return (place.state.load() & kOpen) == 0 && place.uses.load() == 0 &&
             place.made_in == process_generation;
    };
    bool is_any = false;
    for_each([&](Place& place) {
      place.was_closed = may_be_reaped(place);
      is_any = is_any || place.was_closed;
    });
    if (!is_any) return;
    if (has_barrier_) barrier(MEMBARRIER_CMD_PRIVATE_EXPEDITED);
    // Not those that are closed only now: who is inside of one may not be seen yet.
    for_each([&](Place& place) {
      if (!place.was_closed || !may_be_reaped(place)) return;
      if (place.inside.load(std::memory_order_acquire) > 0) return;
      delete std::exchange(place.object, nullptr);
      place.next_free = std::exchange(free_, &place);
    });
  }

  // In a forked child, whose only thread was `parents_thread` before: turns of other threads are
  // over. Calls visit(object) with each object that is not destroyed.
  template <class Visit>
  void reset_after_fork(int parents_thread, Visit visit) noexcept {
    has_barrier_ = barrier(MEMBARRIER_CMD_REGISTER_PRIVATE_EXPEDITED);
    for_each([&](Place& place) {
      visit(*place.object);
      const std::uint64_t sole = place.sole.load();
      if (sole == kNobody || sole == kShared) return;
      if ((sole & ~kEnding) == static_cast<std::uint64_t>(parents_thread)) {
        place.sole.store(static_cast<std::uint64_t>(this_thread_id()));
      } else {
        place.sole.store(has_barrier_ ? kNobody : kShared);
        place.inside.store(0);
      }
    });
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
    // Whether it was closed meanwhile.
    bool closed() const noexcept { return (place_->state.load() & kOpen) == 0; }

   private:
    HandleTable& table_;
    Place* place_;
  };

  // The same, in a short call: no other thread is alone() with the object meanwhile, nor has a turn
  // if this one is. A signal handler may take its turn within one of its own thread.
  class Turn {
   public:
    //   may_be_alone  false: only if this thread is already, in a turn that was interrupted
    [[gnu::always_inline]] Turn(HandleTable& table, Handle handle,
                                bool may_be_alone = true) noexcept
        : table_(table), place_(table.find(handle)) {
      if (!place_) return;
      alone_ = enter(may_be_alone);
      if (!alone_) place_->uses.fetch_add(1);
      if (place_->state.load() != open_state(handle >> kIndexBits)) {
        leave();
        place_ = nullptr;
      } else if (!alone_) {
        share();
      }
    }
    Turn(const Turn&) = delete;
    Turn& operator=(const Turn&) = delete;
    ~Turn() {
      if (place_) leave();
    }

    // False: the handle was not open.
    explicit operator bool() const noexcept { return place_ != nullptr; }
    Object* operator->() const noexcept { return place_->object; }
    Object& operator*() const noexcept { return *place_->object; }
    Kept& kept() const noexcept { return place_->kept; }
    bool alone() const noexcept { return alone_; }

   private:
    // Whether this thread is alone with the object from now on.
    bool enter(bool may_be_alone) noexcept {
      std::uint64_t sole = place_->sole.load(std::memory_order_relaxed);
      if (sole == kShared) return false;
      const auto me = static_cast<std::uint64_t>(this_thread_id());
      if (sole == kNobody && may_be_alone && place_->sole.compare_exchange_strong(sole, me))
        sole = me;
      if ((sole & ~kEnding) != me) return false;
      before_ = place_->inside.load(std::memory_order_relaxed);
      if (before_ >= kInside) {  // in a signal handler
        place_->inside.store(before_ + 1, std::memory_order_relaxed);
        return true;
      }
      if (!may_be_alone) return false;
      place_->inside.store(kTrying, std::memory_order_relaxed);
      std::atomic_signal_fence(
          std::memory_order_seq_cst);  // the barrier is with who writes the mark
      if (place_->sole.load(std::memory_order_acquire) == me) {
        place_->inside.store(kInside, std::memory_order_relaxed);
        return true;
      }
      place_->inside.store(before_, std::memory_order_release);
      return false;
    }

    void leave() noexcept {
      if (!alone_) return table_.release(*place_);
      place_->inside.store(before_, std::memory_order_release);
      std::atomic_signal_fence(std::memory_order_seq_cst);
      if ((place_->state.load(std::memory_order_relaxed) & kOpen) == 0) ::sem_post(&table_.wake_);
    }

    // Ends that one thread is alone with the object. This turn counts as a use already. In a signal
    // handler that interrupted its thread in enter(), before it was known whether that is alone,
    // nothing has begun: the handler goes on, and locks like all others, who wait here meanwhile.
    [[gnu::cold, gnu::noinline]] void share() noexcept {
      for (;;) {
        std::uint64_t sole = place_->sole.load(std::memory_order_acquire);
        if (sole == kShared) return;
        if ((sole & ~kEnding) == static_cast<std::uint64_t>(this_thread_id()) &&
            place_->inside.load(std::memory_order_relaxed) == kTrying) {
          return;
        }
        if (sole == kNobody) {
          place_->sole.compare_exchange_strong(sole, kShared);
          continue;
        }
        if ((sole & kEnding) == 0) {
          if (!place_->sole.compare_exchange_strong(sole, sole | kEnding)) continue;
          sole |= kEnding;
        }
        barrier(MEMBARRIER_CMD_PRIVATE_EXPEDITED);
        if (place_->inside.load(std::memory_order_acquire) == 0) {
          place_->sole.compare_exchange_strong(sole, kShared);
        } else {
          constexpr timespec kPause{0, 50'000};  // a call lasts some nanoseconds, or was preempted
          ::nanosleep(&kPause, nullptr);
        }
      }
    }

    HandleTable& table_;
    Place* place_;
    std::uint32_t before_ = 0;  // inside
    bool alone_ = false;
  };

 private:
  static constexpr std::uint64_t kOpen = 1, kChunk = 256;
  // Of Place::sole, which else is a thread's id, with this mark when it is to end.
  static constexpr std::uint64_t kNobody = 0, kShared = ~std::uint64_t{0}, kEnding = 1ULL << 32;
  // Of Place::inside: not yet known whether it may; and inside, with this many more turns.
  static constexpr std::uint32_t kTrying = 1, kInside = 2;

  static bool barrier(int command) noexcept {
    return ::syscall(SYS_membarrier, command, 0, 0) == 0;
  }

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
  bool has_barrier_;  // else no thread is alone with an object
  std::atomic<Place*> chunks_[(1 << kIndexBits) / kChunk]{};
  std::uint64_t used_ = 0;  // places ever used
  Place* free_ = nullptr;
};

}  // namespace dssm::ssm
