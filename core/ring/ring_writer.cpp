// SPDX-License-Identifier: Apache-2.0
#include "core/ring/ring_writer.hpp"

#include <unistd.h>

#include <algorithm>
#include <array>

#include "core/ring/robust_lock.hpp"

namespace dssm::ring {
namespace {

// The rings whose slots this thread has on loan: taking such a lock again would wait for ever.
struct HeldRings {
  std::array<const RingHeader*, 8> rings{};
  std::size_t count = 0;

  bool holds(const RingHeader* ring) const noexcept {
    return std::find(rings.begin(), rings.begin() + count, ring) != rings.begin() + count;
  }
  void add(const RingHeader* ring) noexcept { rings[count++] = ring; }
  void remove(const RingHeader* ring) noexcept {
    std::remove(rings.begin(), rings.begin() + count, ring);
    --count;
  }
};
// Initial-exec: one load instead of a call, on the path of every write. It takes 72 bytes of the
// room that the C library keeps for libraries that are loaded late.
[[gnu::tls_model("initial-exec")]] thread_local constinit HeldRings held_rings;

}  // namespace

RingWriter::RingWriter(const RingMapping& mapping, Bell& bell, int doorbell) noexcept
    : publisher_(mapping), bell_(&bell), doorbell_(doorbell) {}

[[gnu::hot]] bool RingWriter::lock() noexcept {
  RingHeader& header = publisher_.header();
  if (held_rings.count != 0 && held_rings.holds(&header)) return false;
  return take(lock_robust(header.lock));
}

[[gnu::hot]] bool RingWriter::take(LockResult result) noexcept {
  if (result == LockResult::recovered) publisher_.recover();
  return result == LockResult::locked || result == LockResult::recovered;
}

[[gnu::hot]] void RingWriter::unlock() noexcept { pthread_mutex_unlock(&publisher_.header().lock); }

std::byte* RingWriter::begin() noexcept {
  if (held_rings.count == held_rings.rings.size() || !lock()) return nullptr;
  held_rings.add(&publisher_.header());
  return publisher_.begin(newest() + 1);
}

void RingWriter::cancel() noexcept {
  // The slot keeps its odd sequence: it was outside the readable window already.
  held_rings.remove(&publisher_.header());
  unlock();
}

Tid RingWriter::commit(Time time, Duration clock_error) noexcept {
  // No fence: glibc's memcpy ends its non-temporal stores with one, and who uses such stores
  // directly has to, as before any other publication.
  const Tid tid = newest() + 1;
  publisher_.publish(tid, time, clock_error);
  held_rings.remove(&publisher_.header());
  unlock();
  follow_up(tid);
  return tid;
}

[[gnu::hot]] Tid RingWriter::write(std::span<const std::byte> payload, Time time,
                                   Duration clock_error) noexcept {
  if (!lock()) return kNoTid;
  return write_locked(payload, time, clock_error);
}

RingWriter::Attempt RingWriter::try_publish(const PublishedSample& sample,
                                            std::span<const std::byte> payload, Time time,
                                            Duration clock_error) noexcept {
  RingHeader& header = publisher_.header();
  const LockResult result = try_lock_robust(header.lock);
  if (result == LockResult::busy) return {Attempt::Outcome::busy, kNoTid};
  if (!take(result)) return {Attempt::Outcome::refused, kNoTid};
  PublisherCursors(header).note(sample, newest() + 1);
  return {Attempt::Outcome::written, write_locked(payload, time, clock_error)};
}

[[gnu::hot]] Tid RingWriter::write_locked(std::span<const std::byte> payload, Time time,
                                          Duration clock_error) noexcept {
  bell_->expect_ring();
  const Tid tid = newest() + 1;
  publisher_.begin(tid);
  publisher_.fill(tid, payload);
  publisher_.publish(tid, time, clock_error);
  unlock();
  follow_up(tid);
  return tid;
}

// What follows a sample, outside of the lock: waking who sleeps, and getting ready for the next
// one.
[[gnu::hot]] void RingWriter::follow_up(Tid tid) noexcept {
  bell_->ring();
  if (doorbell_ >= 0 && bell_->doorbell_armed()) {
    const std::uint64_t one = 1;
    // Non-blocking: a counter that is full has been rung enough.
    [[maybe_unused]] const ssize_t written = ::write(doorbell_, &one, sizeof one);
  }
  publisher_.expect_next(tid);
}

}  // namespace dssm::ring
