// SPDX-License-Identifier: Apache-2.0
//
// From a type to a ROS 2 message definition (schema encoding "ros2msg") by which CDR decodes the
// payload as it is in memory. CDR aligns each number to its size and knows no other padding, so a
// definition has a uint8 array for each byte between two fields, also at the end of nested types.
// What CDR cannot decode, e.g. a field that is not aligned, becomes a uint8 array.
//
// Names of ROS 2 are narrower than C++'s: "fooBar" becomes "foobar", with the true name in a
// comment.
#pragma once

#include <dssm/stream.hpp>
#include <string>

namespace dssm::recording {

struct Ros2Schema {
  std::string name;  // "dssm/msg/Odometry"
  std::string text;
};

// Of a type without fields: a sequence of uint8, "dssm/msg/Bytes".
Ros2Schema ros2_schema(const TypeInfo& type);

}  // namespace dssm::recording
