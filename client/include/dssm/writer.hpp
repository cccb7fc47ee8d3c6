// SPDX-License-Identifier: Apache-2.0
//
// Writing a stream. RawWriter works on bytes; Writer<T> on a trivially copyable T.
//
//   threads   one writer belongs to one thread at a time; the ring's robust lock serialises several
//             writers of one stream, in any threads and processes
//   signals   a signal handler must not write to a stream that its thread may be writing to: the
//             lock would never be released
//   cost      a copy; no system call unless a reader sleeps on the stream, a remote reader is
//             subscribed, or another writer is inside (and in a thread's first write). A writer
//             that is killed at any instruction does not block others
//   lifetime  a writer keeps its ring mapped, and stays usable after its Session is destroyed and
//             while dssmd is unavailable
//   moved     a moved-from writer may only be assigned to or destroyed
#pragma once

#include <algorithm>
#include <cstddef>
#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <span>

namespace dssm::detail {
struct WriterState;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// The next slot, to be filled in place. It holds the stream's writer lock: call publish() or
// abandon() soon; the destructor abandons it. It must not outlive its writer, and is not movable.
//   threads   the one that called loan()
class LoanedSample {
 public:
  LoanedSample(const LoanedSample&) = delete;
  LoanedSample& operator=(const LoanedSample&) = delete;
  ~LoanedSample() { abandon(); }

  // Whether there is a slot: false when this thread holds another LoanedSample of this stream, when
  // another writer held the stream's lock for too long, and after publish() or abandon().
  explicit operator bool() const noexcept { return payload_.data() != nullptr; }

  // The slot's payload: payload_bytes() long, aligned to 64 bytes, with unspecified content; empty
  // without a slot. At least 64 unused bytes follow it. Non-temporal stores into it need a store
  // fence (x86: sfence) before publish().
  std::span<std::byte> payload() const noexcept { return payload_; }

  // Makes the sample shorter than the stream's: it is only the first `bytes` of payload(). More
  // than it has change nothing.
  void shorten(std::size_t bytes) noexcept {
    payload_ = payload_.first(std::min(bytes, payload_.size()));
  }

  // Makes the sample visible. Arguments as RawWriter::write().
  //   returns  its tid; kNoTid without a slot
  Tid publish(Time time, Duration clock_error = kOwnClockError) noexcept;

  // Returns the slot; its content never becomes visible.
  void abandon() noexcept;

 private:
  friend class RawWriter;
  explicit LoanedSample(detail::WriterState* state) noexcept;
  detail::WriterState* state_;
  std::span<std::byte> payload_;
};

class RawWriter {
 public:
  RawWriter(RawWriter&&) noexcept;
  RawWriter& operator=(RawWriter&&) noexcept;
  ~RawWriter();

  // Writes one sample.
  //   payload      at most payload_bytes() long: images that are compressed, lists and point clouds
  //                differ in length. Only these bytes are copied, stored and sent; readers find
  //                their number in SampleInfo::payload_bytes
  //   time         when it was measured; stored as given, also when it runs backwards
  //   clock_error  bound on the error of `time` [ns, >= 0], or
  //                kOwnClockError: `time` is of this PC's clock, whose bound at that time is
  //                stored; for a time more than 10 s from now kForeignClockError is stored, since
  //                it is a recording's
  //                kForeignClockError: `time` is of another clock
  //   returns      its tid; kNoTid when it is too long, when this thread holds a LoanedSample, or
  //                when another writer has held the stream's lock for 2 s (a program that is
  //                stopped, or a loan that is kept); after that for 10 ms, until it was free once
  Tid write(std::span<const std::byte> payload, Time time = WallClock::now(),
            Duration clock_error = kOwnClockError) noexcept;

  // The next slot, to be filled in place. Waits for other writers of this stream as write() does.
  LoanedSample loan() noexcept;

  // Replaces the stream's property (0 bytes: removes it): one request to dssmd.
  //   fails  as Session::set_property()
  Result<void> set_property(std::span<const std::byte> property);

  // The tid of the newest sample of any writer; kNoTid while nothing is written.
  Tid newest_tid() const noexcept;

  const StreamId& id() const noexcept;    // with its owner's host
  const TypeInfo& type() const noexcept;  // as stored with the stream
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;
  Duration cycle() const noexcept;
  std::uint64_t incarnation() const noexcept;

 private:
  friend class Session;
  explicit RawWriter(std::unique_ptr<detail::WriterState> state) noexcept;
  std::unique_ptr<detail::WriterState> state_;
};

// The same with a T in place of bytes. Everything not listed here is as in RawWriter.
template <Payload T>
class Writer : public RawWriter {
 public:
  explicit Writer(RawWriter raw) noexcept : RawWriter(std::move(raw)) {}

  Tid write(const T& sample, Time time = WallClock::now(),
            Duration clock_error = kOwnClockError) noexcept {
    return RawWriter::write(std::as_bytes(std::span<const T, 1>(&sample, 1)), time, clock_error);
  }

  // The slot as a T with unspecified content; only while `loan` is true.
  static T& view(const LoanedSample& loan) noexcept {
    return *reinterpret_cast<T*>(loan.payload().data());
  }

  // Replaces the stream's property by the bytes of `property`.
  template <Payload P>
  Result<void> set_property_as(const P& property) {
    return set_property(std::as_bytes(std::span<const P, 1>(&property, 1)));
  }
};

}  // namespace dssm
#pragma GCC visibility pop
