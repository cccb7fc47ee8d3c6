// SPDX-License-Identifier: Apache-2.0
//
// The command line: what each verb takes and refuses, and what the error says.
#include "client/dssmctl/options.hpp"

#include <gtest/gtest.h>

#include <variant>

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;

CommandLine parse(std::vector<const char*> words) {
  words.insert(words.begin(), "dssmctl");
  return parse_command_line(static_cast<int>(words.size()), words.data());
}

// The options of the verb that `words` name, which has to be the one that takes VerbOptions.
template <class VerbOptions>
VerbOptions options_of(std::vector<const char*> words) {
  CommandLine line = parse(std::move(words));
  EXPECT_TRUE(line.options) << line.text;
  return std::get<VerbOptions>(line.options.value());
}

std::string error_of(std::vector<const char*> words) {
  const CommandLine line = parse(std::move(words));
  EXPECT_FALSE(line.options || line.ok);
  return line.text;
}

TEST(CommandLine, TakesGlobalOptionsOnBothSidesOfTheVerb) {
  for (const LsOptions& options : {options_of<LsOptions>({"--json", "--socket", "/s", "ls"}),
                                   options_of<LsOptions>({"ls", "--json", "--socket", "/s"})}) {
    EXPECT_EQ(options.verb_name, "ls");
    EXPECT_TRUE(options.json);
    EXPECT_EQ(options.socket_path, "/s");
  }
}

TEST(CommandLine, DistinguishesTimesBeforeTheNewestFromTimesSince1970) {
  EXPECT_EQ(options_of<EchoOptions>({"echo", "s", "--at", "1.5"}).at,
            Moment{time_from_ns(1'500'000'000)});
  EXPECT_EQ(options_of<EchoOptions>({"echo", "s", "--at", "-1.5"}).at->back, -1500ms);
  EXPECT_FALSE(options_of<EchoOptions>({"echo", "s", "--at", "now"}).at->back);
}

TEST(CommandLine, TakesOneFieldPerOption) {
  const EchoOptions options =
      options_of<EchoOptions>({"echo", "--field", "a", "--field", "b", "s"});
  EXPECT_EQ(options.fields, (std::vector<std::string>{"a", "b"}));
  EXPECT_EQ(options.stream, "s");
}

TEST(CommandLine, TakesTheFormatOfAGraphFromTheNameOfItsFile) {
  EXPECT_EQ(options_of<GraphOptions>({"graph"}).out, "");
  const GraphOptions options = options_of<GraphOptions>({"graph", "--out", "a.dot.svg"});
  EXPECT_EQ(options.out, "a.dot.svg");
  EXPECT_EQ(options.format, "svg");
  EXPECT_NE(
      error_of({"graph", "--out", "a.txt"}).find("'a.txt' does not end in .svg, .png or .dot"),
      std::string::npos);
  EXPECT_NE(error_of({"graph", "--out", "a.svg", "--json"}).find("choose one"), std::string::npos);
}

TEST(CommandLine, TakesAPatternAfterTheHostsOfNodes) {
  const NodesOptions options =
      options_of<NodesOptions>({"nodes", "--host", "pc1", "--host", "pc2", "map*"});
  EXPECT_EQ(options.hosts, (std::vector<std::string>{"pc1", "pc2"}));
  EXPECT_EQ(options.pattern, "map*");
}

TEST(CommandLine, TakesForTopTheKeysOfItsView) {
  const TopOptions options = options_of<TopOptions>(
      {"top", "--view", "hosts", "--sort", "rtt", "-r", "--every", "250ms", "-n", "3", "pc*"});
  EXPECT_EQ(options.view, TopView::hosts);
  EXPECT_EQ(options.sort, "rtt");
  EXPECT_TRUE(options.reverse);
  EXPECT_EQ(options.interval, 250ms);
  EXPECT_EQ(options.count, 3U);
  EXPECT_EQ(options.pattern, "pc*");
  EXPECT_NE(error_of({"top", "--sort", "rtt"}).find("'rtt' is not a key"), std::string::npos);
  EXPECT_NE(error_of({"top", "--view", "all"}).find("there are streams, hosts and programs"),
            std::string::npos);
}

TEST(CommandLine, TakesPatternsAfterTheOptionsOfRecord) {
  const RecordOptions options = options_of<RecordOptions>(
      {"record", "--host", "pc1", "-o", "f.mcap", "--past", "30s", "--max-file-size", "1.5GiB",
       "--max-total-size", "2TiB", "l*", "camera:1"});
  EXPECT_EQ(options.patterns, (std::vector<std::string>{"l*", "camera:1"}));
  EXPECT_EQ(options.hosts, (std::vector<std::string>{"pc1"}));
  EXPECT_EQ(options.file, "f.mcap");
  EXPECT_EQ(options.past, 30s);
  EXPECT_EQ(options.max_file_bytes, 3ULL << 29);
  EXPECT_EQ(options.max_total_bytes, 2ULL << 40);
}

TEST(CommandLine, RefusesARecordingThatCannotBeMeant) {
  const auto expect = [](const std::vector<const char*>& words, const char* error) {
    EXPECT_NE(error_of(words).find(error), std::string::npos) << error_of(words);
  };
  expect({"record", "--follow"}, "only with --past");
  expect({"record", "--max-file-size", "1GB"}, "'1GB' is not a size");
  expect({"record", "--compression", "gzip"}, "there are lz4, zstd and none");
  expect({"record", "--until", "-3s"}, "a time to come");
  expect({"record", "--until", "1700000000"}, "that time is over");
  expect({"record", "--quota", "20"}, "is a unit missing");
  expect({"record", "--until", "now", "--for", "1s"}, "excludes");
}

TEST(CommandLine, KnowsVerbsInsideVerbs) {
  const PlaybackOptions show = options_of<PlaybackOptions>({"playback"});
  EXPECT_EQ(show.verb_name, "playback");
  EXPECT_FALSE(show.paused || show.reset || show.speed);
  EXPECT_EQ(options_of<PlaybackOptions>({"playback", "pause"}).paused, true);
  EXPECT_EQ(options_of<PlaybackOptions>({"playback", "resume"}).paused, false);
  EXPECT_TRUE(options_of<PlaybackOptions>({"playback", "reset"}).reset);
  EXPECT_EQ(options_of<PlaybackOptions>({"playback", "set", "--speed", "2"}).speed, 2);
  const PropertySetOptions set = options_of<PropertySetOptions>({"property", "set", "s", "file"});
  EXPECT_EQ(set.verb_name, "property set");
  EXPECT_EQ(set.file, "file");
  EXPECT_EQ(options_of<PropertyGetOptions>({"property", "get", "s"}).file, "-");
}

TEST(CommandLine, ReadsTheSizesOfAStreamToCreate) {
  const CreateOptions options =
      options_of<CreateOptions>({"create", "s", "--size", "40", "--life", "2", "--cycle", "0.025"});
  EXPECT_EQ(options.payload_bytes, 40U);
  EXPECT_EQ(options.life, 2s);
  EXPECT_EQ(options.cycle, 25ms);
}

TEST(CommandLine, ReadsWhichStreamsToList) {
  const LsOptions some =
      options_of<LsOptions>({"ls", "--host", "pc2", "--host", "pc3", "camera*", "--watch"});
  EXPECT_EQ(some.hosts, (std::vector<std::string>{"pc2", "pc3"}));
  EXPECT_EQ(some.pattern, "camera*");
  EXPECT_TRUE(some.watch);
  EXPECT_FALSE(some.own);
  EXPECT_TRUE(options_of<LsOptions>({"ls", "--own"}).own);
  EXPECT_TRUE(options_of<LsOptions>({"ls", "--local"}).own);
  EXPECT_TRUE(options_of<DoctorOptions>({"doctor", "--json"}).json);
}

TEST(CommandLine, ReadsHowToPing) {
  const PingOptions options = options_of<PingOptions>({"ping", "pc2", "-c", "3", "-i", "0.5"});
  EXPECT_EQ(options.host, "pc2");
  EXPECT_EQ(options.count, 3U);
  EXPECT_EQ(options.interval, 500ms);
  EXPECT_EQ(options_of<PingOptions>({"ping", "pc2"}).interval, 1s);
  EXPECT_EQ(options_of<PingOptions>({"ping", "pc2", "-n", "3", "-i", "20ms"}).count, 3U);
}

TEST(CommandLine, ReportsWhatIsWrongAndWhereHelpIs) {
  const struct {
    std::vector<const char*> words;
    const char* error;
  } cases[] = {
      {{"xyzzy"}, "dssmctl: there is no verb 'xyzzy'; see 'dssmctl --help'\n"},
      {{"lss"}, "dssmctl: there is no verb 'lss' (did you mean 'ls'?); see 'dssmctl --help'\n"},
      {{"list"}, "dssmctl: there is no verb 'list' (did you mean 'ls'?); see 'dssmctl --help'\n"},
      {{"topic", "echo", "odom"},
       "dssmctl: there is no verb 'topic' (did you mean 'echo'?); see 'dssmctl --help'\n"},
      {{"version"},
       "dssmctl: there is no verb 'version' (did you mean '--version'?); see 'dssmctl --help'\n"},
      {{"help", "lss"},
       "dssmctl: there is no verb 'lss' (did you mean 'ls'?); see 'dssmctl --help'\n"},
      {{"--json"}, "dssmctl: a verb is missing; see 'dssmctl --help'\n"},
      {{"property"}, "dssmctl: property: a verb is missing; see 'dssmctl property --help'\n"},
      {{"--wrong"}, "dssmctl: there is no option '--wrong'; see 'dssmctl --help'\n"},
      {{"ls", "--wrong"}, "dssmctl: ls: there is no option '--wrong'; see 'dssmctl ls --help'\n"},
      {{"ls", "o*", "odom"}, "dssmctl: ls: 'odom' is one word too many; see 'dssmctl ls --help'\n"},
      {{"echo"}, "dssmctl: echo: STREAM is required; see 'dssmctl echo --help'\n"},
      {{"playback", "set"},
       "dssmctl: playback set: what shall change? give --offset SECONDS, --speed X or --time TIME; "
       "see 'dssmctl playback set --help'\n"},
      {{"property", "st"},
       "dssmctl: property: there is no verb 'st' (did you mean 'set'?); see 'dssmctl property "
       "--help'\n"},
      {{"property", "list"},
       "dssmctl: property: there is no verb 'list'; see 'dssmctl property --help'\n"},
      {{"service", "call", "s"},
       "dssmctl: there is no verb 'service' (DSSM has only streams, no services); see 'dssmctl "
       "--help'\n"},
      {{"property", "del"},
       "dssmctl: property: there is no verb 'del'; see 'dssmctl property --help'\n"},
      {{"ls", "--sort", "x"},
       "dssmctl: ls: --sort: 'x' is not a key to sort by; there are created, name, id, host, size, "
       "depth, cycle, rate, age, writers, readers, type, memory; see 'dssmctl ls --help'\n"},
      {{"create", "s", "--size", "0", "--depth", "2"},
       "dssmctl: create: --size: '0' is not a whole number from 1 to 67108864; see 'dssmctl create "
       "--help'\n"},
  };
  for (const auto& test : cases) EXPECT_EQ(error_of(test.words), test.error);
}

TEST(CommandLine, NamesTheVerbForTheCommandsOfRos2AndForTypingErrors) {
  const struct {
    std::vector<const char*> words;
    const char* meant;
  } cases[] = {
      {{"topic"}, "ls"},
      {{"topic", "list"}, "ls"},
      {{"topic", "echo", "odom"}, "echo"},
      {{"topic", "info", "odom"}, "info"},
      {{"topic", "type", "odom"}, "info"},
      {{"topic", "find", "Odom"}, "find"},
      {{"topic", "hz", "odom"}, "hz"},
      {{"topic", "bw", "odom"}, "bw"},
      {{"topic", "delay", "odom"}, "delay"},
      {{"topic", "pub", "odom"}, "pub"},
      {{"topic", "ehco", "odom"}, "echo"},
      {{"topic", "xyzzy"}, "ls"},
      {{"--json", "topic", "hz", "odom"}, "hz"},
      {{"type", "odom"}, "info"},
      {{"node", "list"}, "nodes"},
      {{"node", "info", "mapper"}, "nodes"},
      {{"interface", "show", "Odom"}, "show"},
      {{"interface", "list"}, "find"},
      {{"param", "get", "odom"}, "property"},
      {{"bag", "record"}, "record"},
      {{"bag", "info", "a.mcap"}, "info FILE"},
      {{"bag", "play", "a.mcap"}, "play"},
      {{"bag"}, "record"},
      {{"rec"}, "record"},
      {{"ehco", "odom"}, "echo"},
      {{"dealy", "odom"}, "delay"},
      {{"hosst"}, "hosts"},
      {{"pbu", "odom"}, "pub"},
  };
  for (const auto& test : cases) {
    const std::string error = error_of(test.words);
    EXPECT_NE(error.find("(did you mean '" + std::string(test.meant) + "'?)"), std::string::npos)
        << error;
  }
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
      {"clock", "--matrix", "--table", "2"},
      {"clock", "--matrix", "--wait", "1"},
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
  EXPECT_EQ(parse({"help"}).text, parse({"--help"}).text);
  EXPECT_EQ(parse({"help", "echo"}).text, parse({"echo", "--help"}).text);
  for (const char* verb : {"ls", "echo", "clock", "create"}) {
    const std::string help = parse({verb, "--help"}).text;
    EXPECT_EQ(help.find("Excludes"), std::string::npos) << help;
    EXPECT_NE(help.find("show this help and end"), std::string::npos) << help;
  }
  EXPECT_EQ(parse({"--version"}).text, "dssmctl " DSSM_VERSION "\n");
}

TEST(CommandLine, TakesWhatABlackBoxNeeds) {
  const RecordOptions options =
      options_of<RecordOptions>({"record", "--black-box", "--trigger", "a.b > 1", "--trigger",
                                 "stalled", "--before", "1min", "--quota", "20GiB", "lidar"});
  EXPECT_EQ(options.triggers, (std::vector<std::string>{"a.b > 1", "stalled"}));
  EXPECT_EQ(options.patterns, std::vector<std::string>{"lidar"});
  EXPECT_EQ(options.before, 1min);
  EXPECT_EQ(options.after, 10s);
  EXPECT_EQ(options.quota_bytes, 20ULL << 30);
  for (const std::vector<const char*>& words :
       {std::vector{"record", "--trigger", "stalled"},
        {"record", "--black-box", "--trigger", "stalls"},
        {"record", "--black-box", "--past", "1s"},
        {"record", "--black-box", "--max-total-size", "1GiB"},
        {"record", "--quota", "1MiB", "--max-file-size", "1MiB"},
        {"record", "--before", "3s"},
        {"record", "--max-incident", "1min"},
        {"record", ""},
        {"record", "-o", ""},
        {"play", "a.mcap", "--lockstep", "x", "--start-paused"},
        {"record", "--config", "/does/not/exist"},
        {"record", "--config"},
        {"trigger"},
        {"trigger", ""}}) {
    EXPECT_NE(error_of(words), "") << words[1];
  }
  EXPECT_EQ(error_of({"trigger", std::string(64, 'a').c_str()}),
            "dssmctl: trigger: NAME has 1 to 63 bytes; see 'dssmctl trigger --help'\n");
}

TEST(CommandLine, OfRecordingsTellsFilesFromPatterns) {
  const auto play = options_of<PlayOptions>({"play", "a.log", "odo*", "b.mcap", "./c", "scan"});
  EXPECT_EQ(play.file, "a.log");
  EXPECT_EQ(play.more_files, (std::vector<std::string>{"b.mcap", "./c"}));
  EXPECT_EQ(play.patterns, (std::vector<std::string>{"odo*", "scan"}));

  const auto convert =
      options_of<ConvertOptions>({"convert", "a.log", "b.log", "--stream", "x", "out.mcap"});
  EXPECT_EQ(convert.file, "a.log");
  EXPECT_EQ(convert.more_files, std::vector<std::string>{"b.log"});
  EXPECT_EQ(convert.out, "out.mcap");
  EXPECT_NE(error_of({"convert", "a.log", "b.txt"}).find("b.txt"), std::string::npos);
}

TEST(CommandLine, OfDescribeTakesAFileOnlyForOneStream) {
  EXPECT_EQ(options_of<DescribeOptions>({"describe"}).stream, "");
  const auto one = options_of<DescribeOptions>({"describe", "odo", "--from", "a", "--type", "B"});
  EXPECT_EQ(one.from, "a");
  EXPECT_EQ(one.type, "B");
  EXPECT_NE(error_of({"describe", "--from", "a"}).find("--from"), std::string::npos);
}

}  // namespace
}  // namespace dssm::ctl
