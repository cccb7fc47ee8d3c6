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
    options.insert({"--iso", "--json", "--socket", "--wide"});
    Strings expected(options.begin(), options.end());
    verb.push_back("--");
    EXPECT_EQ(offered(verb), expected) << Json(verb);
  }
}

TEST_F(Completion, OffersAnOptionAgainOnlyWhereItMayBeGivenAgain) {
  EXPECT_EQ(offered({"echo", "--count", "3", "--c"}), Strings{"--csv"});
  EXPECT_EQ(offered({"echo", "--field", "speed", "--f"}), (Strings{"--field", "--full"}));
  EXPECT_EQ(offered({"ls", "--host", "pc2", "--watch", "--h"}), (Strings{"--help", "--host"}));
  EXPECT_EQ(offered({"--json", "ls", "--j"}), Strings{});
}

TEST_F(Completion, OffersStreamNamesWhereAStreamBelongs) {
  for (const char* name : {"lidar", "lidar:1", "odom"}) create(name);
  for (const char* verb : {"info", "echo", "hz", "bw", "delay", "rm"}) {
    EXPECT_EQ(offered({verb, ""}), (Strings{"lidar", "lidar:1", "odom"})) << verb;
    EXPECT_EQ(offered({verb, "od"}), Strings{"odom"}) << verb;
  }
  EXPECT_EQ(offered({"property", "get", "od"}), Strings{"odom"});
  EXPECT_EQ(offered({"echo", "--count", "3", "--csv", "od"}), Strings{"odom"});
  EXPECT_EQ(offered({"echo", "odom", ""}), Strings{});    // takes one stream
  for (const char* verb : {"rm", "hz", "bw", "delay"}) {  // take many
    EXPECT_EQ(offered({verb, "odom", "od"}), Strings{"odom"}) << verb;
  }
  EXPECT_EQ(offered({"echo", "--count", ""}), Strings{});  // a number belongs here
  EXPECT_EQ(offered({"create", ""}), Strings{});
}

struct Place {
  double x, y;
};
DSSM_DESCRIBE(Place, x, y)

struct Robot {
  Place pose;
  float speed;
};
DSSM_DESCRIBE(Robot, pose, speed)

TEST_F(Completion, OffersTheFieldsOfTheStream) {
  auto robot = session_.create<Robot>("robot:1", depth_of(4)).value();
  EXPECT_EQ(offered({"echo", "robot", ":", "1", "--field", ""}),
            (Strings{"pose.x", "pose.y", "speed"}));
  EXPECT_EQ(offered({"echo", "robot", ":", "1", "--csv", "--field", "p"}),
            (Strings{"pose.x", "pose.y"}));
  EXPECT_EQ(offered({"echo", "--field", ""}), Strings{}) << "of which stream?";
}

TEST_F(Completion, OffersVerbsToHelp) {
  EXPECT_EQ(offered({"help", "ec"}), Strings{"echo"});
  EXPECT_EQ(offered({"help", "property", ""}), (Strings{"get", "set"}));
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
  EXPECT_EQ(offered({"top", "--sort", "r"}), (Strings{"rate", "readers", "reads", "rtt"}));
  EXPECT_EQ(offered({"top", "--view", "p"}), Strings{"programs"});
  create("s");
  std::ofstream(daemon_.runtime_dir() + "/calibration") << "x";
  EXPECT_EQ(offered({"property", "set", "s", daemon_.runtime_dir() + "/cal"}),
            Strings{daemon_.runtime_dir() + "/calibration"});
}

// --- zsh and fish

bool is_installed(const std::string& program) {
  return run({"/bin/sh", "-c", "command -v " + program}).exit_status == 0;
}

// Ends a test of a shell that is not here.
#define NEEDS(shell) \
  if (!is_installed(shell)) GTEST_SKIP() << shell << " is not installed"

class CompletionInOtherShells : public FleetTest {
 protected:
  // The same in zsh, whose own functions are replaced: they work in an interactive shell only.
  Strings in_zsh(const Strings& words) {
    const std::string script =
        "compadd() { [[ $1 == -a ]] && print -rl -- ${(P)2} || print -rl -- $@ }; "
        "_files() { print files }; script=$1; shift; words=(\"$@\"); CURRENT=$#words; source "
        "$script";
    Strings argv = {"zsh",         "-f",  "-c",
                    script,        "zsh", source_root() + "/client/dssmctl/_dssmctl",
                    dssmctl_path()};
    argv.insert(argv.end(), words.begin(), words.end());
    return candidates(argv, words.back());
  }

  Strings in_fish(const Strings& words) {
    std::string line = "dssmctl";
    for (const std::string& word : words) line += " " + word;
    return candidates({"fish", "--no-config", "-c",
                       "source $argv[1]; set -x PATH (path dirname $argv[2]) $PATH; complete -C "
                       "$argv[3] | string replace -r '\\t.*' ''",
                       source_root() + "/client/dssmctl/dssmctl.fish", dssmctl_path(), line},
                      words.back());
  }

  void create_streams() {
    robot_.emplace(session_.create<Robot>("robot:1", depth_of(4)).value());
    output({"create", "lidar@pc2", "--size", "4", "--depth", "4"});
    await_streams(1);
  }

  // What both have to offer for `words`.
  struct Offer {
    Strings words, candidates;
  };
  const std::vector<Offer> offers_ = {
      {{"ec"}, {"echo"}},
      {{"property", ""}, {"get", "set"}},
      {{"help", "ec"}, {"echo"}},
      {{"echo", ""}, {"lidar", "robot:1"}},
      {{"echo", "--count", "3", "l"}, {"lidar"}},
      {{"echo", "robot:1", ""}, {}},
      {{"hz", "robot:1", "l"}, {"lidar"}},
      {{"echo", "robot:1", "--field", "p"}, {"pose.x", "pose.y"}},
      {{"echo", "lidar@pc"}, {"lidar@pc1", "lidar@pc2", "lidar@pc3"}},
      {{"ping", ""}, {"pc1", "pc2", "pc3"}},
      {{"ls", "--host", "pc2"}, {"pc2"}},
      {{"ls", "--sort", "r"}, {"rate", "readers"}},
      {{"hosts", "--w"}, {"--watch", "--wide"}},
      {{"--v"}, {"--version"}},
      {{"hosts", "--v"}, {}},
      {{"echo", "--count", ""}, {}},
      {{"echo", "--count", "3", "--c"}, {"--csv"}},
      {{"echo", "--field", "speed", "--f"}, {"--field", "--full"}},
      {{"ls", "--host", "pc2", "--watch", "--h"}, {"--help", "--host"}},
      {{"ls", "--host", "pc2", "--watch", "--w"}, {"--wide"}},
  };

 private:
  // The lines of the output that begin with `typed`, sorted.
  Strings candidates(const Strings& argv, const std::string& typed) {
    const Finished finished = run(argv, environment());
    EXPECT_EQ(finished.err, "");
    Strings lines = lines_of(finished.out);
    std::erase_if(lines, [&](const std::string& line) { return !line.starts_with(typed); });
    std::erase(lines, "");
    std::sort(lines.begin(), lines.end());
    return lines;
  }

  std::optional<Writer<Robot>> robot_;
};

TEST_F(CompletionInOtherShells, OffersInZshWhatItOffersInBash) {
  if (kIsSanitized) GTEST_SKIP() << "about texts: a sanitizer sees nothing in them";
  NEEDS("zsh");
  create_streams();
  EXPECT_EQ(in_zsh({""}), help_verbs({}));
  for (const Offer& offer : offers_) {
    EXPECT_EQ(in_zsh(offer.words), offer.candidates) << Json(offer.words);
  }
}

TEST_F(CompletionInOtherShells, OffersInFishWhatItOffersInBash) {
  if (kIsSanitized) GTEST_SKIP() << "about texts: a sanitizer sees nothing in them";
  NEEDS("fish");
  create_streams();
  EXPECT_EQ(in_fish({""}), help_verbs({}));
  for (const Offer& offer : offers_) {
    EXPECT_EQ(in_fish(offer.words), offer.candidates) << Json(offer.words);
  }
}

}  // namespace
}  // namespace dssm::test
