// SPDX-License-Identifier: Apache-2.0
//
// A lock between processes that survives the death of its holder, and that a program which writes
// anything to it cannot use against the others.
//
// It is the kernel's robust futex (get_robust_list(2), Documentation/locking/robust-futex-ABI.rst):
// a word in shared memory holds the holder's thread id, and the holder's thread has the word in a
// list that the kernel walks when the thread ends. glibc's robust mutex does the same, but keeps
// the list's pointers beside the word, so that whoever may write to the word can make the others
// write to any address. Here the word is in the last bytes of a shared page, and the list's node in
// a private page mapped behind it: where the kernel expects it, and out of reach of other
// processes.
//
// A program that scribbles on the word can let two writers in at once, which damages samples of its
// own stream, or keep all others out. They wait for a bounded time.
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <utility>

#include "core/base/sealed_memory.hpp"

namespace dssm::ring {

// Bytes at the end of a memory file's first page that belong to its lock. The size of a page is
// the system's: the node has to be in another one.
inline constexpr std::size_t kLockBytes = 24;

enum class LockResult : unsigned char {
  locked,
  recovered,  // locked; the last holder died: repair what it left
  busy,       // another thread holds it
};

// A mapped lock. Thread-safe; of this process's threads as of all others, one holds it.
class RobustLock {
 public:
  // How long lock() waits in all, not counting time in which the thread stands still; and how
  // long after it did so in vain, until a thread of this mapping got the lock: a holder is stopped,
  // or the word is damaged, and the caller has other work.
  static constexpr Duration kMaxWait = std::chrono::seconds(2);
  static constexpr Duration kMaxWaitAgain = std::chrono::milliseconds(10);

  // Maps the lock of `fd`, a memory file of at least one page, sealed against shrinking. Does not
  // keep `fd`.
  static Result<RobustLock> map(int fd);

  RobustLock() = default;

  // Waits for the lock. The thread must not hold it: that is waited for, too.
  //   returns  `busy` when the wait was in vain
  LockResult lock() const noexcept;
  // Does not wait.
  LockResult try_lock() const noexcept;
  // By the thread that holds it; in others, a forked child among them, without effect.
  void unlock() const noexcept;

 private:
  struct Private;
  explicit RobustLock(SharedMapping mapping) noexcept : mapping_(std::move(mapping)) {}
  std::atomic<std::uint32_t>& word() const noexcept;
  Private& own() const noexcept;
  LockResult take(bool may_wait) const noexcept;
  SharedMapping mapping_;
};

}  // namespace dssm::ring
