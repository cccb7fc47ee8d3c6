// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl says when it cannot do what it was asked for.
#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

const std::vector<std::vector<std::string>> kVerbsThatAsk = {
    {"ls"},
    {"hosts"},
    {"ping", "pc2"},
    {"info"},
    {"info", "s"},
    {"echo", "s"},
    {"hz", "s"},
    {"bw", "s"},
    {"delay", "s"},
    {"create", "s", "--size", "4", "--depth", "4"},
    {"rm", "s"},
    {"property", "get", "s"},
    {"property", "set", "s"},
    {"playback"}};

TEST(Dssmctl, ReportsWhereNoDssmdListensAndWhatToDo) {
  const std::string socket = make_temp_dir() + "/nobody";
  for (std::vector<std::string> words : kVerbsThatAsk) {
    words.insert(words.begin(), dssmctl_path());
    const Finished finished = run(words, {"DSSM_SOCKET=" + socket});
    EXPECT_EQ(finished.exit_status, 1) << words[1];
    EXPECT_EQ(finished.out, "") << words[1];
    EXPECT_TRUE(finished.err.starts_with("dssmctl: " + words[1])) << finished.err;
    for (const std::string& part :
         {"'" + socket + "'", std::string("start dssmd"), std::string("$DSSM_SOCKET")}) {
      EXPECT_NE(finished.err.find(part), std::string::npos) << finished.err;
    }
    EXPECT_EQ(finished.err.find('\n'), finished.err.size() - 1) << finished.err;
  }
  remove_tree(socket.substr(0, socket.rfind('/')));
}

TEST(Dssmctl, EndsWithStatusTwoAndAHintOnWrongUsage) {
  for (std::vector<std::string> words :
       std::vector<std::vector<std::string>>{{},
                                             {"lss"},
                                             {"ls", "--wrong"},
                                             {"echo"},
                                             {"create", "s"},
                                             {"hz", "s", "--count", "many"}}) {
    words.insert(words.begin(), dssmctl_path());
    const Finished finished = run(words, {"DSSM_SOCKET=/nonexistent"});
    EXPECT_EQ(finished.exit_status, 2);
    EXPECT_EQ(finished.out, "");
    EXPECT_NE(finished.err.find("--help"), std::string::npos) << finished.err;
  }
}

using Errors = CtlTest;

TEST_F(Errors, RefuseABadStreamNameAsWrongUsage) {
  for (const auto& verb : {"info", "echo", "hz", "bw", "delay", "rm"}) {
    for (const char* name : {"a:b", "a@", "\x1b[31m", "", "a:-1"}) {
      if (std::string_view(verb) == "info" && !*name) continue;  // asks about dssmd
      const Finished finished = ctl({verb, name});
      EXPECT_EQ(finished.exit_status, 2) << verb << " '" << name << "'";
      EXPECT_EQ(finished.err.find('\x1b'), std::string::npos) << finished.err;
    }
  }
}

TEST_F(Errors, NameSimilarStreams) {
  auto lidar = session_.create<double>("front_lidar", depth_of(4)).value();
  auto odom = session_.create<double>("odom", depth_of(4)).value();
  for (const auto& verb : {"info", "echo", "hz", "bw", "delay", "rm"}) {
    const Finished finished = ctl({verb, "odm"});
    EXPECT_EQ(finished.exit_status, 1);
    EXPECT_NE(finished.err.find("'odm:0'"), std::string::npos) << finished.err;
    EXPECT_NE(finished.err.find("is it 'odom'?"), std::string::npos) << finished.err;
    EXPECT_EQ(finished.err.find("lidar"), std::string::npos) << finished.err;
  }
  EXPECT_NE(ctl({"echo", "odm"}).err.find("--wait"), std::string::npos);
}

TEST_F(Errors, SayThatThereAreNoStreamsAtAll) {
  const Finished finished = ctl({"echo", "s"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("there are no streams at all"), std::string::npos) << finished.err;
}

TEST_F(Errors, FindTheDaemonBySocketOption) {
  const Finished finished =
      run({dssmctl_path(), "--socket", daemon_.socket_path(), "ls"}, {"DSSM_SOCKET=/nonexistent"});
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
}

TEST_F(Errors, NoticeAFolderInPlaceOfASocket) {
  const Finished finished = ctl({"--socket", daemon_.runtime_dir(), "ls"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_TRUE(contains(finished.err, "this is a folder, not dssmd's socket")) << finished.err;
  EXPECT_TRUE(contains(finished.err, daemon_.runtime_dir() + "/dssmd.sock")) << finished.err;
}

TEST_F(Errors, ReportAFullDisk) {
  const Finished finished =
      run({"/bin/sh", "-c", "exec \"$@\" > /dev/full", "sh", dssmctl_path(), "ls"}, environment());
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("write to standard output"), std::string::npos) << finished.err;
}

}  // namespace
}  // namespace dssm::test
