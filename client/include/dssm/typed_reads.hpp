// SPDX-License-Identifier: Apache-2.0
//
// The reads of Reader<T> and RecordedReader<T>: those of RawReader and RecordedRawReader, with a T
// in place of bytes. Each comes in two forms: into variables of the caller, and with the sample as
// its result (dssm/sample_or.hpp).
//
//   threads  as Raw
#pragma once

#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <dssm/sample_or.hpp>
#include <span>
#include <utility>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// The two samples around a time, for interpolation.
struct Neighbours {
  SampleInfo before;  // newest sample with time <= t
  SampleInfo after;   // the one after it that is not lost; its time is > t
};

namespace detail {
template <Payload T>
std::span<std::byte> bytes_of(T& out) noexcept {
  return std::as_writable_bytes(std::span<T, 1>(&out, 1));
}
}  // namespace detail

template <Payload T, class Raw>
class TypedReads : public Raw {
 public:
  ReadStatus read_newest(T& out, SampleInfo& info) noexcept {
    return complete(Raw::read_newest(detail::bytes_of(out), info), out, info);
  }
  ReadStatus read_tid(Tid n, T& out, SampleInfo& info) noexcept {
    return complete(Raw::read_tid(n, detail::bytes_of(out), info), out, info);
  }
  ReadStatus read_next(T& out, SampleInfo& info) noexcept {
    return complete(Raw::read_next(detail::bytes_of(out), info), out, info);
  }
  ReadStatus read_previous(T& out, SampleInfo& info) noexcept {
    return complete(Raw::read_previous(detail::bytes_of(out), info), out, info);
  }
  ReadStatus read_at(Time t, T& out, SampleInfo& info, Duration max_age = kAnyAge) noexcept {
    return complete(Raw::read_at(t, detail::bytes_of(out), info, max_age), out, info);
  }
  ReadStatus read_at_or_after(Time t, T& out, SampleInfo& info) noexcept {
    return complete(Raw::read_at_or_after(t, detail::bytes_of(out), info), out, info);
  }
  ReadStatus read_nearest(Time t, T& out, SampleInfo& info) noexcept {
    return complete(Raw::read_nearest(t, detail::bytes_of(out), info), out, info);
  }

  SampleOr<T> read_newest() noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_newest(out.value, out.info); });
  }
  SampleOr<T> read_tid(Tid n) noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_tid(n, out.value, out.info); });
  }
  SampleOr<T> read_next() noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_next(out.value, out.info); });
  }
  SampleOr<T> read_previous() noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_previous(out.value, out.info); });
  }
  SampleOr<T> read_at(Time t, Duration max_age = kAnyAge) noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_at(t, out.value, out.info, max_age); });
  }
  SampleOr<T> read_at_or_after(Time t) noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_at_or_after(t, out.value, out.info); });
  }
  SampleOr<T> read_nearest(Time t) noexcept {
    return SampleOr<T>([&](Sample<T>& out) { return read_nearest(t, out.value, out.info); });
  }
  ReadOr<NeighbourSamples<T>> read_neighbours(Time t) noexcept {
    return ReadOr<NeighbourSamples<T>>([&](NeighbourSamples<T>& out) {
      Neighbours infos;
      const ReadStatus status = Raw::read_neighbours(t, detail::bytes_of(out.before.value),
                                                     detail::bytes_of(out.after.value), infos);
      out.before.info = infos.before;
      out.after.info = infos.after;
      (void)complete(status, out.before.value, infos.before);
      return complete(status, out.after.value, infos.after);
    });
  }

 protected:
  explicit TypedReads(Raw raw) noexcept : Raw(std::move(raw)) {}

 private:
  // What a shorter sample does not have is 0.
  static ReadStatus complete(ReadStatus status, T& out, const SampleInfo& info) noexcept {
    if (status == ReadStatus::ok) zero_rest(detail::bytes_of(out), info);
    return status;
  }
};

}  // namespace dssm
#pragma GCC visibility pop
