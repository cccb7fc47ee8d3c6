// SPDX-License-Identifier: Apache-2.0
//
// What reads return that have no out-parameters: the sample with its payload, or the reason why
// there is none.
//
//   if (const auto pose = reader.read_at(t, 20ms)) use(pose->value, pose->time());
//
// A read stores its sample where the caller's variable is, so nothing is copied twice. For a T that
// is too large for the stack, or that has no default constructor, there are the out-parameters.
//
//   threads  as any value: no two threads may use one object if one of them changes it
#pragma once

#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <type_traits>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

template <Payload T>
struct Sample {
  T value;
  SampleInfo info;

  Tid tid() const noexcept { return info.tid; }
  // When it was measured, by the writer's clock.
  Time time() const noexcept { return info.time; }
  // >= 0 [ns]: bound on the error of time(). RawReader::clock_error(info): against this PC's clock.
  Duration clock_error() const noexcept { return info.clock_error; }
};

// The two samples around a time.
template <Payload T>
struct NeighbourSamples {
  Sample<T> before;  // newest sample with time <= t
  Sample<T> after;   // the one after it that is not lost; its time is > t
};

// A V that was read, or the status that says why there is none.
template <class V>
class [[nodiscard]] ReadOr {
 public:
  // Calls `read`, which stores a value and returns `ok`, or returns another status.
  template <class Read>
  requires std::is_invocable_r_v<ReadStatus, Read, V&>
  explicit ReadOr(Read read) noexcept(std::is_nothrow_invocable_v<Read, V&>)
      : status_(read(value_)) {}

  // `ok` if there is a value.
  ReadStatus status() const noexcept { return status_; }
  explicit operator bool() const noexcept { return status_ == ReadStatus::ok; }

  // The value; undefined without one (check first).
  V& operator*() noexcept { return value_; }
  const V& operator*() const noexcept { return value_; }
  V* operator->() noexcept { return &value_; }
  const V* operator->() const noexcept { return &value_; }

 private:
  V value_;  // before status_, whose initialization stores it
  ReadStatus status_;
};

template <Payload T>
using SampleOr = ReadOr<Sample<T>>;

}  // namespace dssm
#pragma GCC visibility pop
