// SPDX-License-Identifier: Apache-2.0
//
// Writing a stream. RawWriter works on bytes; Writer<T> on a trivially copyable T.
//
//   threads  one writer object belongs to one thread at a time; several writers of one stream, in
//            any threads and processes, are serialised by the ring's robust lock
//   signals  not from a handler that may interrupt a write to the same stream in its own thread:
//            it would wait for itself
//   cost     a copy; no system call unless a reader sleeps on the stream or a remote one is
//            subscribed. A writer that dies at any instruction blocks nobody.
//   life     a writer keeps its ring mapped, and stays usable after its Session object is gone and
//            while dssmd is away
//   moved    a moved-from writer may only be assigned to or destroyed
#pragma once

#include <cstddef>
#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <span>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

namespace detail {
struct WriterState;
}

// The next slot, to be filled in place. Holds the stream's writer lock: publish() or abandon() it
// soon; destroying it abandons it. Not movable, so that it cannot outlive its writer unnoticed.
class LoanedSample {
 public:
  LoanedSample(const LoanedSample&) = delete;
  LoanedSample& operator=(const LoanedSample&) = delete;
  ~LoanedSample() { abandon(); }

  // Whether the slot was lent: false when this thread holds another loan of this stream already.
  explicit operator bool() const noexcept { return !payload_.empty(); }

  // The slot's payload, payload_bytes() long, aligned to 64 bytes; its content is unspecified. At
  // least 64 bytes behind its end belong to nobody. Empty without a loan. Who fills it with
  // non-temporal stores of their own ends them with a store fence (x86: sfence), as always.
  std::span<std::byte> payload() const noexcept { return payload_; }

  // Makes the sample visible, stamped with `time`, and gives its tid. kNoTid without a loan.
  Tid publish(Time time, Duration clock_error = kOwnClockError) noexcept;

  // Gives the slot back; nobody sees what was written into it.
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
  //   payload      exactly payload_bytes() long
  //   time         when it was measured; stored as given, also when it runs backwards
  //   clock_error  >= 0: bound on the error of `time`. kOwnClockError: the bound that dssmd knows
  //                for this PC's clock at `time`, which was a few seconds ago at most. A time that
  //                is more than 10 s from now does not come from this clock but from a recording:
  //                it gets kForeignClockError
  //   returns      its tid; kNoTid when the length is wrong or this thread holds a loan
  Tid write(std::span<const std::byte> payload, Time time = WallClock::now(),
            Duration clock_error = kOwnClockError) noexcept;

  // Lends the next slot for filling in place. Waits for other writers of this stream.
  LoanedSample loan() noexcept;

  // Replaces the stream's property (0 bytes: removes it). Asks dssmd.
  Result<void> set_property(std::span<const std::byte> property);

  // Tid of the newest sample, kNoTid while nothing is written.
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

  // The lent slot as a T, unspecified content; only while `loan` is true.
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
