// SPDX-License-Identifier: Apache-2.0
//
// Executor: turns, one at a time, each for one subscription. What a turn leaves undone comes last
// in ready_. When run() ends with something in there, it signals wake_fd_, so that fd() stays
// readable.
#include <poll.h>
#include <sys/epoll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <array>
#include <cerrno>
#include <dssm/executor.hpp>

#include "client/src/executor_state.hpp"
#include "core/base/check.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm {
namespace detail {

// --- the thread that calls

class ExecutorState::Running {
 public:
  explicit Running(ExecutorState& state) : state_(state) {
    // Called by two threads, or from inside a callback.
    DSSM_CHECK(!state_.running_.exchange(true));
    const std::lock_guard guard(state_.mutex_);
    state_.runner_ = std::this_thread::get_id();
  }
  Running(const Running&) = delete;
  Running& operator=(const Running&) = delete;
  ~Running() {
    {
      const std::lock_guard guard(state_.mutex_);
      state_.runner_ = {};
      if (!state_.ready_.empty() || !state_.added_.empty()) state_.wake();
    }
    state_.running_ = false;
  }

 private:
  ExecutorState& state_;
};

// A callback that throws leaves more_ set, so that its subscription has another turn.
class ExecutorState::Turn {
 public:
  Turn(ExecutorState& state, std::shared_ptr<CallbackState> callback)
      : state_(state), callback_(std::move(callback)) {
    const std::lock_guard guard(state_.mutex_);
    if (callback_->ended || state_.closed_) return;
    state_.current_ = callback_.get();
    more_ = true;
  }
  Turn(const Turn&) = delete;
  Turn& operator=(const Turn&) = delete;
  ~Turn() {
    std::unique_ptr<SampleCall> unused_call;
    std::function<void(const Error&)> unused_on_error;
    {
      const std::lock_guard guard(state_.mutex_);
      if (state_.current_ == callback_.get()) state_.current_ = nullptr;
      if (callback_->ended_in_own_turn) {
        unused_call = std::move(callback_->call);
        unused_on_error = std::move(callback_->on_error);
      }
    }
    state_.turn_ended_.notify_all();
    if (more_ && !callback_->ended) state_.enqueue(callback_);
  }

  bool has_begun() const noexcept { return state_.current_ == callback_.get(); }
  void set_more(bool more) noexcept { more_ = more; }

 private:
  ExecutorState& state_;
  const std::shared_ptr<CallbackState> callback_;
  bool more_ = false;
};

Result<std::shared_ptr<ExecutorState>> ExecutorState::create() {
  UniqueFd epoll(::epoll_create1(EPOLL_CLOEXEC));
  UniqueFd wake(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
  epoll_event event{};  // without a pointer to a subscription
  event.events = EPOLLIN;
  if (!epoll || !wake || ::epoll_ctl(epoll.get(), EPOLL_CTL_ADD, wake.get(), &event) != 0) {
    return os_error("create an executor");
  }
  return std::make_shared<ExecutorState>(std::move(epoll), std::move(wake));
}

WaitStatus ExecutorState::run(MonoTime deadline) {
  const Running running(*this);
  for (;;) {
    if (closed_ || stopping_.exchange(false)) return WaitStatus::ready;
    round(true);
    if (closed_ || stopping_) continue;
    const MonoTime now = MonoClock::now();
    if (deadline != kNever && now >= deadline) return WaitStatus::timeout;
    if (!ready_.empty()) continue;
    pollfd event{epoll_.get(), POLLIN, 0};
    const timespec timeout = timespec_of(deadline - now);
    if (::ppoll(&event, 1, deadline == kNever ? nullptr : &timeout, nullptr) < 0 &&
        errno == EINTR && !stopping_) {
      return WaitStatus::interrupted;
    }
  }
}

std::size_t ExecutorState::run_ready() {
  const Running running(*this);
  return round(false);
}

std::size_t ExecutorState::round(bool until_stop) {
  collect_ready();
  std::size_t calls = 0;
  for (std::size_t left = ready_.size(); left > 0; --left) {
    if (closed_ || (until_stop && stopping_)) break;
    const std::shared_ptr<CallbackState> callback = std::move(ready_.front());
    ready_.pop_front();
    callback->is_queued = false;
    Turn turn(*this, callback);
    if (turn.has_begun()) turn.set_more(call(*callback, calls));
  }
  return calls;
}

// What epoll reports, and new subscriptions.
void ExecutorState::collect_ready() {
  std::array<epoll_event, 64> events;
  const int count = ::epoll_wait(epoll_.get(), events.data(), static_cast<int>(events.size()), 0);
  std::size_t added = 0;
  {
    const std::lock_guard guard(mutex_);
    for (int i = 0; i < count; ++i) {
      auto* key = static_cast<CallbackState*>(events[static_cast<std::size_t>(i)].data.ptr);
      if (key == nullptr) {
        std::uint64_t signals = 0;
        [[maybe_unused]] const ssize_t got = ::read(wake_fd_.get(), &signals, sizeof signals);
      } else if (const auto found = open_.find(key); found != open_.end()) {
        enqueue(found->second);
      }
    }
    added = added_.size();  // a callback may add more
  }
  for (; added > 0 && !closed_; --added) {
    std::unique_lock lock(mutex_);
    if (added_.empty()) return;
    Added next = std::move(added_.front());
    added_.pop_front();
    lock.unlock();
    take_in(std::move(next));
  }
}

void ExecutorState::enqueue(const std::shared_ptr<CallbackState>& callback) {
  if (std::exchange(callback->is_queued, true)) return;
  ready_.push_back(callback);
}

void ExecutorState::take_in(Added added) {
  CallbackState& callback = *added.callback;
  Turn turn(*this, added.callback);
  if (!turn.has_begun()) return;
  turn.set_more(false);
  if (!added.opened) return report(callback, added.opened.error());
  callback.reader = &callback.call->use(*std::move(added.opened));
  callback.ready_fd = callback.reader->ready_fd().value_or(-1);
  epoll_event event{};
  event.events = EPOLLIN;
  event.data.ptr = &callback;
  bool is_waited_for = false;
  {
    const std::lock_guard guard(mutex_);
    if (callback.ended) return;
    is_waited_for = ::epoll_ctl(epoll_.get(), EPOLL_CTL_ADD, callback.ready_fd, &event) == 0;
    if (is_waited_for) open_[&callback] = added.callback;
  }
  if (!is_waited_for) {
    return report(callback, os_error("wait for '" + callback.reader->id().str() + "'"));
  }
  callback.is_open = true;
  turn.set_more(true);
}

void ExecutorState::report(CallbackState& callback, const Error& error) {
  if (callback.on_error) callback.on_error(error);
}

bool ExecutorState::call(CallbackState& callback, std::size_t& calls) {
  callback.reader->clear_ready();  // before reading, so that no sample in between is missed
  if (callback.which == WhichSamples::newest) return call_newest(callback, calls);
  const MonoTime end = deadline_in(kMaxTurn);
  for (int i = 0; i < kMaxTurnSamples; ++i) {
    const ReadStatus status = callback.call->read_next();
    callback.lost.store(callback.reader->lost_samples(), std::memory_order_relaxed);
    callback.restarts.store(callback.reader->restarts(), std::memory_order_relaxed);
    if (status == ReadStatus::lapped) return true;
    if (status == ReadStatus::restarted) continue;
    if (status != ReadStatus::ok) return check_restart(callback), false;
    ++calls;
    callback.call->call();
    if (callback.ended) return false;
    if (MonoClock::now() >= end) return true;
  }
  return true;
}

bool ExecutorState::call_newest(CallbackState& callback, std::size_t& calls) {
  const ReadStatus status = callback.call->read_newest();
  const std::uint64_t restarts = callback.reader->restarts();
  if (callback.restarts.exchange(restarts, std::memory_order_relaxed) != restarts) {
    callback.last = kNoTid;
  }
  if (status == ReadStatus::restarted || status == ReadStatus::lapped) return true;
  const Tid tid = status == ReadStatus::ok ? callback.call->info().tid : callback.last;
  if (tid == callback.last) return check_restart(callback), false;
  callback.last = tid;
  ++calls;
  callback.call->call();
  return false;
}

void ExecutorState::check_restart(CallbackState& callback) {
  const std::optional<Error> error = callback.reader->restart_error();
  const bool is_new = error && !callback.reported;
  callback.reported = error.has_value();
  if (!is_new) return;
  if (error->code != Errc::no_permission) {  // the reader never continues
    const std::lock_guard guard(mutex_);
    forget(callback);
  }
  report(callback, *error);
}

// --- other threads

void ExecutorState::wake() noexcept {
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(wake_fd_.get(), &one, sizeof one);
}

void ExecutorState::stop() noexcept {
  stopping_ = true;
  wake();
}

void ExecutorState::add(std::shared_ptr<CallbackState> callback, Result<RawReader> opened) {
  Added added{std::move(callback), std::move(opened)};  // destroyed without the mutex
  const std::lock_guard guard(mutex_);
  if (closed_ || added.callback->ended) return;
  added_.push_back(std::move(added));
  wake();
}

void ExecutorState::forget(CallbackState& callback) noexcept {
  if (open_.erase(&callback) == 0) return;
  ::epoll_ctl(epoll_.get(), EPOLL_CTL_DEL, callback.ready_fd, nullptr);
}

void ExecutorState::end(CallbackState& callback) noexcept {
  if (::getpid() != owner_pid_) return;
  std::unique_ptr<SampleCall> unused_call;
  std::function<void(const Error&)> unused_on_error;
  std::deque<Added> unused_readers;
  std::unique_lock lock(mutex_);
  callback.ended = true;
  // Perhaps the program never calls run_ready() again, which would take it in.
  for (auto one = added_.begin(); one != added_.end();) {
    if (one->callback.get() != &callback) {
      ++one;
      continue;
    }
    unused_readers.push_back(std::move(*one));
    one = added_.erase(one);
  }
  forget(callback);
  if (current_ == &callback) {
    callback.ended_in_own_turn = runner_ == std::this_thread::get_id();
    if (callback.ended_in_own_turn) return;
    turn_ended_.wait(lock, [&] { return current_ != &callback; });
  }
  unused_call = std::move(callback.call);
  unused_on_error = std::move(callback.on_error);
  lock.unlock();
}

Result<void> ExecutorState::start(const std::shared_ptr<ExecutorState>& state) {
  const std::lock_guard guard(state->mutex_);
  DSSM_CHECK(!state->thread_.joinable());
  state->thread_ = DSSM_TRY(quiet_thread("callbacks", [state] {
    while (!state->closed_) static_cast<void>(state->run(kNever));
  }));
  return {};
}

void ExecutorState::close() noexcept {
  if (::getpid() != owner_pid_) {  // the thread runs in the parent only
    if (thread_.joinable()) thread_.detach();
    return;
  }
  std::unique_lock lock(mutex_);
  closed_ = true;  // no turn begins any more
  wake();
  std::thread thread = std::move(thread_);
  lock.unlock();
  if (thread.get_id() == std::this_thread::get_id()) {
    thread.detach();  // called from a callback, after which the thread ends
  } else if (thread.joinable()) {
    thread.join();
  }
  lock.lock();
  if (runner_ != std::this_thread::get_id()) {
    turn_ended_.wait(lock, [this] { return current_ == nullptr; });
  }
  std::deque<Added> added = std::move(added_);
  const auto open = open_;
  lock.unlock();
  for (const Added& one : added) end(*one.callback);
  for (const auto& [key, callback] : open) end(*callback);
}

}  // namespace detail

Executor::Executor(std::shared_ptr<detail::ExecutorState> state) noexcept
    : state_(std::move(state)) {}
Executor::Executor(Executor&&) noexcept = default;
Executor& Executor::operator=(Executor&& other) noexcept {
  const Executor before(std::exchange(state_, std::move(other.state_)));
  return *this;
}
Executor::~Executor() {
  if (state_) state_->close();
}

Result<Executor> Executor::create() { return Executor(DSSM_TRY(detail::ExecutorState::create())); }

// A callback may destroy the executor that calls it.
WaitStatus Executor::run(MonoTime deadline) {
  const std::shared_ptr<detail::ExecutorState> state = state_;
  return state->run(deadline);
}
std::size_t Executor::run_ready() {
  const std::shared_ptr<detail::ExecutorState> state = state_;
  return state->run_ready();
}

void Executor::stop() noexcept { state_->stop(); }
int Executor::fd() const noexcept { return state_->fd(); }
Result<void> Executor::start() { return detail::ExecutorState::start(state_); }

}  // namespace dssm
