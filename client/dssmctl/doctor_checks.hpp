// SPDX-License-Identifier: Apache-2.0
//
// The findings of `dssmctl doctor`: a pure function of the facts, so that tests can give any.
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "client/dssmctl/doctor_facts.hpp"

namespace dssm::ctl {

struct Finding {
  // warn: it works, but not as well or not as long as it could; fail: something does not work.
  enum class Status : std::uint8_t { ok, warn, fail };
  std::string name;  // of the check: "daemon", "mdns", "host pc2"
  Status status = Status::ok;
  std::string text;     // what was found
  std::string cause;    // the likely one; empty when ok
  std::string command;  // that fixes it, or shows more; empty when ok
};

// In the order of a person's search: dssmd, this PC, the others. While dssmd does not answer, there
// are no findings about what only it knows.
std::vector<Finding> findings_of(const Facts& facts);

}  // namespace dssm::ctl
