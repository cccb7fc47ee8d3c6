// SPDX-License-Identifier: Apache-2.0
#include "core/ring/robust_lock.hpp"

#include <linux/futex.h>
#include <pthread.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstddef>

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
constexpr Duration kAttemptTime = std::chrono::nanoseconds(20);  // about, to change the word

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

// Who sees the list besides its thread: its signal handlers, and the kernel when it ends.
void compiler_barrier() noexcept { std::atomic_signal_fence(std::memory_order_seq_cst); }

[[gnu::cold]] void find_list() noexcept {
  robust_list_head* list = nullptr;
  std::size_t bytes = 0;
  if (::syscall(SYS_get_robust_list, 0, &list, &bytes) || !list ||
      list->futex_offset != -static_cast<long>(kNodeAfterWord)) {
    unknown_list.list.next = &unknown_list.list;
    list = &unknown_list;
  }
  this_thread.id = static_cast<std::uint32_t>(::gettid());
  compiler_barrier();  // a signal handler may come in between, and lock
  this_thread.list = list;
}

// While it exists, the kernel looks at the word of this node, too, if the thread ends. A signal
// handler may use another lock meanwhile.
class Pending {
 public:
  Pending(robust_list_head& list, robust_list& node) noexcept
      : list_(list), node_(&node), before_(list.list_op_pending) {
    resume();
  }
  Pending(const Pending&) = delete;
  Pending& operator=(const Pending&) = delete;
  ~Pending() { pause(); }

  void pause() noexcept { set(before_); }
  void resume() noexcept { set(node_); }

 private:
  void set(robust_list* pending) noexcept {
    compiler_barrier();
    list_.list_op_pending = pending;
    compiler_barrier();
  }
  robust_list_head& list_;
  robust_list* node_;
  robust_list* before_;
};

void sleep_for(Duration time) noexcept {  // no cancellation point
  const timespec pause = timespec_of(time);
  ::syscall(SYS_clock_nanosleep, CLOCK_MONOTONIC, 0, &pause, nullptr);
}

// Takes the word for thread `id`; until then sleeps, at most for `patience`, from which it takes
// that time. A sleep counts no longer than it was to be: when the whole PC stood still meanwhile,
// the holder did so, too.
LockResult take_word(std::atomic<std::uint32_t>& word, std::uint32_t id, Duration& patience,
                     Pending& pending) noexcept {
  std::uint32_t waiters = 0;  // once this thread has slept: others may sleep still
  std::uint32_t found = word.load(std::memory_order_relaxed);
  for (;;) {
    if ((found & FUTEX_TID_MASK) == 0) {
      if (word.compare_exchange_weak(found, id | (found & FUTEX_WAITERS) | waiters,
                                     std::memory_order_acquire)) {
        return found & FUTEX_OWNER_DIED ? LockResult::recovered : LockResult::locked;
      }
      continue;
    }
    if (patience <= Duration::zero()) return LockResult::busy;
    if (!(found & FUTEX_WAITERS) &&
        !word.compare_exchange_weak(found, found | FUTEX_WAITERS, std::memory_order_relaxed)) {
      patience -= kAttemptTime;
      continue;
    }
    const MonoTime begin = MonoClock::now();
    const Duration sleep = std::min(patience, kMaxSleepOnWord);
    const timespec until = timespec_of(begin + sleep);
    // The holder may be a thread of another container with the same id: if this one ends while it
    // sleeps, the kernel must not take it for the holder.
    pending.pause();
    ::syscall(SYS_futex, &word, FUTEX_WAIT_BITSET, found | FUTEX_WAITERS, &until, nullptr,
              FUTEX_BITSET_MATCH_ANY);
    pending.resume();
    patience -= std::min(MonoClock::now() - begin, sleep);
    waiters = FUTEX_WAITERS;
    found = word.load(std::memory_order_relaxed);
  }
}

// state: 0, or FUTEX_OWNER_DIED
void give_back(std::atomic<std::uint32_t>& word, std::uint32_t state) noexcept {
  // Not only release: SlotWriter::publish_before_unlock() needs it as a barrier.
  if (word.exchange(state, std::memory_order_seq_cst) & FUTEX_WAITERS) {
    ::syscall(SYS_futex, &word, FUTEX_WAKE, 1, nullptr, nullptr, 0);
  }
}

}  // namespace

// In the page behind the word's.
struct RobustLock::Private {
  // Only the holder among this process's threads uses the node.
  robust_list* previous;
  robust_list node;
  std::atomic<std::uint32_t> holder;  // its thread id; 0: none
  std::atomic<bool> was_in_vain;      // the last wait

  // The word says that no other thread holds the lock, but other processes may write to it.
  bool claim(std::uint32_t id) noexcept {
    std::uint32_t other = 0;
    if (holder.compare_exchange_strong(other, id, std::memory_order_acquire)) return true;
    // A thread that ended with the lock, or one of the process that this one is a fork of. Where
    // its id is another thread's by now, the lock stays busy in this mapping.
    const bool is_gone = ::syscall(SYS_tgkill, ::getpid(), other, 0) != 0 && errno == ESRCH;
    return is_gone && holder.compare_exchange_strong(other, id, std::memory_order_acquire);
  }

  void link(robust_list_head& list) noexcept {
    node.next = list.list.next;
    previous = &list.list;
    compiler_barrier();
    // First: a signal handler that locks in between sets the node before this one.
    list.list.next = &node;
    compiler_barrier();
    set_previous_of_next(list, &node);
  }

  void unlink(robust_list_head& list) noexcept {
    set_previous_of_next(list, previous);
    without_flag(previous)->next = node.next;
  }

 private:
  static robust_list* without_flag(robust_list* some) noexcept {
    return reinterpret_cast<robust_list*>(reinterpret_cast<std::byte*>(some) -
                                          (reinterpret_cast<std::uintptr_t>(some) & kFlag));
  }
  void set_previous_of_next(robust_list_head& list, robust_list* value) noexcept {
    robust_list* const after = without_flag(node.next);
    if (after != &list.list) reinterpret_cast<robust_list**>(after)[-1] = value;
  }
};

Result<RobustLock> RobustLock::map(int fd) {
  // A child has another thread id, and a list of its own.
  static const int failed = ::pthread_atfork(nullptr, nullptr, [] { this_thread = {}; });
  if (failed) return os_error("prepare for a fork", failed);
  return RobustLock(
      DSSM_TRY(SharedMapping::map_before_private_page(fd, system_page_bytes()), "map a lock"));
}

std::atomic<std::uint32_t>& RobustLock::word() const noexcept {
  return *reinterpret_cast<std::atomic<std::uint32_t>*>(mapping_.end() - kLockBytes);
}

RobustLock::Private& RobustLock::own() const noexcept {
  static_assert(offsetof(Private, node) == kNodeAfterWord - kLockBytes);
  return *reinterpret_cast<Private*>(mapping_.end());
}

[[gnu::hot]] LockResult RobustLock::take(bool may_wait) const noexcept {
  if (!this_thread.list) find_list();
  const Thread self = this_thread;
  Private& own = this->own();
  Pending pending(*self.list, own.node);
  LockResult result = LockResult::locked;
  std::uint32_t found = 0;
  const bool has_word = word().compare_exchange_strong(found, self.id, std::memory_order_acquire);
  if (!has_word || !own.claim(self.id)) {
    if (has_word) give_back(word(), 0);
    Duration patience = !may_wait ? Duration::zero() : own.was_in_vain ? kMaxWaitAgain : kMaxWait;
    while ((result = take_word(word(), self.id, patience, pending)) != LockResult::busy &&
           !own.claim(self.id)) {
      // The other thread is about to end, or another process has changed the word.
      give_back(word(), result == LockResult::recovered ? FUTEX_OWNER_DIED : 0);
      result = LockResult::busy;
      if (patience <= Duration::zero()) break;
      const MonoTime begin = MonoClock::now();
      sleep_for(kClaimPause);
      patience -= std::min(MonoClock::now() - begin, kMaxSleepOnWord);
    }
    if (result == LockResult::busy) {
      if (may_wait) own.was_in_vain.store(true, std::memory_order_relaxed);
      return result;
    }
  }
  if (own.was_in_vain.load(std::memory_order_relaxed)) [[unlikely]] {
    own.was_in_vain.store(false, std::memory_order_relaxed);
  }
  own.link(*self.list);
  return result;
}

[[gnu::hot]] LockResult RobustLock::lock() const noexcept { return take(true); }
[[gnu::hot]] LockResult RobustLock::try_lock() const noexcept { return take(false); }

[[gnu::hot]] void RobustLock::unlock() const noexcept {
  const Thread self = this_thread;
  Private& own = this->own();
  // A forked child does not hold what its parent's thread held.
  if (own.holder.load(std::memory_order_relaxed) != self.id || !self.list) return;
  Pending pending(*self.list, own.node);
  own.unlink(*self.list);
  own.holder.store(0, std::memory_order_release);
  give_back(word(), 0);
}

}  // namespace dssm::ring
