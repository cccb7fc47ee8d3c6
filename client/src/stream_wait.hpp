// SPDX-License-Identifier: Apache-2.0
//
// One wait for a stream that cannot be opened yet: when to try again, and what to report to the
// program.
#pragma once

#include <dssm/error.hpp>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <set>
#include <string>
#include <vector>

namespace dssm::detail {

// Not thread-safe. Events that arrive during an attempt count: it may have come too early.
class StreamWait {
 public:
  // Between attempts where no event of a stream announces success.
  static constexpr Duration kRetryPause = std::chrono::milliseconds(500);
  // A wait that takes longer is reported.
  static constexpr Duration kNoticeAfter = std::chrono::seconds(2);

  StreamWait(StreamId id, MonoTime now) : id_(std::move(id)), began_(now), next_attempt_(now) {}

  // Whether a stream of that name was missing in some attempt.
  bool was_missing() const noexcept { return was_missing_; }
  bool is_about(const StreamId& id) const noexcept {
    return id.name == id_.name && id.id == id_.id;
  }

  void begin_attempt() noexcept { was_added_ = false; }
  // It failed with an error that is retryable. `is_watched`: added() is called when the stream
  // appears.
  void failed(Error error, bool is_watched, MonoTime now);
  // The stream may be there now.
  void added() noexcept {
    was_added_ = true;
    next_attempt_ = MonoTime::min();
  }

  MonoTime next_attempt() const noexcept { return next_attempt_; }
  // When there is something to report; kNever: not while the reason stays the same.
  MonoTime next_notice() const noexcept;
  // The text to report now, and not again for that reason. `known`: the streams that exist.
  std::string take_notice(MonoTime now, const std::vector<StreamId>& known);

 private:
  StreamId id_;
  MonoTime began_, next_attempt_;
  Error last_error_;
  bool has_failed_ = false, was_missing_ = false, was_added_ = false;
  std::set<Errc> reported_;
};

}  // namespace dssm::detail
