// SPDX-License-Identifier: Apache-2.0
//
// Opens streams for Session::subscribe() in a thread of its own, one after the other, each again
// and again until it succeeds or fails for good. It waits for streams as await_raw_reader() does.
#pragma once

#include <condition_variable>
#include <dssm/reader.hpp>
#include <functional>
#include <list>
#include <memory>
#include <mutex>
#include <optional>
#include <thread>

#include "client/src/stream_wait.hpp"

namespace dssm::detail {

class Client;

class Opener {
 public:
  struct Request {
    explicit Request(const StreamId& id) : wait_(id, MonoClock::now()) {}

    // One attempt. was_missing: as StreamWait. Keeps the client.
    std::function<Result<RawReader>(bool was_missing)> open;
    // Called once, unless remove() comes before: the reader, or an error that is not retryable.
    std::function<void(Result<RawReader>)> done;

   private:
    friend class Opener;
    StreamWait wait_;  // these are guarded by the mutex
    bool was_tried_ = false, is_removed_ = false, is_awaited_ = true;
    std::optional<Error> failure_;
  };

  // The client destroys the opener first of all its parts.
  static Result<std::unique_ptr<Opener>> start(Client& client);
  Opener(const Opener&) = delete;
  Opener& operator=(const Opener&) = delete;
  ~Opener();

  // Adds a request, and waits for its first attempt, at most so long. An error of that attempt that
  // is not retryable is returned, and done() not called. Any thread.
  std::optional<Error> add(const std::shared_ptr<Request>& request, Duration at_most);
  // Removes it, if it is still there. Does not wait for an attempt. Any thread.
  void remove(Request& request) noexcept;

 private:
  // Shared with the thread and the watch, which may outlive the opener.
  struct Shared;
  explicit Opener(std::shared_ptr<Shared> shared) noexcept : shared_(std::move(shared)) {}

  const std::shared_ptr<Shared> shared_;
  std::thread thread_;
};

}  // namespace dssm::detail
