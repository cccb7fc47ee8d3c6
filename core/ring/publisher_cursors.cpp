// SPDX-License-Identifier: Apache-2.0
//
// A process that is killed has executed everything before some instruction and nothing after it, so
// the order in the program decides. The stores are releases so that the compiler keeps that order,
// and so that a reader without the lock sees it while another process restores a cursor.
#include "core/ring/publisher_cursors.hpp"

#include <algorithm>
#include <iterator>

namespace dssm::ring {
namespace {

bool is_of(const PublisherCursor& cursor, std::uint64_t publisher) noexcept {
  return cursor.publisher.load(std::memory_order_acquire) == publisher &&
         cursor.tid_end.load(std::memory_order_acquire) != 0;
}

}  // namespace

// Behind the newest sample's tid.
std::uint64_t PublisherCursors::end() const noexcept {
  const Tid top = header_->top.load(std::memory_order_acquire);
  return top < 0 ? 0 : static_cast<std::uint64_t>(top) + 1;
}

[[gnu::hot]] PublisherCursors::Last PublisherCursors::last_untrusted(
    std::uint64_t publisher) const noexcept {
  const PublisherCursor* const found =
      std::find_if(std::begin(header_->publishers), std::end(header_->publishers),
                   [publisher](const PublisherCursor& cursor) { return is_of(cursor, publisher); });
  if (found == std::end(header_->publishers)) return {};
  // The end first: meanwhile a program may restore the cursor and write a sample of its own under
  // that tid.
  const std::uint64_t end = this->end();
  std::uint64_t tid_end = found->tid_end.load(std::memory_order_acquire);
  std::uint64_t number_end = found->number_end.load(std::memory_order_acquire);
  if (tid_end > end) {
    tid_end = found->earlier_tid_end.load(std::memory_order_acquire);
    number_end = found->earlier_number_end.load(std::memory_order_acquire);
  }
  const Last last{static_cast<std::int64_t>(number_end - 1), static_cast<Tid>(tid_end - 1)};
  return tid_end == 0 || tid_end > end || last.number < 0 ? Last{} : last;
}

// The cursor of `publisher`, or one that is made its own.
[[gnu::hot]] PublisherCursor& PublisherCursors::cursor_of(std::uint64_t publisher) const noexcept {
  PublisherCursor* oldest = std::begin(header_->publishers);
  for (PublisherCursor& cursor : header_->publishers) {
    if (is_of(cursor, publisher)) return cursor;
    if (cursor.tid_end.load(std::memory_order_acquire) <
        oldest->tid_end.load(std::memory_order_acquire)) {
      oldest = &cursor;
    }
  }
  // From here on the cursor is free, until it has a tid again.
  oldest->tid_end.store(0, std::memory_order_release);
  oldest->publisher.store(publisher, std::memory_order_release);
  return *oldest;
}

[[gnu::hot]] void PublisherCursors::advance(const PublishedSample& sample, Tid tid) const noexcept {
  PublisherCursor& cursor = cursor_of(sample.publisher);
  cursor.earlier_number_end.store(cursor.number_end.load(std::memory_order_relaxed),
                                  std::memory_order_release);
  cursor.earlier_tid_end.store(cursor.tid_end.load(std::memory_order_relaxed),
                               std::memory_order_release);
  // From here on the cursor points to a sample that is not published yet.
  cursor.tid_end.store(static_cast<std::uint64_t>(tid) + 1, std::memory_order_release);
  cursor.number_end.store(static_cast<std::uint64_t>(sample.number) + 1, std::memory_order_release);
}

void PublisherCursors::recover() const noexcept {
  const std::uint64_t end = this->end();
  for (PublisherCursor& cursor : header_->publishers) {
    if (cursor.tid_end.load(std::memory_order_acquire) <= end) continue;
    // The tid last: a process that is killed in between leaves the cursor to be restored again.
    cursor.number_end.store(cursor.earlier_number_end.load(std::memory_order_acquire),
                            std::memory_order_release);
    cursor.tid_end.store(cursor.earlier_tid_end.load(std::memory_order_acquire),
                         std::memory_order_release);
  }
}

}  // namespace dssm::ring
