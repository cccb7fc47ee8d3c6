// SPDX-License-Identifier: Apache-2.0
//
// What `dssmctl doctor` makes of the facts: pure, so that tests can put any of them here.
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
  std::string command;  // that mends it, or shows more; empty when ok
};

// In the order in which a person would look: dssmd, this PC, the others. While dssmd does not
// answer, nothing is said about what only it knows.
std::vector<Finding> findings_of(const Facts& facts);

}  // namespace dssm::ctl
