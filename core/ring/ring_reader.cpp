// SPDX-License-Identifier: Apache-2.0
#include "core/ring/ring_reader.hpp"

#include <algorithm>

#include "core/ring/copy.hpp"
#include "core/ring/time_search.hpp"

namespace dssm::ring {
namespace {

// The stamps of a slot. Acquire, so that the sequence is loaded again after all of them.
//   room_bytes  for the payload: a hostile writer may state any length, and change it
SampleInfo load_info(const SlotHeader& slot, Tid tid, std::uint64_t room_bytes) noexcept {
  SampleInfo info;
  info.tid = tid;
  info.payload_bytes = std::min(slot.payload_bytes.load(std::memory_order_acquire), room_bytes);
  info.time = time_from_ns(slot.time_ns.load(std::memory_order_acquire));
  info.clock_error = Duration(slot.clock_error_ns.load(std::memory_order_acquire));
  return info;
}

}  // namespace

// Of a sample in the window that its slot does not hold: it was overwritten meanwhile, or is to
// come, or lost.
[[gnu::cold]] ReadStatus RingReader::status_of_absent(Tid tid) const noexcept {
  // The hole first: when it closes, what was in it is here.
  const bool was_awaited = hole().holds(tid);
  const std::uint64_t sequence = slots_.slot(tid).sequence.load(std::memory_order_acquire);
  if (tid < oldest()) return ReadStatus::too_old;
  if (sequence == lost_sequence(tid)) return ReadStatus::lost;
  // It may have come meanwhile: then the next attempt finds it.
  const bool is_here = sequence == published_sequence(tid);
  return is_here || was_awaited ? ReadStatus::arriving : ReadStatus::too_old;
}

bool RingReader::is_settled(Tid tid) const noexcept {
  if (tid > newest()) return false;
  if (!hole().holds(tid) || tid < oldest()) return true;
  const std::uint64_t sequence = slots_.slot(tid).sequence.load(std::memory_order_acquire);
  return sequence == published_sequence(tid) || sequence == lost_sequence(tid);
}

Tid RingReader::skip_lost(Tid tid) const noexcept {
  const Tid top = newest();
  const auto is_lost = [&] {
    return slots_.slot(tid).sequence.load(std::memory_order_relaxed) == lost_sequence(tid);
  };
  while (tid >= 0 && tid < top && is_lost()) ++tid;
  return tid;
}

ReadStatus RingReader::locate(Tid tid, Place& place, SampleInfo& info) const noexcept {
  const Tid top = newest();
  if (tid > top) return ReadStatus::not_yet;
  if (tid < 0 || tid < slots_.oldest_for(top)) return ReadStatus::too_old;
  SlotHeader& slot = slots_.slot(tid);
  // Pairs with the release store of the even sequence in SlotWriter::finish(): what was stored
  // before it is visible after this.
  if (slot.sequence.load(std::memory_order_acquire) != published_sequence(tid)) {
    return status_of_absent(tid);
  }
  const SampleInfo seen = load_info(slot, tid, slots_.payload_bytes());
  if (slot.sequence.load(std::memory_order_relaxed) != published_sequence(tid)) {
    return status_of_absent(tid);
  }
  place = {SlotTable::payload(slot), &slot.sequence, published_sequence(tid)};
  info = seen;
  return ReadStatus::ok;
}

bool RingReader::still_valid(const std::atomic<std::uint64_t>& sequence,
                             std::uint64_t expected) noexcept {
  fence_after_copying_out();
  return sequence.load(std::memory_order_relaxed) == expected;
}

[[gnu::hot]] ReadStatus RingReader::read(Tid tid, std::span<std::byte> payload,
                                         SampleInfo& info) const noexcept {
  const Tid top = newest();
  if (tid > top) return ReadStatus::not_yet;
  if (tid < 0 || tid < slots_.oldest_for(top)) return ReadStatus::too_old;
  SlotHeader& slot = slots_.slot(tid);
  const std::uint64_t published = published_sequence(tid);
  if (slot.sequence.load(std::memory_order_acquire) != published) return status_of_absent(tid);
  const SampleInfo seen = load_info(slot, tid, payload.size());
  // A small one in full, so that the copy need not wait until its length is loaded.
  const std::size_t bytes = payload.size() < kLargeBytes ? payload.size() : seen.payload_bytes;
  copy_out(payload.data(), SlotTable::payload(slot), bytes);
  fence_after_copying_out();
  if (slot.sequence.load(std::memory_order_relaxed) != published) return status_of_absent(tid);
  info = seen;
  return ReadStatus::ok;
}

[[gnu::flatten, gnu::hot]] ReadStatus RingReader::read_newest(std::span<std::byte> payload,
                                                              SampleInfo& info) const noexcept {
  for (int attempt = 0; attempt < kMaxRetries; ++attempt) {
    const Tid top = newest();
    if (top < 0) return ReadStatus::not_yet;
    if (read(top, payload, info) == ReadStatus::ok) return ReadStatus::ok;
  }
  return ReadStatus::lapped;
}

ReadStatus RingReader::stamp(Tid tid, SampleInfo& info) const noexcept {
  Place place;
  return locate(tid, place, info);
}

[[gnu::flatten]] ReadStatus RingReader::find(Time t, Tid& tid, int attempts) const noexcept {
  for (int attempt = 0; attempt < attempts; ++attempt) {
    const Tid top = newest();
    if (top < 0) return ReadStatus::not_yet;
    // That of `top` was stored before `top`, and later ones are greater, or belong to the same run
    // (in mirrors): a value up to `top` belongs to its run. A greater one means that a writer is
    // beginning a new run, or died while doing so; then the slot has the right value.
    Tid run_start = header_->run_start.load(std::memory_order_acquire);
    if (run_start > top || run_start < 0) {
      SlotHeader& slot = slots_.slot(top);
      run_start = slot.run_start.load(std::memory_order_acquire);
      if (run_start > top || run_start < 0 ||
          slot.sequence.load(std::memory_order_relaxed) != published_sequence(top)) {
        continue;
      }
    }
    const TidRange hole = hole_of(*header_);
    const Tid oldest = slots_.oldest_for(top);
    const bool is_partial = !hole.is_empty() && hole.end > oldest;
    // A hole that ends after `top` is being opened, or its writer died while opening it.
    const Tid first = is_partial ? std::min(hole.end, top) : oldest;
    FoundSample found = find_newest_at_or_before(slots_, first, top, run_start, to_ns(t));
    if (is_partial && found.status == ReadStatus::too_old) found.status = ReadStatus::arriving;
    // The loaded times belong to the expected tids if none of these has left the window since: a
    // writer reuses an entry of the index only after it published a `top` that moved the entry's
    // sample out of the window.
    fence_after_probing();
    const Tid now = header_->top.load(std::memory_order_relaxed);
    if (found.status == ReadStatus::lapped || found.lowest_probed < slots_.oldest_for(now))
      continue;
    if (found.status == ReadStatus::ok) tid = found.tid;
    return found.status;
  }
  return ReadStatus::lapped;
}

}  // namespace dssm::ring
