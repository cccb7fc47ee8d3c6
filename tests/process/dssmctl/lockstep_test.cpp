// SPDX-License-Identifier: Apache-2.0
//
// dssmctl play --lockstep, with programs that wait in all ways in which programs may wait.
#include <signal.h>

#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <sstream>

#include "tests/process/dssmctl/ctl_test.hpp"
#include "tests/process/dssmctl/lockstep_sample.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

std::string program(const std::string& way) {
  return "exec " + built("tests/process/dssmctl/lockstep-program") + " " + way;
}

class Lockstep : public CtlTest {
 protected:
  // Stream "fast" with samples 0 to 999, one each millisecond, and "slow" with 0 to 99, each 10.
  Lockstep() {
    auto writer = RecordingWriter::create(file_).value();
    const TypeInfo type = type_of<Numbered>();
    const std::uint32_t fast =
        writer.add_stream({{"fast", 0, "pc9"}, type, 64, 1ms, 1, {}}).value();
    const std::uint32_t slow =
        writer.add_stream({{"slow", 0, "pc9"}, type, 64, 10ms, 1, {}}).value();
    const auto write = [&](std::uint32_t stream, std::int64_t number, Time time) {
      const Numbered sample{number};
      const SampleInfo info{number, time, Duration::zero(), sizeof sample};
      (void)writer.write(stream, info, 1us, std::as_bytes(std::span(&sample, 1))).value();
    };
    for (std::int64_t i = 0; i < 1000; ++i) {
      write(fast, i, at_ns(kSecond) + i * 1ms);
      if (i % 10 == 9) write(slow, i / 10, at_ns(kSecond) + i * 1ms + 300us);
    }
    (void)writer.finish().value();
  }

  TestFolder folder_;
  std::string file_ = folder_.file("a.mcap");
};

TEST_F(Lockstep, GivesProgramsAllAndInTheSameOrderEachTime) {
  const std::vector<std::string> ways = {"heard", "next",      "any", "callbacks",
                                         "echo",  "hand-over", "ssm"};
  std::vector<std::string> first;
  for (int run = 0; run < 3; ++run) {
    std::vector<std::string> words = {"play", file_};
    for (const std::string& way : ways) {
      words.insert(words.end(), {"--lockstep", program(way) + " > " + folder_.file(way)});
    }
    const Finished played = ctl(words);
    ASSERT_EQ(played.exit_status, 0) << played.err;
    for (const std::string& line : lines_of(played.err)) {  // on a slow machine
      EXPECT_TRUE(line.starts_with("dssmctl: play: waiting until '")) << played.err;
    }
    EXPECT_TRUE(session_.remove({"echo", 0, ""}));
    std::vector<std::string> texts;
    for (const std::string& way : ways) texts.push_back(text_of(folder_.file(way)));
    if (first.empty()) first = texts;
    for (std::size_t i = 0; i < ways.size(); ++i) EXPECT_EQ(texts[i], first[i]) << ways[i];
  }
  const auto lines = [&](std::size_t way) { return lines_of(first[way]); };
  ASSERT_EQ(lines(0).size(), 100U) << first[0];  // heard
  EXPECT_EQ(lines(0)[99], "echo 99 1.999300");
  ASSERT_EQ(lines(1).size(), 1000U) << first[1];  // next: at the time of each
  EXPECT_EQ(lines(1)[0], "fast 0 1.000000");
  EXPECT_EQ(lines(1)[567], "fast 567 1.567000");
  ASSERT_EQ(lines(2).size(), 2 * 99U) << first[2];  // any: the last one comes after its end
  EXPECT_EQ(lines(2)[2], "slow 1 1.019300");
  EXPECT_EQ(lines(2)[3], "before 19 1.019300");
  EXPECT_EQ(lines(3).size(), 1000U + 99) << first[3];  // callbacks
  EXPECT_EQ(lines(3)[10], "slow 0 1.009300");
  EXPECT_EQ(lines(5).size(), 1000U) << first[5];  // hand-over
  EXPECT_EQ(lines(5)[567], "fast 567 1.567000");
  EXPECT_GE(lines(6).size(), 300U) << first[6];  // ssm: at its own pace
  EXPECT_FALSE(session_.stream_info({"fast", 0, ""}).value().writers);
}

TEST_F(Lockstep, SaysWhichStreamsHaveSamplesOfAnEarlierRun) {
  (void)session_.create<Numbered>("echo", depth_of(4)).value().write({1});
  (void)session_.create<Numbered>("fast", depth_of(4)).value().write({1});
  const Finished played = ctl({"play", file_, "fast", "--lockstep", program("wait")});
  EXPECT_EQ(played.exit_status, 0) << played.err;
  EXPECT_TRUE(contains(played.err, "'echo' has samples of an earlier run")) << played.err;
  EXPECT_FALSE(contains(played.err, "'fast'")) << played.err;
}

TEST_F(Lockstep, InterruptsProgramsAtTheEnd) {
  const std::string out = folder_.file("out");
  output(
      {"play", file_, "slow", "--lockstep", program("wait") + " > /dev/null", "--lockstep",
       "trap 'echo ended > " + out + "; exit 0' INT; " + program("heard").substr(5) + " & wait"});
  EXPECT_EQ(text_of(out), "ended\n");
}

TEST_F(Lockstep, EndsWithItsProgramsAndSaysHowMuchIsLeft) {
  const std::string text =
      output({"play", file_, "--lockstep", program("next-100") + " > /dev/null"});
  EXPECT_TRUE(contains(text, ": 111 samples of 2 streams played; ended 899 ms before its end"))
      << text;
  // Also where a shell waits for the program, and for what still works after it.
  const std::string piped = program("next-100").substr(5) +
                            " | { cat > /dev/null; i=0; while [ $i -lt 50000 ]; do "
                            "i=$((i + 1)); done; }";
  const std::string text_of_piped = output({"play", file_, "--lockstep", piped});
  EXPECT_TRUE(contains(text_of_piped, ": 111 samples of 2 streams")) << text_of_piped;
  EXPECT_FALSE(contains(output({"play", file_, "--lockstep", program("wait")}), "before its end"));
  EXPECT_FALSE(
      contains(ctl({"play", file_, "slow", "--lockstep", program("wait")}).out, "before its end"));
  EXPECT_TRUE(contains(output({"play", file_, "--lockstep", "true"}), "; ended 999 ms before"));
}

TEST_F(Lockstep, SaysWhichProgramFailed) {
  const Finished failed =
      ctl({"play", file_, "--lockstep", program("wait"), "--lockstep", "exit 7"});
  EXPECT_EQ(failed.exit_status, 1);
  EXPECT_TRUE(contains(failed.err, "'exit 7' ended with status 7")) << failed.err;
  const Finished killed = ctl({"play", file_, "--lockstep", "kill -SEGV $$"});
  EXPECT_EQ(killed.exit_status, 1);
  EXPECT_TRUE(contains(killed.err, "was ended by signal 11 (Segmentation fault)")) << killed.err;
  EXPECT_EQ(ctl({"play", file_, "--lockstep", "true", "--rate", "2"}).exit_status, 2);
}

TEST_F(Lockstep, WaitsForAProgramThatWaitsForNothingAndSaysSo) {
  Running running(argv({"play", file_, "--lockstep", "exec sleep 1000"}), environment());
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "waiting until 'exec sleep 1000' waits for samples")) << line;
  EXPECT_TRUE(contains(line, "setBlocking(true)")) << line;
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
}

// Programs do not depend on a player that has ended.
TEST_F(Lockstep, OfAPlayerThatWasKilledEnds) {
  const std::string out = folder_.file("out");
  Running running(argv({"play", file_, "slow", "--lockstep", program("wait") + " > " + out,
                        "--lockstep", "exec sleep 30"}),
                  environment());
  await([&] { return session_.list_streams().value().size() == 1; });
  auto fast = session_.create<Numbered>("fast", depth_of(64)).value();
  await([&] { return session_.stream_info(fast.id()).value().readers == 1; });
  const PlaybackClock clock = session_.open_playback_clock().value();
  EXPECT_NE(clock.setting(), PlaybackClock::Setting());
  running.signal(SIGKILL);
  running.status();
  await([&] { return clock.setting() == PlaybackClock::Setting(); });
  fast.write({5}, at_ns(kSecond));
  await([&] { return contains(text_of(out), "fast 5 "); });
  for (const OpenInfo& open : session_.list_opens().value()) {
    if (open.role == Role::reader) ::kill(open.opener_pid, SIGKILL);
  }
}

}  // namespace
}  // namespace dssm::test
