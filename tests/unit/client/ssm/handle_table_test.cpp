// SPDX-License-Identifier: Apache-2.0
//
// Turns: one thread alone, then several; and that no turn outlives its object.
#include "client/ssm/src/handle_table.hpp"

#include <gtest/gtest.h>

#include <mutex>
#include <thread>

namespace dssm::ssm {

// As libssm has them.
constinit thread_local int kept_thread_id = 0;
int ask_thread_id() noexcept { return kept_thread_id = ::gettid(); }

namespace {

struct Counter {
  explicit Counter(int& destroyed) : destroyed_(destroyed) {}
  Counter(const Counter&) = delete;
  Counter& operator=(const Counter&) = delete;
  ~Counter() { ++destroyed_; }

  void add(bool alone) {
    const LockUnlessAlone guard(lock, alone);
    ++count;
  }

  ReentrantLock lock;
  int count = 0;

 private:
  int& destroyed_;
};
using Table = HandleTable<Counter>;

class Turns : public testing::Test {
 protected:
  Turns() : handle_(table_->add(std::make_unique<Counter>(destroyed_), 1)) {}
  ~Turns() override {
    table_->close(handle_);
    table_->reap(1);
  }

  bool is_alone() {
    const Table::Turn turn(*table_, handle_);
    return turn.alone();
  }

  // As in libssm for the life of the process: a table never frees its places.
  static inline sem_t wake_{};
  static inline Table* const table_ = [] {
    ::sem_init(&wake_, 0, 0);
    return new Table(wake_);
  }();
  int destroyed_ = 0;
  const Table::Handle handle_;
};

TEST_F(Turns, AreAloneUntilAnotherThreadComes) {
  if (!is_alone()) GTEST_SKIP() << "this kernel has no membarrier(2): no thread is ever alone";
  {
    const Table::Turn outer(*table_, handle_);
    EXPECT_TRUE(is_alone()) << "as in a signal handler";
  }
  EXPECT_TRUE(is_alone());
  std::thread([&] { EXPECT_FALSE(is_alone()); }).join();
  EXPECT_FALSE(is_alone());
}

TEST_F(Turns, OfACallbackAreNotAloneUnlessWithinOneThatIs) {
  if (!is_alone()) GTEST_SKIP() << "this kernel has no membarrier(2): no thread is ever alone";
  {
    const Table::Turn outer(*table_, handle_);
    EXPECT_TRUE(Table::Turn(*table_, handle_, false).alone());
  }
  EXPECT_FALSE(Table::Turn(*table_, handle_, false).alone());
}

// The sanitizer for threads sees here whether two of them are ever inside at once.
TEST_F(Turns, OfSeveralThreadsExcludeEachOther) {
  constexpr int kTurns = 20'000, kThreads = 4, kTables = 20;
  for (int round = 0; round < kTables; ++round) {
    const Table::Handle handle = table_->add(std::make_unique<Counter>(destroyed_), 1);
    std::vector<std::thread> threads;
    for (int i = 0; i < kThreads; ++i) {
      threads.emplace_back([&] {
        for (int n = 0; n < kTurns / kTables; ++n) {
          const Table::Turn turn(*table_, handle);
          ASSERT_TRUE(turn);
          turn->add(turn.alone());
        }
      });
    }
    for (std::thread& thread : threads) thread.join();
    EXPECT_EQ(Table::Turn(*table_, handle)->count, kThreads * kTurns / kTables);
    table_->close(handle);
    table_->reap(1);
  }
}

TEST_F(Turns, WaitForTheThreadThatIsAlone) {
  if (!is_alone()) GTEST_SKIP() << "this kernel has no membarrier(2): no thread is ever alone";
  std::atomic<bool> is_over{false};
  std::thread other;
  {
    const Table::Turn turn(*table_, handle_);
    other = std::thread([&] {
      const Table::Turn mine(*table_, handle_);
      EXPECT_TRUE(is_over.load());
      EXPECT_FALSE(mine.alone());
    });
    // It may be waiting by now, and is not let in.
    for (int i = 0; i < 10; ++i) {
      std::this_thread::sleep_for(std::chrono::milliseconds(1));
      EXPECT_TRUE(is_alone());
    }
    is_over = true;
  }
  other.join();
}

TEST_F(Turns, KeepTheirObjectWhenItIsClosed) {
  {
    const Table::Turn turn(*table_, handle_);
    table_->close(handle_);
    table_->reap(1);
    EXPECT_EQ(destroyed_, 0);
    EXPECT_FALSE(Table::Turn(*table_, handle_));
    while (::sem_trywait(&wake_) == 0) continue;
  }
  EXPECT_EQ(::sem_trywait(&wake_), 0) << "the reaper is to look again";
  table_->reap(1);
  EXPECT_EQ(destroyed_, 1);
}

}  // namespace
}  // namespace dssm::ssm
