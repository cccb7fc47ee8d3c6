// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl's and dssmd's help texts offer, taken apart: the truth that completion and man pages
// are compared with.
#pragma once

#include <gtest/gtest.h>

#include <cstdlib>
#include <regex>
#include <set>
#include <string>
#include <vector>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {

inline std::string source_root() {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");
  EXPECT_TRUE(root) << "$DSSM_SOURCE_ROOT is not set; run me through `meson test`";
  return root ? root : "";
}

inline std::string help_text(std::vector<std::string> argv) {
  argv.push_back("--help");
  const Finished finished = run(argv);
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  return finished.out;
}

inline std::string dssmctl_help(std::vector<std::string> verb) {
  verb.insert(verb.begin(), dssmctl_path());
  return help_text(verb);
}

// The long options that a help text describes: those that begin a line.
inline std::set<std::string> described_options(const std::string& help) {
  static const std::regex kOption("(?:^|\\n)  (?:-\\w,)?(--[a-z][a-z-]*)");
  std::set<std::string> options;
  for (std::sregex_iterator i(help.begin(), help.end(), kOption), end; i != end; ++i) {
    options.insert((*i)[1]);
  }
  return options;
}

inline std::set<std::string> help_options(const std::vector<std::string>& verb) {
  return described_options(dssmctl_help(verb));
}

// The verbs inside `verb`, sorted; those of dssmctl itself for {}.
inline std::vector<std::string> help_verbs(const std::vector<std::string>& verb) {
  std::set<std::string> verbs;
  bool inside = false;
  for (const std::string& line : lines_of(dssmctl_help(verb))) {
    if (line.empty()) inside = false;
    if (inside) verbs.insert(words_of(line).front());
    if (line == "Subcommands:") inside = true;
  }
  return {verbs.begin(), verbs.end()};
}

}  // namespace dssm::test
