// SPDX-License-Identifier: Apache-2.0
//
// The writers' lock: one holder, its death noticed, and no harm by what others write to the word.
#include "core/ring/robust_lock.hpp"

#include <gtest/gtest.h>
#include <linux/futex.h>
#include <pthread.h>
#include <signal.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <random>
#include <thread>
#include <vector>

#include "core/base/time.hpp"

namespace dssm::ring {
namespace {

bool knows_robust_lists() {
  void* head = nullptr;
  std::size_t bytes = 0;
  return ::syscall(SYS_get_robust_list, 0, &head, &bytes) == 0;
}

struct LockFile {
  UniqueFd fd = create_sealed_memory("test-lock", system_page_bytes(), 0600).value();
  SharedMapping mapping =
      SharedMapping::map(fd.get(), system_page_bytes(), PROT_READ | PROT_WRITE).value();
  RobustLock lock = RobustLock::map(fd.get()).value();

  std::atomic<std::uint32_t>& word(std::size_t index = 0) const {
    return reinterpret_cast<std::atomic<std::uint32_t>*>(mapping.end() - kLockBytes)[index];
  }
};

TEST(RobustLock, LetsOneThreadInAtATime) {
  const LockFile file;
  const RobustLock other = RobustLock::map(file.fd.get()).value();  // as in another process
  constexpr int kEach = 20'000;
  // Atomic for ThreadSanitizer, which does not know that both mappings are of one word; in two
  // steps, so that a second thread inside loses counts.
  std::atomic<int> count = 0;
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&, i] {
      const RobustLock& lock = i % 2 == 0 ? file.lock : other;
      for (int n = 0; n < kEach; ++n) {
        ASSERT_EQ(lock.lock(), LockResult::locked);
        count.store(count.load(std::memory_order_relaxed) + 1, std::memory_order_relaxed);
        lock.unlock();
      }
    });
  }
  for (std::thread& thread : threads) thread.join();
  EXPECT_EQ(count, 4 * kEach);
}

TEST(RobustLock, IsBusyWhileAnotherThreadHoldsIt) {
  const LockFile file;
  ASSERT_EQ(file.lock.lock(), LockResult::locked);
  std::thread([&] { EXPECT_EQ(file.lock.try_lock(), LockResult::busy); }).join();
  file.lock.unlock();
  std::thread([&] {
    EXPECT_EQ(file.lock.try_lock(), LockResult::locked);
    file.lock.unlock();
  }).join();
}

TEST(RobustLock, NoticesThatItsHolderEnded) {
  if (!knows_robust_lists()) GTEST_SKIP() << "no robust lists here (qemu-user has none)";
  const LockFile file;
  std::thread([&] { ASSERT_EQ(file.lock.lock(), LockResult::locked); }).join();
  EXPECT_EQ(file.lock.lock(), LockResult::recovered) << "a thread of this process";
  file.lock.unlock();
  const pid_t child = ::fork();
  if (child == 0) ::_exit(file.lock.lock() == LockResult::locked ? 0 : 1);
  int status = 0;
  ASSERT_EQ(::waitpid(child, &status, 0), child);
  ASSERT_EQ(status, 0);
  EXPECT_EQ(file.lock.lock(), LockResult::recovered) << "another process";
  file.lock.unlock();
  EXPECT_EQ(file.lock.lock(), LockResult::locked);
  file.lock.unlock();
}

// As a virtual machine that gets no processor for a while.
TEST(RobustLock, CountsNoTimeInWhichTheProcessStandsStill) {
#ifdef __SANITIZE_THREAD__
  GTEST_SKIP() << "ThreadSanitizer does not know threads of a forked process";
#endif
  if (!knows_robust_lists()) GTEST_SKIP() << "not tried under qemu-user";
  const LockFile file;
  int waits[2], go[2];
  ASSERT_EQ(::pipe(waits), 0);
  ASSERT_EQ(::pipe(go), 0);
  char byte = 0;
  const pid_t child = ::fork();
  if (child == 0) {
    if (file.lock.lock() != LockResult::locked) ::_exit(2);
    LockResult result = LockResult::busy;
    std::thread waiter([&] { result = file.lock.lock(); });
    while (!(file.word() & FUTEX_WAITERS)) std::this_thread::yield();
    if (::write(waits[1], &byte, 1) != 1 || ::read(go[0], &byte, 1) != 1) ::_exit(3);
    file.lock.unlock();
    waiter.join();
    ::_exit(result == LockResult::locked ? 0 : 1);
  }
  ::close(waits[1]);
  ASSERT_EQ(::read(waits[0], &byte, 1), 1);
  ASSERT_EQ(::kill(child, SIGSTOP), 0);
  std::this_thread::sleep_for(RobustLock::kMaxWait + std::chrono::milliseconds(100));
  ASSERT_EQ(::kill(child, SIGCONT), 0);
  // Time in which the thread would give up, if it counted that in which it stood still.
  std::this_thread::sleep_for(std::chrono::milliseconds(100));
  ASSERT_EQ(::write(go[1], &byte, 1), 1);
  int status = 0;
  ASSERT_EQ(::waitpid(child, &status, 0), child);
  EXPECT_EQ(status, 0);
  for (const int fd : {waits[0], go[0], go[1]}) ::close(fd);
}

TEST(RobustLock, WakesAThreadThatWaits) {
  const LockFile file;
  constexpr int kTimes = 50;
  int late = 0;
  for (int i = 0; i < kTimes; ++i) {
    ASSERT_EQ(file.lock.lock(), LockResult::locked);
    MonoTime got;
    std::thread next([&] {
      ASSERT_EQ(file.lock.lock(), LockResult::locked);
      got = MonoClock::now();
      file.lock.unlock();
    });
    while (!(file.word() & FUTEX_WAITERS)) std::this_thread::yield();
    std::this_thread::sleep_for(std::chrono::milliseconds(1));  // until it sleeps
    const MonoTime unlocked = MonoClock::now();
    file.lock.unlock();
    next.join();
    // Without the wake-up it would look again after 20 ms.
    late += got - unlocked > std::chrono::milliseconds(12);
  }
  EXPECT_LT(late, kTimes / 2);
}

TEST(RobustLock, IsNotGivenUpByAForkedChild) {
  const LockFile file;
  ASSERT_EQ(file.lock.lock(), LockResult::locked);
  const std::uint32_t word = file.word();
  const pid_t child = ::fork();
  if (child == 0) {
    file.lock.unlock();  // as a destructor would
    ::_exit(file.word() == word ? 0 : 1);
  }
  int status = 0;
  ASSERT_EQ(::waitpid(child, &status, 0), child);
  EXPECT_EQ(status, 0);
  file.lock.unlock();
  EXPECT_EQ(file.word(), 0u);
}

// A thread that ends with several of them, and with one that it waits for.
TEST(RobustLock, NoticesTheEndOfAHolderOfSeveral) {
  if (!knows_robust_lists()) GTEST_SKIP() << "no robust lists here (qemu-user has none)";
  const LockFile first, second, waited_for;
  ASSERT_EQ(waited_for.lock.lock(), LockResult::locked);
  const pid_t child = ::fork();
  if (child == 0) {
    static_cast<void>(first.lock.lock());
    static_cast<void>(second.lock.lock());
    static_cast<void>(waited_for.lock.lock());
    ::_exit(0);
  }
  while (!(waited_for.word() & FUTEX_WAITERS)) std::this_thread::yield();
  ASSERT_EQ(::kill(child, SIGKILL), 0);
  int status = 0;
  ASSERT_EQ(::waitpid(child, &status, 0), child);
  EXPECT_EQ(first.lock.lock(), LockResult::recovered);
  EXPECT_EQ(second.lock.lock(), LockResult::recovered);
  EXPECT_EQ(waited_for.word() & FUTEX_TID_MASK, static_cast<std::uint32_t>(::gettid()));
  for (const LockFile* file : {&first, &second, &waited_for}) file->lock.unlock();
}

// A signal handler may write to another stream.
TEST(RobustLock, MayBeTakenInASignalHandler) {
  if (!knows_robust_lists()) GTEST_SKIP() << "no robust lists here (qemu-user has none)";
  static const LockFile* in_handler = nullptr;
  const LockFile file, another;
  in_handler = &another;
  struct sigaction action {
  }, before{};
  action.sa_handler = [](int) {
    if (in_handler->lock.try_lock() == LockResult::locked) in_handler->lock.unlock();
  };
  ASSERT_EQ(::sigaction(SIGUSR1, &action, &before), 0);
  std::atomic<bool> done = false;
  std::thread locks([&] {
    const LockFile outer;
    for (int i = 0; i < 20'000; ++i) {  // released in another order than taken
      ASSERT_EQ(outer.lock.lock(), LockResult::locked);
      ASSERT_EQ(file.lock.lock(), LockResult::locked);
      outer.lock.unlock();
      file.lock.unlock();
    }
    robust_list_head* head = nullptr;
    std::size_t bytes = 0;
    ASSERT_EQ(::syscall(SYS_get_robust_list, 0, &head, &bytes), 0);
    EXPECT_EQ(head->list.next, &head->list);
    EXPECT_EQ(head->list_op_pending, nullptr);
    done = true;
    while (done) std::this_thread::yield();  // until no signal comes any more
  });
  while (!done) ::pthread_kill(locks.native_handle(), SIGUSR1);
  done = false;
  locks.join();
  ::sigaction(SIGUSR1, &before, nullptr);
}

// What made glibc's mutex dangerous: its list's pointers were in shared memory.
TEST(RobustLock, ShowsNoAddressToOtherProcesses) {
  const LockFile file, another;
  ASSERT_EQ(another.lock.lock(), LockResult::locked);
  ASSERT_EQ(file.lock.lock(), LockResult::locked);
  EXPECT_EQ(file.word(), static_cast<std::uint32_t>(::gettid()));
  for (std::size_t i = 1; i < kLockBytes / 4; ++i) EXPECT_EQ(file.word(i), 0u);
  // And nothing that is written there reaches the list.
  for (std::size_t i = 1; i < kLockBytes / 4; ++i) file.word(i) = 0x41414141;
  file.lock.unlock();
  another.lock.unlock();
  for (std::size_t i = 1; i < kLockBytes / 4; ++i) EXPECT_EQ(file.word(i), 0x41414141u);
}

// The kernel's list has the program's own robust mutexes, too, in any order. They are only tried,
// because ThreadSanitizer takes two orders for a deadlock.
TEST(RobustLock, SharesTheListWithMutexesOfTheProgram) {
  if (!knows_robust_lists()) GTEST_SKIP() << "no robust lists here (qemu-user has none)";
  constexpr std::size_t kEach = 4;
  std::array<LockFile, kEach> files;
  const UniqueFd memory = create_sealed_memory("test-mutexes", 4096, 0600).value();
  const SharedMapping mapping =
      SharedMapping::map(memory.get(), 4096, PROT_READ | PROT_WRITE).value();
  auto* const mutexes = &mapping.as<pthread_mutex_t>();
  pthread_mutexattr_t attributes;
  ::pthread_mutexattr_init(&attributes);
  ::pthread_mutexattr_setpshared(&attributes, PTHREAD_PROCESS_SHARED);
  ::pthread_mutexattr_setrobust(&attributes, PTHREAD_MUTEX_ROBUST);
  for (std::size_t i = 0; i < kEach; ++i) ::pthread_mutex_init(&mutexes[i], &attributes);

  for (unsigned seed = 0; seed < 50; ++seed) {
    SCOPED_TRACE(testing::Message() << "seed " << seed);
    const auto held = &mapping.as<std::array<std::atomic<bool>, 2 * kEach>>() +
                      2048 / sizeof(std::array<std::atomic<bool>, 2 * kEach>);
    const pid_t child = ::fork();
    if (child == 0) {
      std::minstd_rand random(seed);
      for (int step = 0; step < 200; ++step) {
        const std::size_t which = random() % (2 * kEach);
        const bool is_held = (*held)[which];
        if (which < kEach) {
          is_held ? files[which].lock.unlock() : static_cast<void>(files[which].lock.lock());
        } else {
          pthread_mutex_t* mutex = &mutexes[which - kEach];
          is_held ? ::pthread_mutex_unlock(mutex) : ::pthread_mutex_trylock(mutex);
        }
        (*held)[which] = !is_held;
      }
      ::_exit(0);
    }
    int status = 0;
    ASSERT_EQ(::waitpid(child, &status, 0), child);
    ASSERT_EQ(status, 0);
    for (std::size_t i = 0; i < kEach; ++i) {
      const bool was_held = (*held)[i].exchange(false);
      EXPECT_EQ(files[i].lock.lock(), was_held ? LockResult::recovered : LockResult::locked);
      files[i].lock.unlock();
      const bool mutex_was_held = (*held)[kEach + i].exchange(false);
      EXPECT_EQ(::pthread_mutex_trylock(&mutexes[i]), mutex_was_held ? EOWNERDEAD : 0);
      if (mutex_was_held) ::pthread_mutex_consistent(&mutexes[i]);
      ::pthread_mutex_unlock(&mutexes[i]);
    }
  }
}

TEST(RobustLock, WaitsOnceForAHolderThatDoesNotGo) {
  const LockFile file;
  file.word() = 1;  // the thread id of a process that knows nothing of it
  MonoTime begin = MonoClock::now();
  EXPECT_EQ(file.lock.lock(), LockResult::busy);
  EXPECT_GE(MonoClock::now() - begin, RobustLock::kMaxWait);
  begin = MonoClock::now();
  EXPECT_EQ(file.lock.lock(), LockResult::busy);
  EXPECT_LT(MonoClock::now() - begin, RobustLock::kMaxWait);
  file.word() = 0;
  EXPECT_EQ(file.lock.lock(), LockResult::locked);
  file.lock.unlock();
  file.word() = 1;
  begin = MonoClock::now();
  EXPECT_EQ(file.lock.lock(), LockResult::busy);
  EXPECT_GE(MonoClock::now() - begin, RobustLock::kMaxWait) << "it was free meanwhile";
}

// Two threads of one process have one node in the list.
TEST(RobustLock, KeepsASecondThreadOutWhenTheWordSaysThatItIsFree) {
  const LockFile file;
  ASSERT_EQ(file.lock.lock(), LockResult::locked);
  file.word() = 0;
  std::thread([&] { EXPECT_EQ(file.lock.try_lock(), LockResult::busy); }).join();
  file.lock.unlock();
  EXPECT_EQ(file.lock.lock(), LockResult::locked);
  file.lock.unlock();
}

// A program with write access may write to the word at any moment. The others may then be inside at
// the same time, or get no lock, but they stay whole.
TEST(RobustLock, SurvivesAnyWordAtAnyTime) {
  const LockFile file;
  constexpr int kEach = 1000;
  std::atomic<bool> done = false;
  struct Honest {
    bool waits;
    std::atomic<std::uint32_t> id = 0;
    std::atomic<int> times_inside = 0;
  } honest[3] = {{false}, {false}, {true}};
  std::vector<std::thread> threads;
  for (Honest& one : honest) {
    threads.emplace_back([&] {
      one.id = static_cast<std::uint32_t>(::gettid());
      while (!done) {
        const LockResult result = one.waits ? file.lock.lock() : file.lock.try_lock();
        if (result == LockResult::busy) continue;
        file.lock.unlock();
        ++one.times_inside;
      }
      // The thread's list is in order: the kernel walks it when it ends.
      robust_list_head* head = nullptr;
      std::size_t bytes = 0;
      if (::syscall(SYS_get_robust_list, 0, &head, &bytes) != 0) return;
      EXPECT_EQ(head->list.next, &head->list);
      EXPECT_EQ(head->list_op_pending, nullptr);
    });
  }
  std::minstd_rand random(20261126);
  const auto all_were_inside = [&] {
    return std::all_of(std::begin(honest), std::end(honest),
                       [](const Honest& one) { return one.times_inside >= kEach; });
  };
  for (int i = 0; i < 300'000 || !all_were_inside(); ++i) {
    const std::uint32_t words[] = {0,
                                   honest[0].id,
                                   honest[1].id | FUTEX_WAITERS,
                                   FUTEX_OWNER_DIED,
                                   FUTEX_WAITERS,
                                   static_cast<std::uint32_t>(random())};
    file.word() = words[random() % std::size(words)];
  }
  done = true;
  file.word() = 0;
  for (std::thread& thread : threads) thread.join();
  file.word() = 0;
  EXPECT_EQ(file.lock.lock(), LockResult::locked);
  file.lock.unlock();
}

}  // namespace
}  // namespace dssm::ring
