// SPDX-License-Identifier: Apache-2.0
//
// A lock between processes that survives the death of its holder: glibc's robust, process-shared
// mutex. The kernel marks it when a thread dies with the lock held, and the next call of
// lock_robust() returns `recovered`. It is in shared memory and is never destroyed.
//
// Not the error-checking kind: that one recognizes its holder by the thread id, and threads in two
// containers may have the same one.
#pragma once

#include <pthread.h>

#include <cerrno>

namespace dssm::ring {

inline void init_robust_lock(pthread_mutex_t& mutex) noexcept {
  pthread_mutexattr_t attributes;
  pthread_mutexattr_init(&attributes);
  pthread_mutexattr_setpshared(&attributes, PTHREAD_PROCESS_SHARED);
  pthread_mutexattr_setrobust(&attributes, PTHREAD_MUTEX_ROBUST);
  pthread_mutex_init(&mutex, &attributes);
  pthread_mutexattr_destroy(&attributes);
}

enum class LockResult : unsigned char {
  locked,
  recovered,  // locked; the last holder died: repair what it left
  busy,       // try_lock_robust() only: another thread holds it
  refused,    // a program with write access has damaged the mutex
};

namespace detail {
inline LockResult lock_result(pthread_mutex_t& mutex, int result) noexcept {
  if (result == 0) return LockResult::locked;
  if (result == EBUSY) return LockResult::busy;
  if (result != EOWNERDEAD) return LockResult::refused;
  pthread_mutex_consistent(&mutex);
  return LockResult::recovered;
}
}  // namespace detail

inline LockResult lock_robust(pthread_mutex_t& mutex) noexcept {
  return detail::lock_result(mutex, pthread_mutex_lock(&mutex));
}

inline LockResult try_lock_robust(pthread_mutex_t& mutex) noexcept {
  return detail::lock_result(mutex, pthread_mutex_trylock(&mutex));
}

}  // namespace dssm::ring
