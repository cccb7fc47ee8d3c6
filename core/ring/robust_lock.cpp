// SPDX-License-Identifier: Apache-2.0
#include "core/ring/robust_lock.hpp"

#include <linux/futex.h>
#include <pthread.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <ctime>

#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::ring {
namespace {

// As glibc's list of robust mutexes, whose nodes may stand between ours: a node is the pointer to
// the next one, and in the 8 bytes before it is that to the one before.
static_assert(offsetof(pthread_mutex_t, __data.__list.__next) == 32 &&
              offsetof(pthread_mutex_t, __data.__list.__prev) == 24);
constexpr std::size_t kNodeAfterWord = 32;
static_assert(kLockBytes == kNodeAfterWord - sizeof(void*));

// Sleepers look again after this time: whoever may map the word can take a sleeper off its queue.
constexpr Duration kMaxSleepOnWord = std::chrono::milliseconds(20);

constexpr Duration kClaimPause = std::chrono::microseconds(100);

constexpr std::uintptr_t kFlag = 1;  // in a pointer to a node of glibc: its mutex inherits priority

struct Thread {
  robust_list_head* list;  // nullptr: not known yet
  std::uint32_t id;
};
// Initial-exec: one load instead of a call, on the path of every write.
[[gnu::tls_model("initial-exec")]] thread_local constinit Thread this_thread{};
// Where the kernel knows no lists (qemu-user). Deaths go unnoticed there, as with glibc's mutexes.
thread_local robust_list_head unknown_list{};

[[gnu::cold]] void find_list() noexcept {
  static const int registered =
      ::pthread_atfork(nullptr, nullptr, [] { this_thread.list = nullptr; });
  static_cast<void>(registered);  // fails without memory only: then children have a wrong id
  std::size_t bytes = 0;
  if (::syscall(SYS_get_robust_list, 0, &this_thread.list, &bytes) || !this_thread.list ||
      this_thread.list->futex_offset != -static_cast<long>(kNodeAfterWord)) {
    unknown_list.list.next = &unknown_list.list;
    this_thread.list = &unknown_list;
  }
  this_thread.id = static_cast<std::uint32_t>(::gettid());
}

// Only the kernel sees the list besides its thread, and only when that thread ends.
void compiler_barrier() noexcept { std::atomic_signal_fence(std::memory_order_seq_cst); }

// Takes the word for thread `id`; until then sleeps, at most until `deadline`.
//   found  what the word was
LockResult take_word(std::atomic<std::uint32_t>& word, std::uint32_t id, std::uint32_t found,
                     MonoTime deadline) noexcept {
  std::uint32_t waiters = 0;  // once this thread has slept: others may sleep still
  for (;;) {
    if ((found & FUTEX_TID_MASK) == 0) {
      if (word.compare_exchange_weak(found, id | (found & FUTEX_WAITERS) | waiters,
                                     std::memory_order_acquire)) {
        return found & FUTEX_OWNER_DIED ? LockResult::recovered : LockResult::locked;
      }
      continue;
    }
    const MonoTime now = MonoClock::now();
    if (now >= deadline) return LockResult::busy;
    if (!(found & FUTEX_WAITERS) &&
        !word.compare_exchange_weak(found, found | FUTEX_WAITERS, std::memory_order_relaxed)) {
      continue;
    }
    const timespec until = timespec_of(std::min(deadline, now + kMaxSleepOnWord));
    ::syscall(SYS_futex, &word, FUTEX_WAIT_BITSET, found | FUTEX_WAITERS, &until, nullptr,
              FUTEX_BITSET_MATCH_ANY);
    waiters = FUTEX_WAITERS;
    found = word.load(std::memory_order_relaxed);
  }
}

// state: 0, or FUTEX_OWNER_DIED
void give_back(std::atomic<std::uint32_t>& word, std::uint32_t state) noexcept {
  if (word.exchange(state, std::memory_order_release) & FUTEX_WAITERS) {
    ::syscall(SYS_futex, &word, FUTEX_WAKE, 1, nullptr, nullptr, 0);
  }
}

}  // namespace

// In the page behind the word's.
struct RobustLock::Private {
  // Only the holder among this process's threads uses the node.
  std::uintptr_t previous;
  std::uintptr_t next;
  std::atomic<std::uint32_t> holder;  // its thread id; 0: none
  std::atomic<bool> was_in_vain;      // the last wait

  // The word says that no other thread holds the lock, but other processes may write to it.
  bool claim(std::uint32_t id) noexcept {
    std::uint32_t other = 0;
    if (holder.compare_exchange_strong(other, id, std::memory_order_acquire)) return true;
    // A thread that ended with the lock, or one of the process that this one is a fork of.
    const bool is_gone = ::syscall(SYS_tgkill, ::getpid(), other, 0) != 0 && errno == ESRCH;
    return is_gone && holder.compare_exchange_strong(other, id, std::memory_order_acquire);
  }

  void link(robust_list_head& list) noexcept {
    next = reinterpret_cast<std::uintptr_t>(list.list.next);
    previous = reinterpret_cast<std::uintptr_t>(&list.list);
    set_previous_of_next(list, reinterpret_cast<std::uintptr_t>(&next));
    compiler_barrier();
    list.list.next = reinterpret_cast<robust_list*>(&next);
  }

  void unlink(robust_list_head& list) noexcept {
    set_previous_of_next(list, previous);
    *reinterpret_cast<std::uintptr_t*>(previous & ~kFlag) = next;
  }

 private:
  void set_previous_of_next(robust_list_head& list, std::uintptr_t value) noexcept {
    const auto after = reinterpret_cast<robust_list*>(next & ~kFlag);
    if (after != &list.list) reinterpret_cast<std::uintptr_t*>(after)[-1] = value;
  }
};

Result<RobustLock> RobustLock::map(int fd) {
  return RobustLock(
      DSSM_TRY(SharedMapping::map_before_private_page(fd, system_page_bytes()), "map a lock"));
}

std::atomic<std::uint32_t>& RobustLock::word() const noexcept {
  return *reinterpret_cast<std::atomic<std::uint32_t>*>(mapping_.end() - kLockBytes);
}

RobustLock::Private& RobustLock::own() const noexcept {
  return *reinterpret_cast<Private*>(mapping_.end());
}

[[gnu::hot]] LockResult RobustLock::take(bool may_wait) const noexcept {
  if (!this_thread.list) find_list();
  const Thread self = this_thread;
  Private& own = this->own();
  // While it is pending, the kernel looks at the word, too, if this thread ends.
  self.list->list_op_pending = reinterpret_cast<robust_list*>(&own.next);
  compiler_barrier();
  LockResult result = LockResult::locked;
  std::uint32_t found = 0;
  if (!word().compare_exchange_strong(found, self.id, std::memory_order_acquire)) {
    result = take_slowly(self.id, may_wait);
  } else if (!own.claim(self.id)) {
    give_back(word(), 0);
    result = take_slowly(self.id, may_wait);
  }
  if (result != LockResult::busy) own.link(*self.list);
  compiler_barrier();
  self.list->list_op_pending = nullptr;
  return result;
}

LockResult RobustLock::take_slowly(std::uint32_t id, bool may_wait) const noexcept {
  Private& own = this->own();
  const MonoTime deadline =
      may_wait ? deadline_in(own.was_in_vain ? kMaxWaitAgain : kMaxWait) : MonoTime::min();
  for (;;) {
    LockResult result = take_word(word(), id, word().load(std::memory_order_relaxed), deadline);
    if (result != LockResult::busy && !own.claim(id)) {
      // The other thread is about to end, or another process has changed the word.
      give_back(word(), result == LockResult::recovered ? FUTEX_OWNER_DIED : 0);
      result = LockResult::busy;
      if (MonoClock::now() < deadline) {
        const timespec pause = timespec_of(kClaimPause);
        ::nanosleep(&pause, nullptr);
        continue;
      }
    }
    if (may_wait) own.was_in_vain = result == LockResult::busy;
    return result;
  }
}

[[gnu::hot]] LockResult RobustLock::lock() const noexcept { return take(true); }
[[gnu::hot]] LockResult RobustLock::try_lock() const noexcept { return take(false); }

[[gnu::hot]] void RobustLock::unlock() const noexcept {
  robust_list_head& list = *this_thread.list;
  Private& own = this->own();
  list.list_op_pending = reinterpret_cast<robust_list*>(&own.next);
  compiler_barrier();
  own.unlink(list);
  own.holder.store(0, std::memory_order_release);
  give_back(word(), 0);
  compiler_barrier();
  list.list_op_pending = nullptr;
}

}  // namespace dssm::ring
