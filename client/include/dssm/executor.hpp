// SPDX-License-Identifier: Apache-2.0
//
// Callbacks: Session::subscribe() calls a function of the program with each sample of a stream.
//
//   const auto scans = session.subscribe<Scan>("lidar", [](const dssm::Sample<Scan>& scan) {
//     use(scan.value, scan.time());
//   });
//
// An Executor is what calls. Without one, all subscriptions of a session share a thread of the
// session. With one, the calls come from Executor::run(), or from Executor::run_ready() in the
// program's own loop of poll(), epoll or libevent.
//
//   order      one executor calls one callback at a time, each with the samples of its stream in
//              order. After 16 samples or 1 ms the next subscription has its turn, so that one with
//              many samples, or with a slow callback, delays the others but does not stop them
//   waiting    a stream that does not exist, whose host does not answer, or whose clock is not good
//              enough, is awaited without an end, as by await_reader(). It is opened by a thread
//              that all subscriptions of a session share
//   clocks     samples are read by tid, so a clock that is out of bounds refuses none: ask
//              RawReader::clock_in_bounds()
//   exceptions one that a callback throws leaves run() or run_ready(). The executor stays usable,
//              and continues with the next sample. In a thread of DSSM it ends the program
//              (std::terminate)
//   callbacks  may call everything here and in Session, also end their own subscription
//   cost       per sample, beside the read: two threads are woken, the one of ready_fd() and the
//              executor's. For the least delay, wait in a RawReader. No thread polls
//   fork       a child must subscribe in a session of its own
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/reader.hpp>
#include <dssm/result.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <span>
#include <type_traits>
#include <utility>

namespace dssm::detail {
class ExecutorState;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// Calls callbacks in the thread that calls run() or run_ready().
//
//   threads  one thread at a time calls run() or run_ready(), and none from inside a callback
//            (ends the program); stop() and Session::subscribe() may be called by any. With start()
//            the executor's own thread is the one that calls
//   moved    a moved-from executor may only be assigned to or destroyed
class Executor {
 public:
  //   fails  system (no descriptor left)
  static Result<Executor> create();

  Executor(Executor&&) noexcept;
  Executor& operator=(Executor&&) noexcept;
  // Ends all its subscriptions and its thread; waits for a callback that this thread is running,
  // unless it is called from that callback.
  ~Executor();

  // Calls callbacks until stop(), until `deadline` (kNever: no limit; one in the past: calls what
  // is ready) or for `timeout`.
  //   returns  ready (stop() was called) | timeout | interrupted (a signal handler ran while there
  //            was nothing to call)
  WaitStatus run(MonoTime deadline = kNever);
  WaitStatus run(Duration timeout) { return run(deadline_in(timeout)); }

  // Ends run() after the callback that is running; if no run() is active, the next one.
  // Async-signal-safe, so that a handler of SIGINT may call it.
  void stop() noexcept;

  // For a loop of the program's own: a descriptor for poll(), epoll or an event library that is
  // readable while there is something to call. Then call run_ready(), which lets each subscription
  // that is ready have one turn, and returns the number of callbacks called. It does not wait for
  // samples; when a stream restarts, it waits for dssmd's answer, as each read does. The executor
  // owns the descriptor: do not read or close it.
  int fd() const noexcept;
  std::size_t run_ready();

  // Calls run() in a thread of its own, with all signals blocked, until the executor is destroyed.
  // Once per executor.
  //   fails  system (no thread left)
  Result<void> start();

 private:
  friend class Session;
  explicit Executor(std::shared_ptr<detail::ExecutorState> state) noexcept;
  std::shared_ptr<detail::ExecutorState> state_;
};

enum class WhichSamples : unsigned char {
  // Each in order, as read_next() returns them. The first call is about the newest sample that
  // there is when the stream is opened. If the stream did not exist at subscribe() and is created
  // on this PC later, it is about that stream's first one.
  each,
  // The same, but the first call is about the oldest sample that the ring holds.
  each_from_oldest,
  // The newest one; those that are written while the callback runs are left out, but for the last.
  newest,
};

struct SubscribeOptions {
  WhichSamples which = WhichSamples::each;
  // Of a stream of another host: as in Session::open_raw_reader().
  FetchHistory history = FetchHistory::when_read;
  // What calls; nullptr: a thread of the session. Used by subscribe() only.
  Executor* executor = nullptr;
  // Called by the executor, at most once for each reason, when the stream cannot be read: what
  // subscribe() would fail with, but found out later, and RawReader::restart_error(). After
  // no_permission for a stream that was open, the calls continue when it may be read again; after
  // all others the subscription gets no further sample. Empty: SessionOptions::on_notice gets the
  // text.
  std::function<void(const Error&)> on_error = {};
};

// What Session::subscribe() calls, with one parameter or with two.
template <class Callback, class T>
concept SampleCallback = requires(Callback& callback, const Sample<T>& sample) {
  callback(sample);
}
|| requires(Callback& callback, const Sample<T>& sample, Reader<T>& reader) {
  callback(sample, reader);
};

// What Session::subscribe_raw() calls. `payload` has the bytes of this sample, aligned for any
// type, and is valid until the callback returns. The reader is the subscription's own: reads by
// time leave its cursor; after seek() or a read by tid the calls continue from there.
using RawCallback =
    std::function<void(std::span<const std::byte> payload, const SampleInfo&, RawReader&)>;

// A subscription, until it is destroyed.
//
//   threads   any thread may call any function and destroy it
//   lifetime  it keeps its session's connection; the Session may be destroyed before it. If the
//             executor is destroyed before it, there are no further calls
//   moved     a moved-from object may only be assigned to or destroyed
class StreamCallback {
 public:
  StreamCallback(StreamCallback&&) noexcept;
  StreamCallback& operator=(StreamCallback&&) noexcept;
  // Ends the calls and destroys the callback. Waits for one that is running in another thread: do
  // not hold a lock that the callback needs. Called from inside that callback, it does not wait;
  // the callback is then destroyed when it returns.
  ~StreamCallback();

  // Whether the stream has been found and opened.
  bool is_open() const noexcept;
  // As RawReader's functions of these names: samples of the stream that the callback did not get
  // because the ring no longer held them (WhichSamples::newest does not count those that it leaves
  // out); how often the stream restarted, whose tids then start at 0 again.
  std::uint64_t lost_samples() const noexcept;
  std::uint64_t restarts() const noexcept;

 private:
  friend class Session;
  struct State;
  explicit StreamCallback(std::unique_ptr<State> state) noexcept;
  std::unique_ptr<State> state_;
};

namespace detail {

// A subscription's reader, place for a sample, and callback, with the type that the program uses.
class SampleCall {
 public:
  SampleCall() = default;
  SampleCall(const SampleCall&) = delete;
  SampleCall& operator=(const SampleCall&) = delete;
  virtual ~SampleCall() = default;
  virtual RawReader& use(RawReader reader) = 0;  // once; the result is what read() reads
  virtual ReadStatus read_next() = 0;
  virtual ReadStatus read_newest() = 0;
  virtual const SampleInfo& info() const = 0;  // of the last one read
  virtual void call() = 0;                     // with that one
};

template <Payload T, class Callback>
class TypedSampleCall final : public SampleCall {
 public:
  explicit TypedSampleCall(Callback callback) : callback_(std::move(callback)) {}

  RawReader& use(RawReader reader) override { return reader_.emplace(std::move(reader)); }
  ReadStatus read_next() override { return reader_->read_next(sample_.value, sample_.info); }
  ReadStatus read_newest() override { return reader_->read_newest(sample_.value, sample_.info); }
  const SampleInfo& info() const override { return sample_.info; }
  void call() override {
    const Sample<T>& sample = sample_;
    if constexpr (std::is_invocable_v<Callback&, const Sample<T>&, Reader<T>&>) {
      callback_(sample, *reader_);
    } else {
      callback_(sample);
    }
  }

 private:
  std::optional<Reader<T>> reader_;
  Sample<T> sample_;
  Callback callback_;
};

}  // namespace detail
}  // namespace dssm
#pragma GCC visibility pop
