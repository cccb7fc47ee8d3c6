// SPDX-License-Identifier: Apache-2.0
//
// What is behind the handles of the public API.
#pragma once

#include <atomic>
#include <dssm/reader.hpp>
#include <dssm/writer.hpp>
#include <mutex>
#include <optional>

#include "client/src/client.hpp"
#include "core/clock/error_cache.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"

namespace dssm::detail {

// How long a reader waits before it tries again to open the ring that superseded its own.
inline constexpr Duration kRestartPause = std::chrono::milliseconds(200);

// A time that is further from now than this is none of this PC's clock.
inline constexpr Duration kLongestDelay = std::chrono::seconds(10);

// How far this PC's clock may have been off at `time`, by the page at `place`; kForeignClockError
// for a time that is none of it.
inline Duration error_by(const Client::ClockPlace& place, Time time) noexcept {
  const clock::ClockPage* page = place.load(std::memory_order_acquire);
  const std::optional<Duration> error = page ? clock::error_at(*page, time) : std::nullopt;
  if (error) return *error;
  // Only now, because it costs more than all the rest.
  const Time now = WallClock::now();
  return time < now - kLongestDelay || time > now + kLongestDelay ? kForeignClockError
                                                                  : kUnknownClockError;
}

struct ReaderState {
  explicit ReaderState(std::shared_ptr<OpenStream> opened)
      : stream(std::move(opened)), ring(*stream->ring->mapping) {}

  // Whether there is another ring to go on with, as far as is known without asking.
  bool restart_due() const noexcept { return stream->superseded->load(std::memory_order_acquire); }
  // Goes on with the new ring. False: it cannot be had now, the old one stays.
  bool restart() noexcept;
  // The stream as it is now, for a thread that waits beside the one that reads.
  std::shared_ptr<OpenStream> stream_now() const;
  // Whether a wait on `on` shall end so that the reader can try to restart.
  bool restart_wakes(const OpenStream& on) const noexcept;

  // From now on next() goes on behind `tid`.
  void took(Tid tid) noexcept {
    cursor = tid;
    fresh = false;
  }

  // Changed by restart() only, in the thread that reads; stream_mutex lets another one wait.
  mutable std::mutex stream_mutex;
  std::shared_ptr<OpenStream> stream;
  std::shared_ptr<const SharedRing> previous;  // so that what was borrowed stays mapped
  ring::RingReader ring;
  Tid cursor = kNoTid;
  bool fresh = true;  // next() has not been told where to start
  std::uint64_t lost = 0;
  std::uint64_t restarts = 0;
  std::optional<Error> trouble;
  std::atomic<std::int64_t> next_attempt_ns = 0;  // monotonic: not before it restart() asks dssmd
  std::shared_ptr<ReadyFd> ready;
};

struct WriterState {
  explicit WriterState(std::shared_ptr<OpenStream> opened)
      : stream(std::move(opened)),
        clock(stream->client->clock_page()),
        ring(*stream->ring->mapping, *stream->ring->bell, stream->ring->doorbell_fd.get()),
        payload_bytes(stream->ring->mapping->geometry().payload_bytes) {}

  // What a sample is stamped with that a writer says this about.
  Duration stamp(Time time, Duration clock_error) noexcept {
    if (clock_error != kOwnClockError) return clock_error;
    Duration error{};
    const bool found = own_error.find(clock.load(std::memory_order_acquire), time, error);
    return found ? error : error_by(clock, time);
  }

  std::shared_ptr<OpenStream> stream;
  const Client::ClockPlace& clock;
  clock::ErrorCache own_error;
  ring::RingWriter ring;
  std::uint64_t payload_bytes;
};

struct PlaybackClockState {
  std::shared_ptr<clock::PlaybackRecord> record;
};

Result<std::vector<std::byte>> get_property(Client& client, const StreamId& id);
Result<void> set_property(Client& client, const StreamId& id, std::span<const std::byte> property);

}  // namespace dssm::detail
