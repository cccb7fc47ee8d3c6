// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl's and dssmd's help texts offer, taken apart: the truth that completion and man pages
// are compared with.
#pragma once

#include <gtest/gtest.h>

#include <cstdlib>
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

// The long options in a text: "--" and what may belong to an option's name.
inline std::set<std::string> long_options(const std::string& text) {
  static constexpr char kLetters[] = "abcdefghijklmnopqrstuvwxyz-";
  std::set<std::string> options;
  for (std::size_t at = text.find("--"); at != text.npos; at = text.find("--", at + 1)) {
    const std::size_t end = text.find_first_not_of(kLetters, at);
    if (end - at > 2) options.insert(text.substr(at, end - at));
  }
  return options;
}

// The long options that a help text describes: those that begin a line, as "--json" or
// "-n,--count".
inline std::set<std::string> described_options(const std::string& help) {
  std::set<std::string> options;
  for (const std::string& line : lines_of(help)) {
    if (line.starts_with("  -")) options.merge(long_options(words_of(line).front()));
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
