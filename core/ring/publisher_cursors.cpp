// SPDX-License-Identifier: Apache-2.0
//
// A process that is killed has done all that is before some instruction and nothing behind it, so
// the order in the program is what counts. The stores are releases so that the compiler keeps it,
// and so that who reads without the lock while another process takes a note back sees it, too.
#include "core/ring/publisher_cursors.hpp"

#include <algorithm>
#include <iterator>

namespace dssm::ring {
namespace {

bool is_of(const PublisherCursor& note, std::uint64_t publisher) noexcept {
  return note.publisher.load(std::memory_order_acquire) == publisher &&
         note.tid_end.load(std::memory_order_acquire) != 0;
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
                   [publisher](const PublisherCursor& note) { return is_of(note, publisher); });
  if (found == std::end(header_->publishers)) return {};
  // The end first: a program may take the note back meanwhile and write a sample of its own under
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

// The note of `publisher`, or one that is made its own.
[[gnu::hot]] PublisherCursor& PublisherCursors::place_for(std::uint64_t publisher) const noexcept {
  PublisherCursor* oldest = std::begin(header_->publishers);
  for (PublisherCursor& note : header_->publishers) {
    if (is_of(note, publisher)) return note;
    if (note.tid_end.load(std::memory_order_acquire) <
        oldest->tid_end.load(std::memory_order_acquire)) {
      oldest = &note;
    }
  }
  // From here on it is nobody's, until there is a tid again.
  oldest->tid_end.store(0, std::memory_order_release);
  oldest->publisher.store(publisher, std::memory_order_release);
  return *oldest;
}

[[gnu::hot]] void PublisherCursors::note(const PublishedSample& sample, Tid tid) const noexcept {
  PublisherCursor& note = place_for(sample.publisher);
  note.earlier_number_end.store(note.number_end.load(std::memory_order_relaxed),
                                std::memory_order_release);
  note.earlier_tid_end.store(note.tid_end.load(std::memory_order_relaxed),
                             std::memory_order_release);
  // From here on it is the note of a sample that is not there yet.
  note.tid_end.store(static_cast<std::uint64_t>(tid) + 1, std::memory_order_release);
  note.number_end.store(static_cast<std::uint64_t>(sample.number) + 1, std::memory_order_release);
}

void PublisherCursors::recover() const noexcept {
  const std::uint64_t end = this->end();
  for (PublisherCursor& note : header_->publishers) {
    if (note.tid_end.load(std::memory_order_acquire) <= end) continue;
    // The tid last: whoever is killed in between leaves the note as it was.
    note.number_end.store(note.earlier_number_end.load(std::memory_order_acquire),
                          std::memory_order_release);
    note.tid_end.store(note.earlier_tid_end.load(std::memory_order_acquire),
                       std::memory_order_release);
  }
}

}  // namespace dssm::ring
