// SPDX-License-Identifier: Apache-2.0
//
// What callbacks were called with, for the tests of Session::subscribe().
#pragma once

#include <poll.h>

#include <condition_variable>
#include <dssm/dssm.hpp>
#include <mutex>
#include <vector>

namespace dssm::test {

// Things that happen in other threads, in their order; waited for by number.
template <class Event>
class Events {
 public:
  void add(Event event) {
    const std::lock_guard guard(mutex_);
    events_.push_back(std::move(event));
    changed_.notify_all();
  }
  std::vector<Event> await(std::size_t count) {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [&] { return events_.size() >= count; });
    return events_;
  }
  std::vector<Event> now() { return await(0); }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<Event> events_;
};

// As a program's own loop does, until `done`.
template <class Done>
void run_until(Executor& executor, Done done) {
  while (!done()) {
    pollfd event{executor.fd(), POLLIN, 0};
    ::poll(&event, 1, -1);
    executor.run_ready();
  }
}

inline std::vector<Tid> tids(Tid first, Tid last) {
  std::vector<Tid> all;
  for (Tid tid = first; tid <= last; ++tid) all.push_back(tid);
  return all;
}

}  // namespace dssm::test
