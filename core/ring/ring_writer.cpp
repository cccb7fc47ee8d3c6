// SPDX-License-Identifier: Apache-2.0
#include "core/ring/ring_writer.hpp"

#include <unistd.h>

#include <algorithm>
#include <array>

namespace dssm::ring {
namespace {

// The rings of which this thread has a slot on loan, and so the lock: to take it again would block
// for ever.
struct LoanedRings {
  std::array<const RingHeader*, 8> rings{};
  std::size_t count = 0;

  bool holds(const RingHeader* ring) const noexcept {
    return std::find(rings.begin(), rings.begin() + count, ring) != rings.begin() + count;
  }
  void add(const RingHeader* ring) noexcept { rings[count++] = ring; }
  void remove(const RingHeader* ring) noexcept {
    const auto end = std::remove(rings.begin(), rings.begin() + count, ring);
    count = static_cast<std::size_t>(end - rings.begin());
  }
};
// Initial-exec: one load instead of a call, on the path of every write. It takes 72 bytes of the
// static TLS space that the C library reserves for libraries loaded by dlopen().
[[gnu::tls_model("initial-exec")]] thread_local constinit LoanedRings loaned_rings;

}  // namespace

RingWriter::RingWriter(const RingMapping& mapping, Bell& bell, int doorbell) noexcept
    : slots_(mapping), lock_(&mapping.writer_lock()), bell_(&bell), doorbell_(doorbell) {}

[[gnu::hot]] bool RingWriter::lock() noexcept {
  if (loaned_rings.count != 0 && loaned_rings.holds(&slots_.header())) return false;
  return take(lock_->lock());
}

[[gnu::hot]] bool RingWriter::take(LockResult result) noexcept {
  if (result == LockResult::recovered) slots_.recover();
  return result != LockResult::busy;
}

std::byte* RingWriter::begin() noexcept {
  if (loaned_rings.count == loaned_rings.rings.size() || !lock()) return nullptr;
  loaned_rings.add(&slots_.header());
  return slots_.begin(newest() + 1);
}

void RingWriter::cancel() noexcept {
  // The slot keeps its odd sequence: it is outside the readable window.
  loaned_rings.remove(&slots_.header());
  lock_->unlock();
}

Tid RingWriter::commit(std::size_t payload_bytes, Time time, Duration clock_error) noexcept {
  // No fence: glibc's memcpy ends its non-temporal stores with one, and a program that uses such
  // stores directly must end them with one, as before any other release.
  const Tid tid = newest() + 1;
  slots_.publish_before_unlock({tid, time, clock_error, payload_bytes});
  loaned_rings.remove(&slots_.header());
  lock_->unlock();
  follow_up(tid);
  return tid;
}

[[gnu::hot]] Tid RingWriter::write(std::span<const std::byte> payload, Time time,
                                   Duration clock_error) noexcept {
  if (!lock()) return kNoTid;
  return write_locked(payload, time, clock_error);
}

Tid RingWriter::try_publish(const PublishedSample& sample, std::span<const std::byte> payload,
                            Time time, Duration clock_error) noexcept {
  if (!take(lock_->try_lock())) return kNoTid;
  PublisherCursors(slots_.header()).advance(sample, newest() + 1);
  return write_locked(payload, time, clock_error);
}

[[gnu::hot]] Tid RingWriter::write_locked(std::span<const std::byte> payload, Time time,
                                          Duration clock_error) noexcept {
  bell_->prefetch();
  const Tid tid = newest() + 1;
  slots_.begin(tid);
  slots_.fill(tid, payload);
  slots_.publish_before_unlock({tid, time, clock_error, payload.size()});
  lock_->unlock();
  follow_up(tid);
  return tid;
}

// After a sample, outside of the lock: wakes sleepers and prepares for the next sample.
[[gnu::hot]] void RingWriter::follow_up(Tid tid) noexcept {
  bell_->notify();
  if (doorbell_ >= 0 && slots_.header().doorbell_armed.load(std::memory_order_seq_cst) != 0) {
    const std::uint64_t one = 1;
    // Never waits: nobody else has the descriptor but dssmd, and the counter does not get full.
    [[maybe_unused]] const ssize_t written = ::write(doorbell_, &one, sizeof one);
  }
  slots_.prefetch_next(tid);
}

}  // namespace dssm::ring
