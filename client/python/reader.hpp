// SPDX-License-Identifier: Apache-2.0
//
// A reader of a live stream for Python, and joint reads of several readers.
#pragma once

#include <memory>
#include <vector>

#include "client/python/reads.hpp"

namespace dssm::python {

struct Reader {
  Reader(RawReader raw, const WantedType& wanted) : reads(std::move(raw), wanted) {}
  Reads<RawReader> reads;
};

// Of each reader the sample at `time`: (samples, clock_error_ns), or None for not_yet. `Joint` is
// JointSample or RecordedJointSample.
template <class Joint, class ReaderPtr>
py::object read_joint(py::handle time, const std::vector<ReaderPtr>& readers, py::handle max_error,
                      py::handle max_age, py::handle wait) {
  const Time t = to_time(time);
  const Duration error = to_duration(max_error, kUnknownClockError);
  const Duration age = to_duration(max_age, kAnyAge);
  const MonoTime arriving_until = wait_deadline(wait);
  std::vector<py::object> arrays;
  std::vector<Joint> joints;
  for (const ReaderPtr& reader : readers) {
    reader->reads.check_leases();
    arrays.push_back(reader->reads.values().new_array());
    Joint joint;
    joint.payload = ValueType::bytes_of(arrays.back());
    joints.push_back(joint);
  }
  JointRead result;
  const auto is_repeated = [&] {
    return result.status == ReadStatus::restarted ||
           (result.status == ReadStatus::arriving &&
            readers[result.index]->reads.pause_while_arriving(arriving_until));
  };
  do {
    // Another thread may have used or closed a reader during the pause.
    for (std::size_t i = 0; i < joints.size(); ++i) joints[i].reader = &readers[i]->reads.raw();
    result = read_joint_at(t, joints, error, age);
    if (result.status == ReadStatus::restarted) {
      for (const ReaderPtr& reader : readers) reader->reads.check_leases();
      readers[result.index]->reads.is_new() = false;
    }
  } while (is_repeated());
  if (result.status == ReadStatus::not_yet) return py::none();
  if (result.status != ReadStatus::ok) {
    raise(result.status, readers[result.index]->reads.raw().id(),
          "time " + std::to_string(to_ns(t)) + " ns");
  }
  py::list samples;
  for (std::size_t i = 0; i < joints.size(); ++i) {
    samples.append(make_sample(joints[i].info,
                               readers[i]->reads.values().value_of(arrays[i], joints[i].info)));
  }
  return py::make_tuple(samples, to_ns(result.clock_error));
}

}  // namespace dssm::python
