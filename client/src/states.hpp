// SPDX-License-Identifier: Apache-2.0
//
// The state of the handles of the public API.
#pragma once

#include <atomic>
#include <dssm/reader.hpp>
#include <dssm/writer.hpp>
#include <mutex>
#include <optional>

#include "client/src/client.hpp"
#include "core/clock/clock_page.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"

namespace dssm::detail {

// How long a reader waits before it tries again to open the ring that superseded its own; longer
// when it may not read the stream.
inline constexpr Duration kRestartPause = std::chrono::milliseconds(200);
inline constexpr Duration kRefusedPause = std::chrono::seconds(1);

// A program that repeats a read of a sample that is still to come asks for it at most so often.
inline constexpr Duration kHistoryPause = std::chrono::milliseconds(50);

// A time that is further from now than this is not of this PC's clock.
inline constexpr Duration kMaxDelay = std::chrono::seconds(10);

// The bound on the error of this PC's clock at `time`, from the page at `place`; kForeignClockError
// for a time that is not of this clock.
inline Duration clock_error_by(const Client::ClockPlace& place, Time time) noexcept {
  const clock::ClockPage* page = place.load(std::memory_order_acquire);
  const std::optional<Duration> error = page ? clock::clock_error_at(*page, time) : std::nullopt;
  if (error) return *error;
  // Last, because clock_gettime() costs more than all the rest.
  const Time now = WallClock::now();
  return time < now - kMaxDelay || time > now + kMaxDelay ? kForeignClockError : kUnknownClockError;
}

struct ReaderState {
  explicit ReaderState(std::shared_ptr<OpenStream> opened)
      : stream(std::move(opened)), ring(*stream->ring->mapping) {}

  // Whether there is a new ring, as far as is known without a request.
  bool restart_due() const noexcept { return stream->superseded->load(std::memory_order_acquire); }
  // Opens the new ring. False: not possible now, the old one stays.
  bool restart() noexcept;
  // The present stream, for a thread that waits while another one reads.
  std::shared_ptr<OpenStream> stream_now() const;
  // Whether a wait on `on` must end so that the reader can try to restart.
  bool restart_wakes(const OpenStream& on) const noexcept;

  // What is read is still to come: dssmd shall fetch what is missing. To be repeated while that is
  // so: the connection to its host, and dssmd, may begin anew meanwhile.
  void want_history() noexcept;

  // read_next() continues after `tid`.
  void set_cursor(Tid tid) noexcept {
    cursor = tid;
    awaited = kNoTid;
    fresh = false;
  }
  // Whether there is something to read that was not there: after the cursor; or, after read_next()
  // found that the next one is still arriving, that one.
  bool has_news(const ring::RingReader& from) noexcept {
    if (awaited == kNoTid) return from.newest() > cursor;
    if (from.is_settled(awaited)) return true;
    want_history();
    return false;
  }

  // Changed only by restart(), in the thread that reads; stream_mutex is for one that waits.
  mutable std::mutex stream_mutex;
  std::shared_ptr<OpenStream> stream;
  std::shared_ptr<const SharedRing> previous;  // keeps borrowed samples mapped
  ring::RingReader ring;
  Tid cursor = kNoTid;
  Tid awaited = kNoTid;  // by read_next()
  bool fresh = true;     // neither read nor seek() has set the cursor
  std::uint64_t lost = 0;
  std::uint64_t restarts = 0;
  std::optional<Error> restart_error;
  std::atomic<std::int64_t> next_attempt_ns = 0;  // monotonic: restart() sends no request before
  std::atomic<std::int64_t> next_wish_ns = 0;     // monotonic: nor does want_history()
  std::shared_ptr<ReadyFd> ready;
};

struct WriterState {
  explicit WriterState(std::shared_ptr<OpenStream> opened)
      : stream(std::move(opened)),
        clock(stream->client->clock_page()),
        ring(*stream->ring->mapping, *stream->ring->bell, stream->ring->doorbell_fd.get()),
        payload_bytes(stream->ring->mapping->geometry().payload_bytes) {}

  // The clock_error to store for a sample that is written with these arguments.
  Duration clock_error_for(Time time, Duration clock_error) noexcept {
    if (clock_error != kOwnClockError) return clock_error;
    Duration error{};
    const bool found = own_error.find(clock.load(std::memory_order_acquire), time, error);
    return found ? error : clock_error_by(clock, time);
  }

  std::shared_ptr<OpenStream> stream;
  const Client::ClockPlace& clock;
  clock::ClockErrorCache own_error;
  ring::RingWriter ring;
  std::uint64_t payload_bytes;
};

struct PlaybackClockState {
  std::shared_ptr<clock::PlaybackRecord> record;
};

Result<std::vector<std::byte>> get_property(Client& client, const StreamId& id);
Result<void> set_property(Client& client, const StreamId& id, std::span<const std::byte> property);

}  // namespace dssm::detail
