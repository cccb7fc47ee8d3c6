// SPDX-License-Identifier: Apache-2.0
//
// The man pages say what the help texts say: every verb and long option, and none besides.
#include <algorithm>
#include <fstream>
#include <iterator>

#include "tests/process/dssmctl/help_words.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

// A page without roff's escapes: `\-\-json` is "--json".
std::string page(const std::string& name) {
  std::ifstream file(source_root() + "/docs/man/" + name);
  std::string text(std::istreambuf_iterator<char>(file), {});
  EXPECT_FALSE(text.empty()) << name;
  text.erase(std::remove(text.begin(), text.end(), '\\'), text.end());
  return text;
}

std::set<std::string> all_dssmctl_options() {
  std::set<std::string> all = help_options({});
  for (const std::string& verb : help_verbs({})) {
    all.merge(help_options({verb}));
    for (const std::string& inner : help_verbs({verb})) all.merge(help_options({verb, inner}));
  }
  return all;
}

TEST(ManPage, OfDssmctlMentionsExactlyTheOptionsThereAre) {
  EXPECT_EQ(long_options(page("dssmctl.1")), all_dssmctl_options());
}

TEST(ManPage, OfDssmctlHasASectionForEveryVerb) {
  const std::string text = page("dssmctl.1");
  for (const std::string& verb : help_verbs({})) {
    EXPECT_NE(text.find("\n.SS " + verb), std::string::npos) << verb;
    for (const std::string& inner : help_verbs({verb})) {
      const std::size_t section = text.find("\n.SS " + verb);
      EXPECT_TRUE(text.find(" " + inner + " ", section) != text.npos ||
                  text.find(" " + inner + "\n", section) != text.npos)
          << verb << " " << inner;
    }
  }
  EXPECT_GE(help_verbs({}).size(), 10U);  // the help text was understood at all
}

TEST(ManPage, OfDssmdMentionsExactlyTheOptionsThereAre) {
  const std::set<std::string> options = described_options(help_text({built("daemon/dssmd")}));
  EXPECT_TRUE(options.contains("--runtime-dir"));
  EXPECT_EQ(long_options(page("dssmd.8")), options);
}

}  // namespace
}  // namespace dssm::test
