// SPDX-License-Identifier: Apache-2.0
//
// Flags, and how they go together with the file.
#include "daemon/service/command_line.hpp"

#include <gtest/gtest.h>

#include <algorithm>
#include <fstream>
#include <vector>

#include "tests/support/daemon_process.hpp"

namespace dssm::daemon {
namespace {

Result<CommandLine> parse(std::vector<const char*> words) {
  words.insert(words.begin(), "dssmd");
  return parse_command_line(static_cast<int>(words.size()), words.data());
}

TEST(CommandLine, HasAFlagForEveryKey) {
  const Result<CommandLine> help = parse({"--help"});
  ASSERT_TRUE(help);
  EXPECT_EQ(help->action, CommandLine::Action::print);
  for (const ConfigKey& key : config_keys()) {
    EXPECT_NE(help->text.find(key.flag() + " "), std::string::npos) << key.flag();
  }
}

TEST(CommandLine, PrintsItsVersion) {
  const Result<CommandLine> version = parse({"--version"});
  ASSERT_TRUE(version);
  EXPECT_EQ(version->action, CommandLine::Action::print);
  EXPECT_EQ(version->text, "dssmd " DSSM_VERSION "\n");
}

TEST(CommandLine, LetsAFlagWinOverTheFile) {
  const std::string dir = test::make_temp_dir(), path = dir + "/dssmd.conf";
  std::ofstream(path) << "name = \"from-file\"\nmax_streams = 5\n";
  const Result<CommandLine> line = parse({"--name", "from-flag", "--config", path.c_str()});
  ASSERT_TRUE(line) << line.error().message;
  EXPECT_EQ(line->config.name, "from-flag");
  EXPECT_EQ(line->config.max_streams, 5u);
  EXPECT_EQ(line->action, CommandLine::Action::run);
  test::remove_tree(dir);
}

TEST(CommandLine, TakesAListFromARepeatedFlagInPlaceOfTheFiles) {
  const std::string dir = test::make_temp_dir(), path = dir + "/dssmd.conf";
  std::ofstream(path) << "peers = [\"pc7\", \"pc8\"]\nlisten = [\"127.0.0.1:5\"]\n";
  const Result<CommandLine> line = parse({"--config", path.c_str(), "--peer", "pc2", "--insecure",
                                          "--peer", "pc3:77", "--listen", ""});
  ASSERT_TRUE(line) << line.error().message;
  const std::vector<wire::Address> peers = {{"pc2", 13776}, {"pc3", 77}};
  EXPECT_EQ(line->config.peers, peers);
  EXPECT_TRUE(line->config.insecure);
  ASSERT_TRUE(line->config.listen);
  EXPECT_TRUE(line->config.listen->empty());
  test::remove_tree(dir);
}

TEST(CommandLine, TurnsMdnsOffAndChoosesItsInterfaces) {
  const Result<CommandLine> defaults = parse({});
  ASSERT_TRUE(defaults) << defaults.error().message;
  EXPECT_TRUE(defaults->config.mdns);
  const Result<CommandLine> line = parse(
      {"--mdns=false", "--interface", "eth0", "--interface", "wlan*", "--avoid-interface", ""});
  ASSERT_TRUE(line) << line.error().message;
  EXPECT_FALSE(line->config.mdns);
  EXPECT_EQ(line->config.interfaces, (std::vector<std::string>{"eth0", "wlan*"}));
  EXPECT_TRUE(line->config.avoid_interfaces.empty());
  EXPECT_TRUE(parse({"--mdns"})->config.mdns);
  EXPECT_FALSE(parse({"--mdns=no"})->config.mdns);
  EXPECT_FALSE(parse({"--interface", "no name"}));
}

TEST(CommandLine, LetsAFlagTakeBackWhatTheFileAllows) {
  const std::string dir = test::make_temp_dir(), path = dir + "/dssmd.conf";
  std::ofstream(path) << "insecure = true\n";
  const Result<CommandLine> line = parse({"--config", path.c_str(), "--insecure=false"});
  ASSERT_TRUE(line) << line.error().message;
  EXPECT_FALSE(line->config.insecure);
  EXPECT_FALSE(parse({"--config", path.c_str(), "--insecure=false", "--peer", "pc2"}));
  test::remove_tree(dir);
}

TEST(CommandLine, ReportsMistakesOfFileAndFlagsTogether) {
  const std::string dir = test::make_temp_dir(), path = dir + "/dssmd.conf";
  std::ofstream(path) << "color = 1\n";
  const Result<CommandLine> line =
      parse({"--config", path.c_str(), "--check-config", "--max-streams", "0"});
  ASSERT_FALSE(line);
  EXPECT_EQ(line.error().code, Errc::invalid_argument);
  EXPECT_NE(line.error().message.find(path + ":1: key 'color'"), std::string::npos);
  EXPECT_NE(line.error().message.find("\n--max-streams: '0' is outside"), std::string::npos);
  test::remove_tree(dir);
}

TEST(CommandLine, RefusesWhatItDoesNotKnow) {
  EXPECT_FALSE(parse({"--colour"}));
  EXPECT_FALSE(parse({"stray"}));
  EXPECT_FALSE(parse({"--name"}));
  EXPECT_FALSE(parse({"--runtime-dir", "relative/path"}));
  EXPECT_FALSE(parse({"--runtime-dir", std::string("/").append(96, 'x').c_str()}));
}

TEST(CommandLine, OnlyChecksWhenAskedTo) {
  const Result<CommandLine> line = parse({"--check-config", "--name", "pc1"});
  ASSERT_TRUE(line);
  EXPECT_EQ(line->action, CommandLine::Action::check_config);
}

}  // namespace
}  // namespace dssm::daemon
