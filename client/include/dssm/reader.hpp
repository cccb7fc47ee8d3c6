// SPDX-License-Identifier: Apache-2.0
//
// Reading a stream. RawReader works on bytes; Reader<T> on a trivially copyable T.
//
// A reader has a cursor: the tid of the last sample it returned. read_next() and read_previous() move
// relative to it, wait() waits for something newer than it. Every read that returns `ok` sets it;
// a read that returns anything else leaves cursor and arguments untouched.
//
//   threads  one reader object belongs to one thread at a time; any number of readers may read one
//            stream, in any processes, beside its writers
//   cost     reading takes no lock and makes no system call; see docs/ring-layout.md
//   life     a reader keeps its ring mapped, and stays usable after its Session object is gone and
//            while dssmd is away
//   moved    a moved-from reader may only be assigned to or destroyed
//   anew     when the stream is removed and created anew, or its owner came back without its rings,
//            the reader goes on with the new ring by itself: one read returns `restarted`, once
//            (read_next() only after it has returned all that the old ring held), the cursor is kNoTid
//            then, and tids begin anew. Until the new ring can be had the old one is read.
#pragma once

#include <cstddef>
#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <optional>
#include <span>
#include <vector>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

namespace detail {
struct ReaderState;
}

// A sample looked at in place, without a copy. The bytes are the ring's own: a writer that laps
// the ring overwrites them under the reader's eyes, so use them, then ask still_valid(), and only
// then believe what was computed. Valid no longer than the reader it came from.
class BorrowedSample {
 public:
  // The payload; aligned to 64 bytes, and the 64 bytes behind it can be read as well. May change
  // while it is looked at: treat as untrusted until still_valid() says true.
  std::span<const std::byte> payload() const noexcept { return payload_; }
  const SampleInfo& info() const noexcept { return info_; }

  // Whether nothing was overwritten since borrow(): true means all that was read was the sample.
  bool still_valid() const noexcept;

 private:
  friend class RawReader;
  std::span<const std::byte> payload_;
  SampleInfo info_;
  const void* sequence_ = nullptr;
};

// The two samples around a time, for interpolation.
struct Neighbours {
  SampleInfo before;  // newest sample with time <= t
  SampleInfo after;   // the sample written right after `before`; its time is > t
};

class RawReader;
struct JointSample;
struct JointRead;

class RawReader {
 public:
  RawReader(RawReader&&) noexcept;
  RawReader& operator=(RawReader&&) noexcept;
  ~RawReader();

  // --- reading by tid

  // Copies the newest sample. `payload` is exactly payload_bytes() long in all calls below.
  //   returns  ok | not_yet (nothing written) | lapped
  ReadStatus read_newest(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies sample number `tid`.
  //   returns  ok | not_yet (tid > newest_tid()) | too_old (tid < oldest_tid(), or negative)
  ReadStatus read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the sample after the cursor. The first call on a fresh reader returns the newest sample,
  // as SSM does; call seek() before to start elsewhere. A reader that was lapped goes on with the
  // oldest sample there is, and the tids in between are added to lost_samples().
  //   returns  ok | not_yet | lapped
  ReadStatus read_next(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the sample before the cursor.
  //   returns  ok | not_yet (nothing was read before) | too_old
  ReadStatus read_previous(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // --- reading by time
  // All of these, find() too, return clock_out_of_bounds for a sample of another host that may be
  // further from this PC's clock than is allowed (keys clock_policy and clock_limit of dssmd).
  // Reading by tid is never refused: clock_in_bounds() tells such samples.
  // Exact for every sequence of times, also one that runs backwards (docs/ring-layout.md "Search by
  // time"). "The newest sample" is the one with the greatest tid.
  //   cost     O(1) on a regular stream, else O(log depth)

  // Copies the newest sample with time <= `t`; the newest sample of all for any `t` after it.
  //   returns  ok | not_yet (nothing written) | too_old (all samples held lie after `t`) | lapped
  ReadStatus read_at(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the first sample from which on all samples have time >= `t`: the first one with
  // time >= t on a stream whose times do not run backwards.
  //   returns  ok | not_yet (no such sample yet, or nothing written) | lapped
  ReadStatus read_at_or_after(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the one of the two neighbours of `t` that is closer in time; the earlier one of two
  // equally close ones; the only one where there is only one.
  //   returns  ok | not_yet (nothing written) | lapped
  ReadStatus read_nearest(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // The stamps of the two neighbours of `t`; read their payloads with read_tid(). Leaves the cursor.
  //   returns  ok | not_yet (no sample after `t` yet, or nothing written) | too_old | lapped
  ReadStatus find_neighbours(Time t, Neighbours& out) const noexcept;

  // How far info.time may be from this PC's clock: its clock_error and what is known of both clocks
  // at this moment. 0 for a stream of this PC, or of another host with the same kernel, which has
  // the same clock; kUnknownClockError: unknown. `info` is of this reader's stream.
  Duration clock_error(const SampleInfo& info) const noexcept;
  // Whether that is allowed; always, where the stream's policy is `off`.
  bool clock_in_bounds(const SampleInfo& info) const noexcept;

  // --- stamps and places without payloads

  // Tid of the newest sample, kNoTid while nothing is written; of the oldest readable one.
  Tid newest_tid() const noexcept;
  Tid oldest_tid() const noexcept;

  // Stamps of sample `tid`, without copying its payload. Leaves the cursor.
  //   returns  ok | not_yet | too_old
  ReadStatus read_info(Tid tid, SampleInfo& info) const noexcept;

  // What read_at() would return, without its payload. Leaves the cursor.
  ReadStatus find(Time t, SampleInfo& info) const noexcept;

  // The cursor: tid of the last sample read, kNoTid on a fresh reader.
  Tid cursor() const noexcept;

  // Puts the cursor on `tid`, so that read_next() returns tid + 1; kNoTid: read_next() starts at tid 0 or
  // the oldest held. Any value is allowed.
  void seek(Tid tid) noexcept;

  // Samples that read_next() had to skip because the ring no longer held them: the writer was faster, or
  // the link to the stream's host was down for longer than its ring reaches back.
  std::uint64_t lost_samples() const noexcept;

  // How often this reader went on with a new ring.
  std::uint64_t restarts() const noexcept;

  // Why this reader cannot go on with the stream's new ring (it has another type); nothing while
  // all is well.
  std::optional<Error> restart_error() const;

  // --- in place

  // Looks at sample `tid` in place.
  //   returns  as read_tid(); sets the cursor
  ReadStatus borrow(Tid tid, BorrowedSample& out) noexcept;

  // --- waiting

  // Waits until there is a sample newer than the cursor, or the stream began anew, or the monotonic
  // clock reaches `deadline` (kNever: no limit; a deadline in the past: just look).
  WaitStatus wait(MonoTime deadline) noexcept;

  // The same for newest_tid() >= `tid`. May run in one thread while another one uses this reader.
  WaitStatus wait_for_tid(Tid tid, MonoTime deadline) noexcept;

  // A descriptor for poll(), epoll or an event library: readable when there may be samples newer
  // than at the last clear_ready(). On wake-up: clear_ready(), then read_next() until not_yet. The
  // first call starts one thread per session that waits on behalf of all such descriptors.
  // Owned by the reader; do not read or close it.
  Result<int> ready_fd() noexcept;
  void clear_ready() noexcept;

  // --- about the stream

  // References stay good until a read returns `restarted`.
  const StreamId& id() const noexcept;    // with its owner's host
  const TypeInfo& type() const noexcept;  // as stored with the stream
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;
  Duration cycle() const noexcept;
  std::uint64_t incarnation() const noexcept;

  // The stream's property; not_found when none is set. Asks dssmd.
  Result<std::vector<std::byte>> property() const;

 private:
  friend class Session;
  friend JointRead read_joint_at(Time t, std::span<JointSample> samples,
                                 Duration max_error) noexcept;
  friend WaitStatus wait_any(std::span<RawReader* const> readers, MonoTime deadline) noexcept;
  explicit RawReader(std::unique_ptr<detail::ReaderState> state) noexcept;
  std::unique_ptr<detail::ReaderState> state_;
};

// One of several samples that are read together.
struct JointSample {
  RawReader* reader = nullptr;
  std::span<std::byte> payload;  // exactly reader->payload_bytes() long
  SampleInfo info{};
};

struct JointRead {
  ReadStatus status = ReadStatus::ok;
  std::size_t index = 0;  // of the samples: why it is not ok; if it is, the one that is worst known
  Duration clock_error =
      kUnknownClockError;  // >= 0: how far the time of any of them may be from this
                           // PC's clock; also when that is the reason
};

// What at(t) gives of several streams: all of them or none.
//   max_error  >= 0: no sample's time may be further from this PC's clock
//   returns    as read_at(); clock_out_of_bounds also when max_error is not kept. Unless ok,
//              payloads and infos are unspecified, and the cursors are where they were
JointRead read_joint_at(Time t, std::span<JointSample> samples,
                        Duration max_error = kUnknownClockError) noexcept;

// Waits until one of `readers` has a sample newer than its cursor, or until `deadline`. At most
// kMaxWaitAny readers; all must be valid. Returns `ready` also at once when one has already.
inline constexpr std::size_t kMaxWaitAny = 128;  // FUTEX_WAITV_MAX of Linux
WaitStatus wait_any(std::span<RawReader* const> readers, MonoTime deadline) noexcept;

// The same with a T in place of bytes. Everything not listed here is as in RawReader.
template <Payload T>
class Reader : public RawReader {
 public:
  explicit Reader(RawReader raw) noexcept : RawReader(std::move(raw)) {}

  ReadStatus read_newest(T& out, SampleInfo& info) noexcept {
    return RawReader::read_newest(bytes(out), info);
  }
  ReadStatus read_tid(Tid n, T& out, SampleInfo& info) noexcept {
    return RawReader::read_tid(n, bytes(out), info);
  }
  ReadStatus read_next(T& out, SampleInfo& info) noexcept {
    return RawReader::read_next(bytes(out), info);
  }
  ReadStatus read_previous(T& out, SampleInfo& info) noexcept {
    return RawReader::read_previous(bytes(out), info);
  }
  ReadStatus read_at(Time t, T& out, SampleInfo& info) noexcept {
    return RawReader::read_at(t, bytes(out), info);
  }
  ReadStatus read_at_or_after(Time t, T& out, SampleInfo& info) noexcept {
    return RawReader::read_at_or_after(t, bytes(out), info);
  }
  ReadStatus read_nearest(Time t, T& out, SampleInfo& info) noexcept {
    return RawReader::read_nearest(t, bytes(out), info);
  }

  // For read_at() of several streams: this one's sample, to be put into `out`.
  JointSample joint_sample(T& out) noexcept { return {this, bytes(out), {}}; }

  // The borrowed payload as a T. Check still_valid() after the last use of what was read.
  static const T& view(const BorrowedSample& sample) noexcept {
    return *reinterpret_cast<const T*>(sample.payload().data());
  }

 private:
  static std::span<std::byte> bytes(T& out) noexcept {
    return std::as_writable_bytes(std::span<T, 1>(&out, 1));
  }
};

}  // namespace dssm
#pragma GCC visibility pop
