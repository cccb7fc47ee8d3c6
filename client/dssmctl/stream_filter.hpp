// SPDX-License-Identifier: Apache-2.0
//
// Which streams `dssmctl ls` is to show.
#pragma once

#include <dssm/stream.hpp>
#include <string>
#include <vector>

namespace dssm::ctl {

class StreamFilter {
 public:
  //   hosts    only streams of these; empty: of all
  //   pattern  a shell pattern (fnmatch(3)) for the name, or for NAME:ID, NAME@HOST or NAME:ID@HOST
  //            where it has such a part; empty: all
  StreamFilter(std::vector<std::string> hosts, std::string pattern)
      : hosts_(std::move(hosts)), pattern_(std::move(pattern)) {}

  bool takes(const StreamId& id) const;

 private:
  std::vector<std::string> hosts_;
  std::string pattern_;
};

}  // namespace dssm::ctl
