// SPDX-License-Identifier: Apache-2.0
//
// What the tests of dssm-view share: dssm-view on pc1, whose dssmd knows pc2 and pc3.
#pragma once

#include <cstdlib>
#include <dssm/describe.hpp>
#include <string>
#include <utility>
#include <vector>

#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {

// The command line of dssm-view with the page of the sources.
inline std::vector<std::string> view_argv(std::vector<std::string> words) {
  std::vector<std::string> argv = {built("client/view/dssm-view"), "--pages",
                                   source("client/view/web")};
  argv.insert(argv.end(), words.begin(), words.end());
  return argv;
}

// What client.py prints for dssm-view at `url` (http://...), line by line; `lines` are its input.
inline std::vector<std::string> run_client(const std::string& url, const std::string& what,
                                           const std::vector<std::string>& lines) {
  std::string input;
  for (const std::string& line : lines) input += line + "\n";
  const Finished finished =
      run({"/usr/bin/python3", source("tests/process/view/client.py"), what, "ws" + url.substr(4)},
          {}, input);
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  return lines_of(finished.out);
}

inline std::string joined(const std::vector<std::string>& lines) {
  std::string text;
  for (const std::string& line : lines) text += line + "\n";
  return text;
}

struct Motion {
  double x;
  float speed[3];
  std::int32_t wheel;
};
DSSM_DESCRIBE(Motion, x, speed, wheel)

class ViewTest : public FleetTest {
 protected:
  ViewTest() {
    const std::string line = view_.line();
    const std::size_t at = line.find("http://");
    EXPECT_NE(at, std::string::npos) << line;
    if (at != std::string::npos) url_ = line.substr(at);
  }

  TestFolder temporary_;  // of dssm-view
  Running view_{view_argv({"--listen", "127.0.0.1:0"}),
                {daemon_.environment(), "TMPDIR=" + temporary_.path()}};
  std::string url_;  // http://127.0.0.1:PORT/
};

}  // namespace dssm::test
