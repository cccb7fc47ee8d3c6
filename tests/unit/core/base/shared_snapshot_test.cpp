// SPDX-License-Identifier: Apache-2.0
//
// Values in shared memory: readers never see a mix, and a writer that is killed at any instruction
// leaves the old value or the new one.
#include "core/base/shared_snapshot.hpp"

#include <gtest/gtest.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/ptrace.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <thread>

namespace dssm {
namespace {

// All words are the same in a value that was stored as a whole.
struct Value {
  std::uint64_t words[5];

  static Value of(std::uint64_t number) { return {{number, number, number, number, number}}; }
  bool is_whole() const {
    return std::all_of(std::begin(words), std::end(words),
                       [this](std::uint64_t word) { return word == words[0]; });
  }
};
using Snapshot = SharedSnapshot<Value>;

TEST(SharedSnapshot, HasNoValueUntilOneIsStored) {
  Snapshot snapshot{};
  Value value = Value::of(7);
  EXPECT_FALSE(snapshot.is_set());
  EXPECT_EQ(snapshot.load(value), 0u);
  EXPECT_EQ(value.words[0], 7u) << "unchanged";
  snapshot.store(Value::of(8));
  EXPECT_TRUE(snapshot.is_set());
  EXPECT_EQ(snapshot.load(value), snapshot.generation());
  EXPECT_EQ(value.words[4], 8u);
}

TEST(SharedSnapshot, CopiesTheBeginningAlone) {
  Snapshot snapshot{};
  snapshot.store({{1, 2, 3, 4, 5}});
  Value value = Value::of(9);
  EXPECT_EQ(snapshot.load<16>(value), 1u);
  EXPECT_EQ(value.words[1], 2u);
  EXPECT_EQ(value.words[2], 9u) << "unchanged";
}

TEST(SharedSnapshot, NeverShowsAMix) {
  Snapshot snapshot{};
  snapshot.store(Value::of(0));
  std::atomic<bool> done = false;
  std::thread reader([&] {
    while (!done) {
      Value value = Value::of(0);
      snapshot.load(value);
      ASSERT_TRUE(value.is_whole());
    }
  });
  for (std::uint64_t i = 1; i < 200'000; ++i) snapshot.store(Value::of(i));
  done = true;
  reader.join();
}

// What a program that has the memory mapped for writing can do to it at worst.
TEST(SharedSnapshot, GivesUpWhenTheWriterNeverRests) {
  Snapshot snapshot{};
  snapshot.store(Value::of(1));
  auto& generation = reinterpret_cast<std::atomic<std::uint64_t>&>(snapshot);
  std::atomic<bool> done = false;
  std::thread writer([&] {
    while (!done) generation.fetch_add(2);
  });
  for (int i = 0; i < 1000; ++i) {
    Value value = Value::of(9);
    snapshot.load(value);  // ends, with a value or without
    EXPECT_TRUE(value.is_whole());
  }
  done = true;
  writer.join();
}

// Stops the writer after each instruction: what is there then is what SIGKILL would leave.
TEST(SharedSnapshot, AWriterKilledAtAnyInstructionLeavesAWholeValue) {
  void* memory =
      ::mmap(nullptr, sizeof(Snapshot), PROT_READ | PROT_WRITE, MAP_SHARED | MAP_ANONYMOUS, -1, 0);
  ASSERT_NE(memory, MAP_FAILED);
  auto& snapshot = *static_cast<Snapshot*>(memory);
  snapshot.store(Value::of(1));
  const pid_t writer = ::fork();
  if (writer == 0) {
    if (::ptrace(PTRACE_TRACEME, 0, nullptr, nullptr)) ::_exit(1);
    ::raise(SIGSTOP);
    snapshot.store(Value::of(2));
    ::_exit(0);
  }
  int status = 0;
  ::waitpid(writer, &status, 0);
  if (!WIFSTOPPED(status)) {
    ::munmap(memory, sizeof(Snapshot));
    GTEST_SKIP() << "processes cannot be traced here (qemu-user cannot)";
  }
  int steps = 0;
  Value seen = Value::of(0);
  // 100,000: far more than store() has, also under sanitizers; what follows is the child's end.
  while (steps < 100'000 && seen.words[0] != 2 &&
         ::ptrace(PTRACE_SINGLESTEP, writer, nullptr, nullptr) == 0 &&
         ::waitpid(writer, &status, 0) == writer && WIFSTOPPED(status)) {
    ++steps;
    ASSERT_NE(snapshot.load(seen), 0u);
    ASSERT_TRUE(seen.is_whole()) << "after instruction " << steps;
  }
  EXPECT_EQ(seen.words[0], 2u);
  EXPECT_GT(steps, 10);
  ::kill(writer, SIGKILL);
  ::waitpid(writer, &status, 0);

  // The next writer continues after one that died while it filled the other record.
  auto* words = static_cast<std::uint64_t*>(memory);
  words[1 + (snapshot.generation() + 1) % 2 * 5] = 99;
  ASSERT_NE(snapshot.load(seen), 0u);
  EXPECT_EQ(seen.words[0], 2u);
  snapshot.store(Value::of(3));
  ASSERT_NE(snapshot.load(seen), 0u);
  EXPECT_TRUE(seen.is_whole());
  EXPECT_EQ(seen.words[0], 3u);
  ::munmap(memory, sizeof(Snapshot));
}

}  // namespace
}  // namespace dssm
