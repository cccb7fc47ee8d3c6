// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/options.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;

CommandLine parse(std::vector<const char*> words) {
  words.insert(words.begin(), "dssmctl");
  return parse_command_line(static_cast<int>(words.size()), words.data());
}

Options options_of(std::vector<const char*> words) {
  CommandLine line = parse(std::move(words));
  EXPECT_TRUE(line.options) << line.text;
  return line.options.value_or(Options{});
}

std::string complaint_of(std::vector<const char*> words) {
  const CommandLine line = parse(std::move(words));
  EXPECT_FALSE(line.options || line.ok);
  return line.text;
}

TEST(CommandLine, TakesGlobalOptionsOnBothSidesOfTheVerb) {
  for (const Options& options : {options_of({"--json", "--socket", "/s", "ls"}),
                                 options_of({"ls", "--json", "--socket", "/s"})}) {
    EXPECT_EQ(options.verb, Verb::ls);
    EXPECT_TRUE(options.json);
    EXPECT_EQ(options.socket_path, "/s");
  }
}

TEST(CommandLine, TellsAtBeforeTheNewestFromAtSince1970) {
  EXPECT_FALSE(options_of({"echo", "s", "--at", "1.5"}).at_counts_back);
  const Options back = options_of({"echo", "s", "--at", "-1.5"});
  EXPECT_TRUE(back.at_counts_back);
  EXPECT_EQ(back.at, -1500ms);
  EXPECT_TRUE(options_of({"echo", "s", "--at", "-0"}).at_counts_back);
}

TEST(CommandLine, TakesOneFieldPerOption) {
  const Options options = options_of({"echo", "--field", "a", "--field", "b", "s"});
  EXPECT_EQ(options.fields, (std::vector<std::string>{"a", "b"}));
  EXPECT_EQ(options.stream, "s");
}

TEST(CommandLine, KnowsVerbsInsideVerbs) {
  EXPECT_EQ(options_of({"playback"}).verb, Verb::playback_show);
  EXPECT_EQ(options_of({"playback", "pause"}).verb, Verb::playback_pause);
  const Options set = options_of({"property", "set", "s", "file"});
  EXPECT_EQ(set.verb, Verb::property_set);
  EXPECT_EQ(set.verb_name, "property set");
  EXPECT_EQ(set.file, "file");
}

TEST(CommandLine, ReadsTheSizesOfAStreamToCreate) {
  const Options options =
      options_of({"create", "s", "--size", "40", "--life", "2", "--cycle", "0.025"});
  EXPECT_EQ(options.payload_bytes, 40U);
  EXPECT_EQ(options.life, 2s);
  EXPECT_EQ(options.cycle, 25ms);
}

TEST(CommandLine, ReadsWhichStreamsToList) {
  const Options some = options_of({"ls", "--host", "pc2", "--host", "pc3", "camera*", "--watch"});
  EXPECT_EQ(some.hosts, (std::vector<std::string>{"pc2", "pc3"}));
  EXPECT_EQ(some.pattern, "camera*");
  EXPECT_TRUE(some.watch);
  EXPECT_FALSE(some.own);
  EXPECT_TRUE(options_of({"ls", "--own"}).own);
  EXPECT_TRUE(options_of({"ls", "--local"}).own);
  EXPECT_EQ(options_of({"doctor", "--json"}).verb, Verb::doctor);
}

TEST(CommandLine, ReadsHowToPing) {
  const Options options = options_of({"ping", "pc2", "-c", "3", "-i", "0.5"});
  EXPECT_EQ(options.verb, Verb::ping);
  EXPECT_EQ(options.host, "pc2");
  EXPECT_EQ(options.count, 3U);
  EXPECT_EQ(options.interval, 500ms);
  EXPECT_EQ(options_of({"ping", "pc2"}).interval, 1s);
}

TEST(CommandLine, SaysWhatIsWrongAndWhereHelpIs) {
  const struct {
    std::vector<const char*> words;
    const char* complaint;
  } cases[] = {
      {{"lss"}, "dssmctl: there is no verb 'lss'; see 'dssmctl --help'\n"},
      {{"--wrong"}, "dssmctl: there is no option '--wrong'; see 'dssmctl --help'\n"},
      {{"ls", "--wrong"}, "dssmctl: ls: there is no option '--wrong'; see 'dssmctl ls --help'\n"},
      {{"ls", "o*", "odom"}, "dssmctl: ls: 'odom' is one word too many; see 'dssmctl ls --help'\n"},
      {{"echo"}, "dssmctl: echo: STREAM is required; see 'dssmctl echo --help'\n"},
      {{"property", "del"},
       "dssmctl: property: there is no verb 'del'; see 'dssmctl property --help'\n"},
      {{"ls", "--sort", "x"},
       "dssmctl: ls: --sort: 'x' is no key to sort by; see 'dssmctl ls --help'\n"},
      {{"create", "s", "--size", "0", "--depth", "2"},
       "dssmctl: create: --size: '0' is no whole number from 1 to 67108864; see 'dssmctl create "
       "--help'\n"},
  };
  for (const auto& test : cases) EXPECT_EQ(complaint_of(test.words), test.complaint);
}

TEST(CommandLine, RefusesWhatDoesNotFitTogether) {
  const std::vector<std::vector<const char*>> cases = {
      {"echo", "s", "--last", "--at", "1"},
      {"echo", "s", "--csv", "--json"},
      {"echo", "s", "--count", "0"},
      {"echo", "s", "--wait", "-1"},
      {"ls", "--names", "--json"},
      {"ls", "--names", "--watch"},
      {"ls", "--watch", "--sort", "name"},
      {"ls", "--watch", "--reverse"},
      {"ls", "--local", "--host", "pc2"},
      {"ls", "--host"},
      {"doctor", "pc2"},
      {"hosts", "--names", "--json"},
      {"ping"},
      {"ping", "pc2", "--interval", "0"},
      {"hz", "s", "--window", "1"},
      {"hz", "s", "--interval", "0"},
      {"create", "s", "--size", "4"},
      {"create", "s", "--size", "4", "--life", "1"},
      {"create", "s", "--size", "4", "--life", "1", "--cycle", "1", "--depth", "3"},
      {"create", "s", "--size", "4", "--life", "1", "--cycle", "0"},
      {"create", "s", "--size", "4", "--life", "-1", "--cycle", "1"},
      {"create", "s", "--size", "-4", "--depth", "3"},
      {"create", "s", "--size", "67108865", "--depth", "3"},
      {"create", "s", "--size", "4", "--depth", "1"},
      {"create", "s", "--size", "4", "--depth", "16777217"},
      {"create", "s", "--size", "4", "--depth", "3", "--align", "3"},
      {"playback", "set"},
      {"playback", "set", "--speed", "fast"},
      {"playback", "set", "--time", "1", "--offset", "1"},
      {"property"},
      {"rm"},
      {},
  };
  for (const auto& words : cases) {
    std::string all;
    for (const char* word : words) all.append(word).append(" ");
    const CommandLine line = parse(words);
    EXPECT_FALSE(line.options) << all;
    EXPECT_FALSE(line.ok) << all;
    EXPECT_FALSE(line.text.empty()) << all;
  }
}

TEST(CommandLine, ShowsHelpAndVersionAsAnAnswer) {
  for (const auto& words : std::vector<std::vector<const char*>>{
           {"--help"}, {"-h"}, {"echo", "--help"}, {"property", "get", "--help"}, {"--version"}}) {
    const CommandLine line = parse(words);
    EXPECT_FALSE(line.options);
    EXPECT_TRUE(line.ok);
    EXPECT_TRUE(line.text.ends_with("\n"));
  }
  EXPECT_EQ(parse({"--version"}).text, "dssmctl " DSSM_VERSION "\n");
}

}  // namespace
}  // namespace dssm::ctl
