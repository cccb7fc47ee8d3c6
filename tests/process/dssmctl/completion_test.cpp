// SPDX-License-Identifier: Apache-2.0
//
// The completion script, in bash as a shell calls it.
#include <algorithm>
#include <cstdlib>
#include <fstream>
#include <set>

#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/process/dssmctl/help_words.hpp"

namespace dssm::test {
namespace {

using Strings = std::vector<std::string>;

template <class Base>
class CompletionOn : public Base {
 protected:
  // What bash would offer with the cursor at the end of `words`, split as bash splits them.
  Strings offered(Strings words) {
    const std::string script =
        "source \"$1\"; shift; COMP_WORDBREAKS=$' \\t\\n@><=;|&(:'; COMP_WORDS=(\"$@\"); "
        "COMP_CWORD=$(($# - 1)); _dssmctl \"$1\"; "
        "((${#COMPREPLY[@]})) && printf '%s\\n' \"${COMPREPLY[@]}\"; exit 0";
    Strings argv = {"bash",        "--norc", "-c",
                    script,        "bash",   source_root() + "/client/dssmctl/dssmctl.bash",
                    dssmctl_path()};
    argv.insert(argv.end(), words.begin(), words.end());
    const Finished finished = run(argv, this->environment());
    EXPECT_EQ(finished.exit_status, 0);
    EXPECT_EQ(finished.err, "");
    Strings lines = lines_of(finished.out);
    std::sort(lines.begin(), lines.end());
    return lines;
  }
  void create(const std::string& name) {
    this->output({"create", name, "--size", "4", "--depth", "4"});
  }
};
using Completion = CompletionOn<CtlTest>;
using CompletionInAFleet = CompletionOn<FleetTest>;

TEST_F(Completion, OffersExactlyTheVerbsOfTheHelpText) {
  EXPECT_EQ(offered({""}), help_verbs({}));
  EXPECT_EQ(offered({"property", ""}), help_verbs({"property"}));
  EXPECT_EQ(offered({"playback", ""}), help_verbs({"playback"}));
  EXPECT_EQ(offered({"--json", "ec"}), Strings{"echo"});
}

TEST_F(Completion, OffersExactlyTheOptionsOfTheHelpText) {
  std::vector<Strings> verbs = {{}};
  for (const std::string& verb : help_verbs({})) {
    verbs.push_back({verb});
    for (const std::string& inner : help_verbs({verb})) verbs.push_back({verb, inner});
  }
  for (Strings verb : verbs) {
    std::set<std::string> options = help_options(verb);
    options.insert({"--json", "--socket"});
    Strings expected(options.begin(), options.end());
    verb.push_back("--");
    EXPECT_EQ(offered(verb), expected) << Json(verb);
  }
}

TEST_F(Completion, OffersStreamNamesWhereAStreamBelongs) {
  for (const char* name : {"lidar", "lidar:1", "odom"}) create(name);
  for (const char* verb : {"info", "echo", "hz", "bw", "delay", "rm"}) {
    EXPECT_EQ(offered({verb, ""}), (Strings{"lidar", "lidar:1", "odom"})) << verb;
    EXPECT_EQ(offered({verb, "od"}), Strings{"odom"}) << verb;
  }
  EXPECT_EQ(offered({"property", "get", "od"}), Strings{"odom"});
  EXPECT_EQ(offered({"echo", "--count", "3", "--csv", "od"}), Strings{"odom"});
  EXPECT_EQ(offered({"echo", "odom", ""}), Strings{});        // takes one stream
  EXPECT_EQ(offered({"rm", "odom", "od"}), Strings{"odom"});  // takes many
  EXPECT_EQ(offered({"echo", "--count", ""}), Strings{});     // a number belongs here
  EXPECT_EQ(offered({"create", ""}), Strings{});
}

TEST_F(Completion, CompletesAfterColonsAtWhichBashSplitsWords) {
  for (const char* name : {"lidar", "lidar:1", "lidar:12"}) create(name);
  EXPECT_EQ(offered({"echo", "lidar", ":"}), (Strings{"1", "12"}));
  EXPECT_EQ(offered({"echo", "lidar", ":", "12"}), Strings{"12"});
}

TEST_F(CompletionInAFleet, OffersTheNamesThatOpenOtherHostsStreams) {
  for (const char* name : {"odom", "odom@pc2", "lidar@pc2", "lidar@pc3", "imu@pc3"}) create(name);
  await_streams(4);
  EXPECT_EQ(offered({"echo", ""}), (Strings{"imu", "lidar@pc2", "lidar@pc3", "odom", "odom@pc2"}));
  EXPECT_EQ(offered({"echo", "lid"}), (Strings{"lidar@pc2", "lidar@pc3"}));
}

TEST_F(CompletionInAFleet, OffersHostsAfterAnAtSignAtWhichBashSplitsWords) {
  create("imu:1@pc3");
  await_streams(1);
  EXPECT_EQ(offered({"echo", "imu", ":", "1", "@"}), (Strings{"pc1", "pc2", "pc3"}));
  EXPECT_EQ(offered({"info", "imu", "@", "pc2"}), Strings{"pc2"});
  EXPECT_EQ(offered({"create", "new", "@", "p"}), (Strings{"pc1", "pc2", "pc3"}));
}

TEST_F(CompletionInAFleet, OffersHostsToPing) {
  EXPECT_EQ(offered({"ping", ""}), (Strings{"pc1", "pc2", "pc3"}));
  EXPECT_EQ(offered({"ping", "-c", "1", "pc2"}), Strings{"pc2"});
  EXPECT_EQ(offered({"ping", "-c", ""}), Strings{});
  EXPECT_EQ(offered({"ping", "pc2", ""}), Strings{});
  EXPECT_EQ(offered({"ls", "--host", ""}), (Strings{"pc1", "pc2", "pc3"}));
}

TEST_F(Completion, QuotesNamesForTheShell) {
  create("a name");
  EXPECT_EQ(offered({"echo", "a"}), Strings{"a\\ name"});
  EXPECT_EQ(offered({"echo", "a\\ n"}), Strings{"a\\ name"});
}

TEST_F(Completion, UsesTheDaemonThatTheCommandLineNames) {
  create("here");
  DaemonProcess other;
  const Strings none = offered({"--socket", other.socket_path(), "echo", ""});
  EXPECT_EQ(none, Strings{});
}

TEST_F(Completion, IsQuietWithoutADaemon) {
  EXPECT_EQ(offered({"--socket", "/nonexistent", "echo", ""}), Strings{});
}

TEST_F(Completion, OffersKeysToSortByAndFiles) {
  EXPECT_EQ(offered({"ls", "--sort", "r"}), (Strings{"rate", "readers"}));
  create("s");
  std::ofstream(daemon_.runtime_dir() + "/calibration") << "x";
  EXPECT_EQ(offered({"property", "set", "s", daemon_.runtime_dir() + "/cal"}),
            Strings{daemon_.runtime_dir() + "/calibration"});
}

}  // namespace
}  // namespace dssm::test
