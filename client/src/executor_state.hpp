// SPDX-License-Identifier: Apache-2.0
//
// What is behind Executor and StreamCallback. An epoll instance waits for the readers' ready_fd()
// and for an eventfd, which is signalled for what epoll cannot see: subscriptions to add, a stop,
// and samples that are left after a turn.
//
// Only the thread in run() touches readers and callbacks, in turns. A turn is announced under the
// mutex (current_), so that end() can wait for it; after end() none begins.
#pragma once

#include <unistd.h>

#include <atomic>
#include <condition_variable>
#include <deque>
#include <dssm/executor.hpp>
#include <map>
#include <memory>
#include <mutex>
#include <thread>

#include "core/base/unique_fd.hpp"

namespace dssm::detail {

// One subscription, shared by its StreamCallback, its executor, and the thread that opens it.
struct CallbackState {
  CallbackState(std::unique_ptr<SampleCall> sample_call, SubscribeOptions options)
      : which(options.which), call(std::move(sample_call)), on_error(std::move(options.on_error)) {}

  const WhichSamples which;
  std::atomic<bool> is_open = false;
  std::atomic<std::uint64_t> lost = 0, restarts = 0;

  // Set under the executor's mutex.
  std::atomic<bool> ended = false;
  bool ended_in_own_turn = false;  // the end of that turn destroys `call`

  // Of the executor's thread; after the end, of the thread that ended it.
  std::unique_ptr<SampleCall> call;
  std::function<void(const Error&)> on_error;
  RawReader* reader = nullptr;  // in `call`; null until the stream is open
  int ready_fd = -1;            // of `reader`
  Tid last = kNoTid;            // WhichSamples::newest: of the last call
  bool is_queued = false;       // in ExecutorState::ready_
  bool reported = false;        // the present restart_error()
};

class ExecutorState {
 public:
  // Samples in one turn: at most so many, and none after so much time.
  static constexpr int kMaxTurnSamples = 16;
  static constexpr Duration kMaxTurn = std::chrono::milliseconds(1);

  static Result<std::shared_ptr<ExecutorState>> create();
  ExecutorState(UniqueFd epoll, UniqueFd wake)
      : epoll_(std::move(epoll)), wake_fd_(std::move(wake)) {}

  // --- any thread

  // The subscription's stream was opened, and the reader has a ready_fd(); or it cannot be, for the
  // reason in `opened`.
  void add(std::shared_ptr<CallbackState> callback, Result<RawReader> opened);
  // After it there are no further calls; waits for a running one that is not this thread's.
  void end(CallbackState& callback) noexcept;
  void stop() noexcept;
  int fd() const noexcept { return epoll_.get(); }
  bool is_closed() const noexcept { return closed_; }

  // Starts the thread, which shares this object.
  static Result<void> start(const std::shared_ptr<ExecutorState>& state);
  // Ends all subscriptions, and the thread.
  void close() noexcept;

  // --- one thread at a time

  WaitStatus run(MonoTime deadline);
  std::size_t run_ready();

 private:
  struct Added {
    std::shared_ptr<CallbackState> callback;
    Result<RawReader> opened;
  };
  class Running;
  class Turn;

  void wake() noexcept;
  // Lets each subscription that is ready have one turn. With `until_stop`, none begins after
  // stop().
  std::size_t round(bool until_stop);
  void collect_ready();
  void enqueue(const std::shared_ptr<CallbackState>& callback);
  void take_in(Added added);
  void report(CallbackState& callback, const Error& error);
  // Calls the callback for what there is, within the limits of a turn. False: that was all.
  bool call(CallbackState& callback, std::size_t& calls);
  bool call_newest(CallbackState& callback, std::size_t& calls);
  void check_restart(CallbackState& callback);
  void forget(CallbackState& callback) noexcept;  // with the mutex

  const UniqueFd epoll_, wake_fd_;
  const pid_t owner_pid_ = ::getpid();
  std::atomic<bool> stopping_ = false, closed_ = false, running_ = false;

  // Of the thread in run().
  std::deque<std::shared_ptr<CallbackState>> ready_;  // each once: they have the next turns

  std::mutex mutex_;  // guards what follows
  std::condition_variable turn_ended_;
  std::thread thread_;
  std::thread::id runner_;                                         // the thread in run()
  CallbackState* current_ = nullptr;                               // has its turn
  std::map<CallbackState*, std::shared_ptr<CallbackState>> open_;  // waited for by epoll_
  std::deque<Added> added_;
};

}  // namespace dssm::detail
