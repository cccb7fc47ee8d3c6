// SPDX-License-Identifier: Apache-2.0
//
// Reading a stream. RawReader works on bytes; Reader<T> on a trivially copyable T.
//
// A reader has a cursor: the tid of the last sample that it read by tid or in order. read_next()
// and read_previous() move relative to it, wait() waits for a sample after it. read_newest(),
// read_tid(), read_next(), read_previous() and borrow() set it when they return `ok`. Reads by time
// leave it, so that a program can read the past while it follows the stream; seek(info.tid) goes to
// what they returned. With a result other than `ok`, cursor and arguments keep their values.
//
//   threads   one reader belongs to one thread at a time; any number of readers, in any processes,
//             may read one stream beside its writers
//   cost      reading takes no lock and makes no system call (docs/ring-layout.md); a read that
//             returns `arriving` at most one, to have the sample fetched
//   lifetime  a reader keeps its ring mapped, and stays usable after its Session is destroyed and
//             while dssmd is unavailable
//   moved     a moved-from reader may only be assigned to or destroyed
//   restart   when the stream is removed and recreated, or its owner lost its rings, the reader
//             opens the new ring by itself. One read returns `restarted`, once (read_next() after
//             it has returned all samples of the old ring). Then the cursor is kNoTid, and tids
//             start at 0 again. Until the new ring can be opened, the old one is read
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <dssm/sample_or.hpp>
#include <dssm/stream.hpp>
#include <dssm/typed_reads.hpp>
#include <memory>
#include <optional>
#include <span>
#include <vector>

namespace dssm::detail {
struct ReaderState;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// A sample in its slot, read without a copy. A writer may overwrite the slot at any time: compute
// with the payload first, then call still_valid(), and use the result only when it returns true.
//
//   lifetime  usable while its reader exists and until that reader returns `restarted` twice
//   threads   one thread at a time
class BorrowedSample {
 public:
  // The payload, info().payload_bytes long and aligned to 64 bytes; the 64 bytes after it are
  // readable, too. It may change while it is read: untrusted until still_valid() returns true.
  std::span<const std::byte> payload() const noexcept { return payload_; }
  const SampleInfo& info() const noexcept { return info_; }

  // Whether the slot was not overwritten since borrow(): all bytes read so far are the sample's.
  bool still_valid() const noexcept;

 private:
  friend class RawReader;
  std::span<const std::byte> payload_;
  SampleInfo info_;
  const std::atomic<std::uint64_t>* sequence_ = nullptr;  // of the slot; null: nothing borrowed
};

// When what was written to another host's stream before it was opened, or while the connection was
// cut, is fetched. The newest samples come in any case.
enum class FetchHistory : std::uint8_t {
  when_read,  // with the first read of the past, or of the next sample in order, which is `arriving`
  at_once,  // and the open returns when it is here, or after 1 s; without it while the host is away
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

  // In all functions: `payload` is exactly payload_bytes() long, another length ends the program.
  // Its first info.payload_bytes are the sample; the rest, and all of it unless ok, is unspecified.
  // `restarted` is a further result of each that takes a payload or borrows.
  //
  // Of a stream of another host the newest samples come first. One that is still to come is
  // `arriving`: a further result of read_tid(), read_previous(), read_info(), borrow() and all
  // reads by time; read_next() returns not_yet until it is here or lost, read_newest() never waits
  // for it. One that the network could not carry is `lost`: a further result of read_tid(),
  // read_info() and borrow(); the others pass over it.

  // Copies the newest sample.
  //   returns  ok | not_yet (nothing written) | lapped
  ReadStatus read_newest(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies sample number `tid`.
  //   returns  ok | not_yet (tid > newest_tid()) | too_old (tid < oldest_tid(), or negative)
  ReadStatus read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the sample after the cursor. The first call on a new reader returns the newest sample,
  // as in SSM; seek() selects another start. When the ring no longer holds the next sample, the
  // oldest one it holds is returned, and the tids in between are added to lost_samples(), as are
  // those of samples that are lost.
  //   returns  ok | not_yet | lapped
  ReadStatus read_next(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the sample before the cursor.
  //   returns  ok | not_yet (nothing was read before) | too_old
  ReadStatus read_previous(std::span<std::byte> payload, SampleInfo& info) noexcept;

  // --- reading by time

  // None of these moves the cursor. All return clock_out_of_bounds for a sample of another host
  // whose time may be further from this PC's clock than dssmd's keys clock_policy and clock_limit
  // allow. Reads by tid never do: use clock_in_bounds() there.
  //
  // They are exact for every sequence of times, also one that runs backwards (docs/ring-layout.md
  // "Search by time"). "The newest sample" is the one with the greatest tid.
  //   cost     O(1) on a regular stream, else O(log depth)

  // Copies the newest sample with time <= `t` that is not lost; the newest sample of all for any
  // `t` after it, however old it is then, unless there is a `max_age`.
  //   max_age  >= 0: of the sample at `t`, which is t - info.time
  //   returns  ok | not_yet (nothing written) | too_old (all samples are later than `t`) | lapped |
  //            stale (the sample is older than `max_age`)
  ReadStatus read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                     Duration max_age = kAnyAge) noexcept;

  // Copies the first sample from which on all samples have time >= `t`: the first one with
  // time >= t on a stream whose times do not run backwards.
  //   returns  ok | not_yet (no such sample yet, or nothing written) | lapped
  ReadStatus read_at_or_after(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the one of the two neighbours of `t` that is closer in time; the earlier one of two
  // equally close ones; the only one where there is only one.
  //   returns  ok | not_yet (nothing written) | lapped
  ReadStatus read_nearest(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept;

  // Copies the two neighbours of `t`, for interpolation (dssm/interpolate.hpp).
  //   before, after  as `payload`
  //   returns        ok | not_yet (no sample after `t` yet, or nothing written) | too_old | lapped
  ReadStatus read_neighbours(Time t, std::span<std::byte> before, std::span<std::byte> after,
                             Neighbours& infos) noexcept;

  // The infos of the two neighbours of `t`, without their payloads.
  //   returns  as read_neighbours()
  ReadStatus find_neighbours(Time t, Neighbours& out) const noexcept;

  // The bound [ns, >= 0] on the distance of info.time from this PC's clock: info.clock_error plus
  // the present bounds of both clocks. 0 for a stream of this PC or of a host on the same kernel,
  // which has the same clock; kUnknownClockError: unknown. `info` comes from this reader.
  Duration clock_error(const SampleInfo& info) const noexcept;
  // Whether reads by time accept the sample: that bound is within the limit, or the policy is
  // `off`.
  bool clock_in_bounds(const SampleInfo& info) const noexcept;

  // --- tids and infos without payloads

  // The tids of the newest and of the oldest readable sample; kNoTid while nothing is written.
  Tid newest_tid() const noexcept;
  Tid oldest_tid() const noexcept;

  // The info of sample `tid`, without its payload. Keeps the cursor.
  //   returns  ok | not_yet | too_old
  ReadStatus read_info(Tid tid, SampleInfo& info) const noexcept;

  // The info of the sample that read_at() without `max_age` would copy. Keeps the cursor.
  //   returns  as read_at()
  ReadStatus find(Time t, SampleInfo& info) const noexcept;

  // The cursor: the tid of the last sample read by tid or in order; kNoTid on a new reader.
  Tid cursor() const noexcept;

  // Sets the cursor to `tid`, so that read_next() returns tid + 1; kNoTid: read_next() starts at
  // tid 0 or the oldest sample. Any value is allowed.
  void seek(Tid tid) noexcept;

  // Samples that read_next() skipped because the ring no longer held them: the writer was faster,
  // the connection to the stream's host was down for longer than the host's ring keeps samples, or
  // it carries less than is written.
  std::uint64_t lost_samples() const noexcept;

  // How often the stream restarted while this reader read it.
  std::uint64_t restarts() const noexcept;

  // Why this reader cannot continue: the stream's new ring has another type, or this process may
  // not read the stream any more (no_permission; it may still get samples of the ring that it has
  // open, and continues when it may again). Empty otherwise.
  std::optional<Error> restart_error() const;

  // --- in place

  // Finds sample `tid` in its slot, without a copy.
  //   returns  as read_tid()
  ReadStatus borrow(Tid tid, BorrowedSample& out) noexcept;

  // --- waiting

  // Each of these waits until `deadline` of the monotonic clock (kNever: no limit; one in the past:
  // only checks), which may be a std::chrono::steady_clock::time_point, or for `timeout`.

  // Waits until there is a sample after the cursor, or the stream has restarted. After read_next()
  // returned not_yet: until it has something else to return. A program that only reads by time,
  // which does not move the cursor, waits for newest_tid() + 1 instead.
  WaitStatus wait(MonoTime deadline) noexcept;
  WaitStatus wait(Duration timeout) noexcept { return wait(deadline_in(timeout)); }

  // The same for newest_tid() >= `tid`. One thread may call it while another one reads.
  WaitStatus wait_for_tid(Tid tid, MonoTime deadline) noexcept;
  WaitStatus wait_for_tid(Tid tid, Duration timeout) noexcept {
    return wait_for_tid(tid, deadline_in(timeout));
  }
  // The same until sample `tid` is here or never will be: of a stream of another host it may be
  // `arriving` when newer ones are here.
  WaitStatus wait_for_sample(Tid tid, MonoTime deadline) noexcept;
  WaitStatus wait_for_sample(Tid tid, Duration timeout) noexcept {
    return wait_for_sample(tid, deadline_in(timeout));
  }

  // A descriptor for poll(), epoll or an event library: readable when there may be samples newer
  // than at the last clear_ready(). On wake-up call clear_ready(), then read_next() until it
  // returns not_yet. The reader owns it: do not read or close it. One thread per session and 127
  // readers, started by the first call, waits for all such descriptors.
  //   fails    system, no_memory (no descriptor or thread left)
  Result<int> ready_fd() noexcept;
  void clear_ready() noexcept;

  // --- about the stream

  // References stay valid until a read returns `restarted`.
  const StreamId& id() const noexcept;    // with its owner's host
  const TypeInfo& type() const noexcept;  // as stored with the stream
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;
  Duration cycle() const noexcept;
  std::uint64_t incarnation() const noexcept;

  // The stream's property: one request to dssmd.
  //   fails    as Session::property()
  Result<std::vector<std::byte>> property() const;

 private:
  friend class Session;
  friend JointRead read_joint_at(Time t, std::span<JointSample> samples, Duration max_error,
                                 Duration max_age) noexcept;
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
  std::size_t index =
      0;  // ok: the sample with the greatest bound; else the one that caused `status`
  Duration clock_error =
      kUnknownClockError;  // >= 0: how far the time of any of them may be from this
                           // PC's clock; also when that is the reason
};

// Copies from each stream the sample that read_at(t) copies: from all of them or from none.
//   max_error  >= 0: greatest bound accepted on the distance of a sample's time from this PC's
//              clock
//   max_age    as in read_at(), of each sample
//   returns    as read_at(), restarted included; clock_out_of_bounds also when a bound exceeds
//              max_error. Unless ok, payloads and infos are unspecified. Cursors keep their values.
//              What follows a sample that is shorter than its stream's is 0
//   threads    each reader belongs to the calling thread
//   cost       as one read_at() per stream
JointRead read_joint_at(Time t, std::span<JointSample> samples,
                        Duration max_error = kUnknownClockError,
                        Duration max_age = kAnyAge) noexcept;

// Waits until wait() of one of `readers` would return `ready`, until `deadline` or for `timeout`. 1
// to kMaxWaitAny readers, all of the calling thread.
inline constexpr std::size_t kMaxWaitAny = 128;  // FUTEX_WAITV_MAX of Linux
WaitStatus wait_any(std::span<RawReader* const> readers, MonoTime deadline) noexcept;
inline WaitStatus wait_any(std::span<RawReader* const> readers, Duration timeout) noexcept {
  return wait_any(readers, deadline_in(timeout));
}

// The same with a T in place of bytes: what a sample does not have, because a RawWriter wrote fewer
// bytes, is 0. Everything not listed here is as in RawReader. Each read comes in two forms: into
// variables of the caller, and with the sample as its result (dssm/typed_reads.hpp).
template <Payload T>
class Reader : public TypedReads<T, RawReader> {
 public:
  explicit Reader(RawReader raw) noexcept : TypedReads<T, RawReader>(std::move(raw)) {}

  // This reader's part of a read_joint_at(), which copies the sample to `out`.
  JointSample joint_sample(T& out) noexcept { return {this, detail::bytes_of(out), {}}; }

  // The borrowed payload as a T, if it has all bytes of one. Check still_valid() after the last use
  // of what was read.
  static const T& view(const BorrowedSample& sample) noexcept {
    return *reinterpret_cast<const T*>(sample.payload().data());
  }
};

}  // namespace dssm
#pragma GCC visibility pop
