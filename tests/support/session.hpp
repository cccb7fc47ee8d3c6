// SPDX-License-Identifier: Apache-2.0
//
// Streams of, and sessions with, a test's dssmd, with timeouts for a busy machine.
#pragma once

#include <chrono>
#include <condition_variable>
#include <dssm/dssm.hpp>
#include <mutex>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {

// For a stream that only has to exist.
inline constexpr History kShort{16, std::chrono::milliseconds(1)};
// For a stream whose readers must lose nothing, even on a busy machine.
inline constexpr History kLong{1 << 16, std::chrono::milliseconds(1)};

inline Session connect_to(const std::string& socket_path) {
  return Session::connect({.socket_path = socket_path, .request_timeout = std::chrono::seconds(60)})
      .value();
}

// Waits for a request 200 ms at most. Tries again: a busy dssmd may be late with its greeting.
inline Session connect_impatiently(const std::string& socket_path) {
  for (;;) {
    auto session = Session::connect(
        {.socket_path = socket_path, .request_timeout = std::chrono::milliseconds(200)});
    if (session) return *std::move(session);
    std::this_thread::sleep_for(kPollPause);
  }
}

inline Session connect(const DaemonProcess& daemon) { return connect_to(daemon.socket_path()); }

// What a watch of the session reports from now on.
class SeenEvents {
 public:
  explicit SeenEvents(Session& session)
      : watch_(session
                   .watch([this](const StreamEvent& event) {
                     const std::lock_guard lock(mutex_);
                     events_.push_back(event);
                     changed_.notify_all();
                   })
                   .value()) {}
  // All, as soon as there are so many.
  std::vector<StreamEvent> await(std::size_t count) {
    std::unique_lock lock(mutex_);
    changed_.wait(lock, [&] { return events_.size() >= count; });
    return events_;
  }

 private:
  std::mutex mutex_;
  std::condition_variable changed_;
  std::vector<StreamEvent> events_;
  Session::Watch watch_;  // the first to end: it calls the function above
};

}  // namespace dssm::test
