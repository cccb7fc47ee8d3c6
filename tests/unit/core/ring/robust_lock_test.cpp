// SPDX-License-Identifier: Apache-2.0
//
// The writers' lock: one holder, its death noticed, and no harm by what others write to the word.
#include "core/ring/robust_lock.hpp"

#include <gtest/gtest.h>
#include <linux/futex.h>
#include <pthread.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

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
  int count = 0;
  std::vector<std::thread> threads;
  for (int i = 0; i < 4; ++i) {
    threads.emplace_back([&, i] {
      const RobustLock& lock = i % 2 == 0 ? file.lock : other;
      for (int n = 0; n < kEach; ++n) {
        ASSERT_EQ(lock.lock(), LockResult::locked);
        ++count;
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

TEST(RobustLock, WakesAThreadThatWaits) {
  const LockFile file;
  constexpr int kTimes = 200;
  const MonoTime begin = MonoClock::now();
  for (int i = 0; i < kTimes; ++i) {
    ASSERT_EQ(file.lock.lock(), LockResult::locked);
    std::thread next([&] {
      ASSERT_EQ(file.lock.lock(), LockResult::locked);
      file.lock.unlock();
    });
    while (!(file.word() & FUTEX_WAITERS)) std::this_thread::yield();
    file.lock.unlock();
    next.join();
  }
  // Without the wake-up each one would look again after 20 ms.
  EXPECT_LT(MonoClock::now() - begin, kTimes * std::chrono::milliseconds(20) / 2);
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

// The kernel's list has the program's own robust mutexes, too, in any order.
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
          is_held ? ::pthread_mutex_unlock(mutex) : ::pthread_mutex_lock(mutex);
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
      EXPECT_EQ(::pthread_mutex_lock(&mutexes[i]), mutex_was_held ? EOWNERDEAD : 0);
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
  std::atomic<bool> done = false;
  std::atomic<std::uint32_t> ids[2] = {};
  std::vector<std::thread> honest;
  for (std::atomic<std::uint32_t>& id : ids) {
    honest.emplace_back([&] {
      id = static_cast<std::uint32_t>(::gettid());
      while (!done) {
        const LockResult result = file.lock.try_lock();
        if (result == LockResult::locked || result == LockResult::recovered) file.lock.unlock();
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
  for (int i = 0; i < 300'000; ++i) {
    const std::uint32_t words[] = {0,
                                   ids[0],
                                   ids[1] | FUTEX_WAITERS,
                                   FUTEX_OWNER_DIED,
                                   FUTEX_WAITERS,
                                   static_cast<std::uint32_t>(random())};
    file.word() = words[random() % std::size(words)];
  }
  done = true;
  for (std::thread& thread : honest) thread.join();
  file.word() = 0;
  EXPECT_EQ(file.lock.lock(), LockResult::locked);
  file.lock.unlock();
}

}  // namespace
}  // namespace dssm::ring
