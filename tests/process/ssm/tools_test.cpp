// SPDX-License-Identifier: Apache-2.0
//
// SSM's tools as people and scripts use them, and logs that old programs record and play: what is
// played has the same payloads, times, property, slots and cycle as what was recorded.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cmath>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <limits>
#include <tuple>

#include "tests/process/ssm/run_program.hpp"
#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

std::string ssm_tool(const std::string& name) { return built("client/ssm/" + name); }

std::string script(const std::string& name) {
  return std::string(std::getenv("DSSM_SOURCE_ROOT")) + "/client/ssm/tools/" + name;
}

// A sample of the programs old_logger and old_player, with its time.
struct Odometry {
  std::int64_t time_ns = 0;
  std::array<double, 5> values{};
  bool operator==(const Odometry&) const = default;
};
std::ostream& operator<<(std::ostream& out, const Odometry& sample) {
  return out << sample.time_ns << ": " << sample.values[0];
}

const StreamId kOdometry{"spur_odometry", 3, {}};
constexpr std::array<double, 3> kWheels{0.05, 0.051, 0.3};
constexpr std::uint64_t kSlots = 49;

void write(RawWriter& writer, const Odometry& sample) {
  writer.write(std::as_bytes(std::span(sample.values)), time_from_ns(sample.time_ns));
}

struct SsmTools : testing::Test {
  DaemonProcess daemon{{"--log-level", "warning"}};
  Session session = connect(daemon);
  const std::string folder = make_temp_dir();
  const std::string log = folder + "/odometry.log";

  ~SsmTools() override { remove_tree(folder); }

  Finished run_tool(const std::string& name, std::vector<std::string> words = {}) const {
    words.insert(words.begin(), ssm_tool(name));
    return run(words, {daemon.environment()});
  }

  RawWriter create_odometry() {
    RawWriter writer =
        session
            .create_raw(kOdometry, {"", 40, 1, {}}, History{kSlots, std::chrono::milliseconds(50)})
            .value();
    EXPECT_TRUE(writer.set_property(std::as_bytes(std::span(kWheels))));
    return writer;
  }

  // What is in the stream, in the order of writing.
  static std::vector<Odometry> all_samples(Session& session) {
    RawReader reader = session.open_raw_reader(kOdometry).value();
    std::vector<Odometry> samples;
    for (Tid tid = reader.oldest_tid(); tid >= 0 && tid <= reader.newest_tid(); ++tid) {
      Odometry sample;
      SampleInfo info;
      EXPECT_EQ(reader.read_tid(tid, std::as_writable_bytes(std::span(sample.values)), info),
                ReadStatus::ok);
      sample.time_ns = to_ns(info.time);
      samples.push_back(sample);
    }
    return samples;
  }

  // A log that begins at second 1000, with samples at these seconds.
  void save_log(const std::vector<double>& times) const {
    std::ofstream out(log, std::ios::binary);
    out << "spur_odometry 3 40 49 0.050000 1000.000000 0\n";
    for (const double time : times) {
      const std::array<double, 5> values{time};
      out.write(reinterpret_cast<const char*>(&time), sizeof time);
      out.write(reinterpret_cast<const char*>(values.data()), sizeof values);
    }
  }

  // Plays that log; the times that were written.
  std::vector<double> play(std::vector<std::string> options, int expected_status = 0) {
    options.push_back(log);
    const Finished finished = run_tool("ssm-player", options);
    EXPECT_EQ(finished.exit_status, expected_status) << finished.out << finished.err;
    return played_times();
  }
  std::vector<double> played_times() {
    std::vector<double> times;
    for (const Odometry& sample : all_samples(session)) {
      times.push_back(static_cast<double>(sample.time_ns) / 1e9);
      EXPECT_EQ(sample.values[0], times.back());
    }
    return times;
  }

  // Of the shared clock, as ssm-date -A -q prints it.
  bool clock_is_reset() const {
    const Finished finished = run_tool("ssm-date", {"-q", "-x", "-p", "-r"});
    const double off = std::fabs(std::stod(run_tool("ssm-date", {"-q", "-t"}).out) -
                                 std::stod(run_tool("ssm-date", {"-q", "-U"}).out));
    return finished.out == "1.000000\n0\n0\n" && off < 3600;
  }
};

// --- logs

class SsmLogs : public SsmTools,
                public testing::WithParamInterface<std::tuple<std::string, std::string>> {
 protected:
  // Records the samples with one of the two loggers.
  void record(RawWriter& writer, const std::vector<Odometry>& samples) {
    const bool is_old = std::get<0>(GetParam()) == "old_logger";
    PipedProgram logger(is_old ? std::vector<std::string>{built("tests/process/ssm/"
                                                                "old_logger-gnu++98"),
                                                          log}
                               : std::vector<std::string>{ssm_tool("ssm-logger"), "-l", log, "-n",
                                                          "spur_odometry", "-i", "3"},
                        daemon.environment());
    EXPECT_EQ(logger.line(), is_old ? "start" : "open stream 'spur_odometry' [3].");
    await([&] { return std::filesystem::exists(log); });  // it has its place in the stream
    for (std::size_t i = 0; i < samples.size(); ++i) {
      write(writer, samples[i]);
      // The first one is the newest one that an old program takes, so it has to be alone.
      if (is_old) {
        EXPECT_EQ(logger.line(), std::to_string(i));
      }
    }
    ::kill(logger.pid(), SIGINT);
    std::string rest;
    EXPECT_EQ(logger.end(rest), 0) << rest;
    if (!is_old) {
      EXPECT_EQ(rest, std::to_string(samples.size()) + " samples recorded.\n");
    }
  }
};

TEST_P(SsmLogs, PlayBackAsTheyWereRecorded) {
  RawWriter writer = create_odometry();
  std::vector<Odometry> samples;
  // Multiples of 1/128 s are the same number as double and in nanoseconds.
  constexpr std::int64_t kSecond = 1'000'000'000;
  const std::int64_t start_ns = to_ns(WallClock::now()) / kSecond * kSecond + kSecond;
  for (int i = 0; i < 40; ++i) {
    samples.push_back({start_ns + i * (kSecond / 128), {1.0 * i, 0.1, -0.0, 1e300, 1.0 / 3}});
  }
  std::swap(samples[20].time_ns, samples[21].time_ns);  // times may fall
  record(writer, samples);

  const DaemonProcess other({"--log-level", "warning"});
  const bool is_old = std::get<1>(GetParam()) == "old_player";
  const Finished played =
      run({is_old ? built("tests/process/ssm/old_player-gnu++98") : ssm_tool("ssm-player"), log},
          {other.environment()});
  ASSERT_EQ(played.exit_status, 0) << played.out << played.err;
  EXPECT_NE(played.out.find("end\n"), std::string::npos) << played.out;
  Session replayed = connect(other);
  EXPECT_EQ(all_samples(replayed), samples);
  const StreamInfo info = replayed.stream_info(kOdometry).value();
  EXPECT_EQ(info.depth, kSlots);
  EXPECT_EQ(info.cycle, std::chrono::milliseconds(50));
  const auto property = replayed.property(kOdometry).value();
  ASSERT_EQ(property.size(), sizeof kWheels);
  EXPECT_EQ(std::memcmp(property.data(), kWheels.data(), sizeof kWheels), 0);
}

INSTANTIATE_TEST_SUITE_P(, SsmLogs,
                         testing::Combine(testing::Values("old_logger", "ssm_logger"),
                                          testing::Values("old_player", "ssm_player")),
                         [](const auto& pair) {
                           return std::get<0>(pair.param) + "_to_" + std::get<1>(pair.param);
                         });

struct SsmLogger : SsmTools {
  std::vector<std::string> command() const {
    return {ssm_tool("ssm-logger"), "--log-name",  log, "--stream-name",
            "spur_odometry",        "--stream-id", "3"};
  }

  // How many samples the log has.
  std::uint64_t recorded() const {
    std::ifstream file(log, std::ios::binary);
    std::string head;
    std::getline(file, head);
    const std::uint64_t property = std::stoul(head.substr(head.rfind(' ')));
    return (std::filesystem::file_size(log) - head.size() - 1 - property) / 48;
  }
};

// A slow logger once lost samples without a word in the end.
TEST_F(SsmLogger, CountsWhatItIsTooSlowFor) {
  RawWriter writer = create_odometry();
  PipedProgram logger(command(), daemon.environment(), true);
  await([&] { return std::filesystem::exists(log); });
  ::kill(logger.pid(), SIGSTOP);
  const auto is_stopped = [&] {
    std::ifstream stat("/proc/" + std::to_string(logger.pid()) + "/stat");
    std::string text;
    std::getline(stat, text);
    return text.find(") T ") != std::string::npos;
  };
  await(is_stopped);
  for (int i = 0; i < 500; ++i) write(writer, {1000 + i, {}});
  ::kill(logger.pid(), SIGINT);  // it records what was written before
  ::kill(logger.pid(), SIGCONT);
  std::string text;
  EXPECT_EQ(logger.end(text), 0) << text;
  const std::uint64_t count = recorded();
  EXPECT_GE(count, 1U);
  EXPECT_LT(count, kSlots);
  EXPECT_NE(text.find(std::to_string(count) + " samples recorded."), std::string::npos) << text;
  EXPECT_NE(text.find(std::to_string(500 - count) + " samples are missing"), std::string::npos)
      << text;
}

TEST_F(SsmLogger, WaitsForItsStreamAndEndsCleanlyByTwoSignals) {
  PipedProgram logger(command(), daemon.environment());
  EXPECT_EQ(logger.line(), "open stream 'spur_odometry' [3].");
  RawWriter writer = create_odometry();
  await([&] { return std::filesystem::exists(log); });
  ::kill(logger.pid(), SIGINT);
  ::kill(logger.pid(), SIGINT);
  std::string text;
  EXPECT_EQ(logger.end(text), 0) << text;
  EXPECT_EQ(recorded(), 0U);
}

// Of size 0 is a stream that carries only times; libssm gives it this type.
TEST_F(SsmLogger, RecordsAStreamOfSizeZeroThatThePlayerPlays) {
  const StreamId tick{"tick", 0, {}};
  const std::vector<std::int64_t> times_ns = {1'000'500'000'000, 1'001'000'000'000};
  RawWriter writer =
      session.create_raw(tick, {"ssm.empty", 1, 1, {}}, History{kSlots, 50ms}).value();
  PipedProgram logger({ssm_tool("ssm-logger"), "-l", log, "-n", "tick"}, daemon.environment(),
                      true);
  EXPECT_EQ(logger.line(), "open stream 'tick' [0].");
  await([&] { return std::filesystem::exists(log); });
  for (const std::int64_t time_ns : times_ns) {
    writer.write(std::vector<std::byte>(1), time_from_ns(time_ns));
  }
  ::kill(logger.pid(), SIGINT);
  std::string text;
  EXPECT_EQ(logger.end(text), 0) << text;
  EXPECT_EQ(text, "2 samples recorded.\n");

  const DaemonProcess other({"--log-level", "warning"});
  const Finished played = run({ssm_tool("ssm-player"), "-x", "1000", log}, {other.environment()});
  ASSERT_EQ(played.exit_status, 0) << played.out << played.err;
  Session replayed = connect(other);
  RawReader reader = replayed.open_raw_reader(tick).value();
  EXPECT_EQ(reader.type(), (TypeInfo{"ssm.empty", 1, 1, {}}));
  std::vector<std::int64_t> played_ns;
  for (Tid tid = 0; tid <= reader.newest_tid(); ++tid) {
    std::byte nothing{};
    SampleInfo info;
    EXPECT_EQ(reader.read_tid(tid, std::span(&nothing, 1), info), ReadStatus::ok);
    played_ns.push_back(to_ns(info.time));
  }
  EXPECT_EQ(played_ns, times_ns);
}

TEST_F(SsmLogger, ExitsWith255WhenItCannotRecord) {
  const RawWriter writer = create_odometry();
  const std::vector<std::vector<std::string>> wrong = {
      {},
      {"-l", log},
      {"-n", "spur_odometry"},
      {"-l", log, "-n", "spur_odometry", "-i", "three"},
      {"-l", log, "-n", "spur_odometry", "-i", "-1"},
      {"-l", log, "-n", "spur_odometry", "stray"},
      {"-z"},
      {"-h"},
      {"-l", folder + "/missing/x.log", "-n", "spur_odometry", "-i", "3"}};
  for (const auto& words : wrong) {
    const Finished finished = run_tool("ssm-logger", words);
    EXPECT_EQ(finished.exit_status, 255) << testing::PrintToString(words);
    EXPECT_NE(finished.err, "") << testing::PrintToString(words);
  }
}

// As dssmctl writes streams.
TEST_F(SsmLogger, SaysHowTheNumberOfAStreamIsGiven) {
  for (const char* name : {"spur_odometry:3", "spur_odometry:3@pc1"}) {
    const Finished finished = run_tool("ssm-logger", {"-q", "-l", log, "-n", name});
    EXPECT_EQ(finished.exit_status, 255);
    EXPECT_EQ(finished.err, "ERROR : '" + std::string(name) +
                                "' is not a stream's name, which has no ':' : give the number with "
                                "-i\n");
  }
  // Not a name of a host, so it waits for none.
  const Finished finished = run_tool("ssm-logger", {"-q", "-l", log, "-n", "spur_odometry@"});
  EXPECT_EQ(finished.exit_status, 255);
  EXPECT_NE(finished.err.find("dssmctl ls lists them, and -i gives the number"), std::string::npos)
      << finished.err;
}

// --- the player

struct SsmPlayer : SsmTools {};

TEST_F(SsmPlayer, BeginsAndEndsWhereItIsTold) {
  save_log({1001, 2000, 3000});
  const std::vector<double> middle = {1001, 2000};  // the newest before the start, and what follows
  EXPECT_EQ(play({"-S", "1500", "-E", "2500", "-x", "20000"}), middle);
  ASSERT_TRUE(session.remove(kOdometry));
  EXPECT_EQ(play({"--start-time", "500", "--end-time", "1500", "--speed", "20000"}), middle);
  ASSERT_TRUE(session.remove(kOdometry));
  EXPECT_EQ(play({"-S", "1200", "-s", "300", "-E", "2200", "-e", "300", "-x", "20000"}), middle);
  ASSERT_TRUE(session.remove(kOdometry));
  EXPECT_EQ(play({"-S", "3500", "-x", "-20000"}), (std::vector<double>{3000, 2000, 1001}));
  EXPECT_TRUE(clock_is_reset());
}

TEST_F(SsmPlayer, PlaysSeveralLogsInTheOrderOfTimeAndSkipsWhatIsNone) {
  const std::string second = folder + "/second.log", none = folder + "/none.log";
  save_log({1002, 1004, 1006});
  std::filesystem::rename(log, second);
  std::ofstream(none) << "no log\n";
  save_log({1001, 1003, 1005, 1007});
  // Both are of the same stream, so its samples show the order.
  EXPECT_EQ(play({"-q", "-x", "1000", second, none, folder + "/missing.log"}),
            (std::vector<double>{1001, 1002, 1003, 1004, 1005, 1006, 1007}));
  EXPECT_EQ(run_tool("ssm-player", {none}).exit_status, 1);
  EXPECT_EQ(run_tool("ssm-player", {}).exit_status, 1);
  EXPECT_EQ(run_tool("ssm-player", {"-x", "fast", log}).exit_status, 1);
}

// The clock never came to a record of an infinite time.
TEST_F(SsmPlayer, LeavesRecordsOutWhoseTimeNoSampleCanHave) {
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  save_log({kInfinity, 1001, std::nan(""), 1002, -kInfinity, 1003, -1e300, 1e300});
  const Finished played = run_tool("ssm-player", {"-q", "-x", "1000", log});
  EXPECT_EQ(played.exit_status, 0);
  EXPECT_EQ(played.err, "WARNING : records of '" + log +
                            "' are left out : their times are not between the years 1678 and "
                            "2261\n");
  EXPECT_EQ(played_times(), (std::vector<double>{1001, 1002, 1003}));
  ASSERT_TRUE(session.remove(kOdometry));
  EXPECT_EQ(play({"-S", "1002.5", "-x", "1000"}), (std::vector<double>{1002, 1003}));
  ASSERT_TRUE(session.remove(kOdometry));
  EXPECT_EQ(play({"-S", "1000", "-x", "1000"}), (std::vector<double>{1001, 1002, 1003}));
  ASSERT_TRUE(session.remove(kOdometry));
  EXPECT_EQ(play({"-S", "1003.5", "-x", "-1000"}), (std::vector<double>{1003, 1002, 1001}));
  EXPECT_TRUE(clock_is_reset());
}

TEST_F(SsmPlayer, ObeysCommandsAndNeverLeavesTheClockPaused) {
  save_log({1001, 2000, 3000, 9000});
  PlaybackClock clock = session.open_playback_clock().value();
  PipedProgram player({ssm_tool("ssm-player"), log}, daemon.environment());
  await([&] { return clock.now_s() < 1e6; });
  player.write_line("pause\n");
  await([&] { return clock.setting().paused; });
  player.write_line("seek 1500\n");  // about 2500: the newest record before is written at once
  await([&] { return clock.now_s() > 2400; });
  await([&] { return played_times().size() >= 1 && played_times().back() == 2000; });
  EXPECT_TRUE(clock.setting().paused);
  player.write_line("+\nx 3\n-\nspeed 8\n");
  await([&] { return clock.setting().speed == 8; });
  player.write_line("reverse\n");
  await([&] { return clock.setting().speed == -8; });
  player.write_line("r\n>\n");
  await([&] { return clock.setting().speed == 8; });
  player.write_line("skip 1000\n");  // beyond 3000, which is written on the way
  await([&] { return played_times().back() == 3000; });
  std::string rest;
  ::kill(player.pid(), SIGTERM);
  EXPECT_EQ(player.end(rest), 0);
  for (const char* words : {"ssm time  : ", "log time  : ", "speed rate: ", "finalize log data\n",
                            "ssm time init\n", "end\n"}) {
    EXPECT_NE(rest.find(words), std::string::npos) << words << rest;
  }
  EXPECT_TRUE(clock_is_reset());
}

TEST_F(SsmPlayer, LoopsUntilItIsToldToQuit) {
  save_log({1001, 1002});
  PipedProgram player({ssm_tool("ssm-player"), "-l", "-x", "1000", log}, daemon.environment());
  await([&] { return session.stream_info(kOdometry) && played_times().size() >= 7; });
  player.write_line("quit\n");
  std::string rest;
  EXPECT_EQ(player.end(rest), 0) << rest;
  const std::vector<double> times = played_times();
  for (std::size_t i = 1; i < times.size(); ++i) EXPECT_NE(times[i], times[i - 1]);
}

// The old one made the shell's terminal non-blocking.
TEST_F(SsmPlayer, LeavesTheFlagsOfItsInputAlone) {
  save_log({1001});
  int in[2];
  ASSERT_EQ(::pipe2(in, O_CLOEXEC), 0);
  const int own = ::dup(STDIN_FILENO);
  ::dup2(in[0], STDIN_FILENO);  // the player's is the same open file
  const int flags = ::fcntl(STDIN_FILENO, F_GETFL);
  const pid_t player = start({ssm_tool("ssm-player"), "-q", log}, {daemon.environment()});
  PlaybackClock clock = session.open_playback_clock().value();
  await([&] { return clock.now_s() < 1e6; });
  ASSERT_EQ(::write(in[1], "p\n", 2), 2);
  await([&] { return clock.setting().paused; });
  EXPECT_EQ(::fcntl(STDIN_FILENO, F_GETFL), flags);
  ASSERT_EQ(::write(in[1], "q\n", 2), 2);
  EXPECT_EQ(wait_for(player), 0);
  EXPECT_EQ(::fcntl(STDIN_FILENO, F_GETFL), flags);
  ::dup2(own, STDIN_FILENO);
  for (const int fd : {own, in[0], in[1]}) ::close(fd);
  EXPECT_TRUE(clock_is_reset());
}

// --- what shows

TEST_F(SsmTools, FailWithoutDssmd) {
  for (const char* tool : {"lsssm", "ssm-monitor", "ssm-graph", "ssm-date", "ssm-player"}) {
    save_log({1001});
    std::vector<std::string> words = {ssm_tool(tool)};
    if (std::string(tool) == "ssm-player") words.push_back(log);
    const Finished finished = run(words, {"DSSM_SOCKET=" + folder + "/dssmd.sock"});
    EXPECT_EQ(finished.exit_status, 1) << tool;
    EXPECT_EQ(finished.out, "") << tool;
    EXPECT_NE(finished.err.find("ERROR : cannot init ssm."), std::string::npos) << finished.err;
  }
}

// Without dssmd, which they do not ask then. killssm is tried below, among programs of its own.
TEST_F(SsmTools, PrintTheirUsageAndDoNothingElse) {
  for (const char* name : {"psssm", "topssm"}) {
    std::filesystem::create_symlink(script("psssm"), folder + "/" + name);
  }
  for (const char* option : {"-h", "--help"}) {
    for (const std::string& tool :
         {ssm_tool("lsssm"), ssm_tool("ssm-monitor"), ssm_tool("ssm-graph"), folder + "/psssm",
          folder + "/topssm", script("ssm-transporter")}) {
      const Finished finished = run({tool, option}, {"DSSM_SOCKET=" + folder + "/dssmd.sock"});
      EXPECT_EQ(finished.exit_status, 0) << tool;
      EXPECT_EQ(finished.out.find("usage: " + std::filesystem::path(tool).filename().string()), 0U)
          << finished.out;
      EXPECT_EQ(finished.err, "") << tool;
    }
  }
}

TEST_F(SsmTools, LsssmPrintsTheOldTable) {
  RawWriter one = session.create_raw({"wtest", 2, {}}, {"", 16, 1, {}}, History{49, 50ms}).value();
  ASSERT_TRUE(one.set_property(std::vector<std::byte>(32)));
  const RawWriter two =
      session.create_raw({"a_name_that_is_longer", 0, {}}, {"", 921600, 1, {}}, History{4, 2s})
          .value();
  const Finished finished = run_tool("lsssm");
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  EXPECT_EQ(finished.out,
            "No. |  sensor name   | suid | size[B] |  num  | cycle[s] | property[B] |\n"
            "----+----------------+------+---------+-------+----------+-------------|\n"
            "000 |          wtest |    2 |  16.00  |    49 |    0.050 |      32.00 \n"
            "001 | a_name_that_is |    0 | 900.00k |     4 |    2.000 |       0.00 \n"
            "----+----------------+------+---------+-------+----------+-------------|\n"
            "Total 2 sensors.\n");
}

TEST_F(SsmTools, SsmMonitorCountsWhatIsWritten) {
  RawWriter writer = session.create_raw({"wtest", 2, {}}, {"", 16, 1, {}}, kLong).value();
  PipedProgram monitor({ssm_tool("ssm-monitor")}, daemon.environment());
  const std::string columns = "                            wtest |  2 |";
  while (monitor.line().find(columns + "     0 |          -1 |    0.000 ") == std::string::npos) {
  }
  const std::array<std::byte, 16> sample{};
  for (int i = 0; i < 20; ++i) writer.write(sample);
  // All in one round, or in two when a round ends meanwhile.
  for (int count = 0; count < 20;) {
    const std::string line = monitor.line();
    const std::size_t at = line.find(columns);
    if (at != std::string::npos) count += std::stoi(line.substr(at + columns.size()));
  }
  EXPECT_NE((monitor.line(), monitor.line(), monitor.line()).find("ssm total wrote size : "),
            std::string::npos);
  ::kill(monitor.pid(), SIGINT);
  std::string rest;
  EXPECT_EQ(monitor.end(rest), 0);
}

TEST_F(SsmTools, SsmGraphPrintsProcessesAndStreams) {
  const RawWriter writer = session.create_raw({"wtest", 2, {}}, {"", 16, 1, {}}, kShort).value();
  const RawReader reader = session.open_raw_reader({"wtest", 2, {}}).value();
  std::ifstream command("/proc/self/cmdline");
  std::string program;
  std::getline(command, program, '\0');
  const std::string pid = std::to_string(::getpid());
  const Finished finished = run_tool("ssm-graph");
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  EXPECT_EQ(finished.out,
            "digraph ssm {\n"
            "\tgraph [ rankdir = LR ];\n"
            "\tnode [ shape = box, style = filled ];\n"
            "\t" +
                pid + " [ label = \"" + program +
                "\"];\n"
                "\t" +
                pid + " -> " + pid +
                " [ label = \"wtest[2]\"];\n"
                "}\n");
}

TEST_F(SsmTools, SsmDateActsInTheOrderOfItsOptions) {
  EXPECT_EQ(run_tool("ssm-date", {"-P",          "1",  "-T", "5000.25", "-tp",
                                  "-q",          "-t", "-d", "-p",      "-g",
                                  "--get-pause", "-X", "2",  "-s",      "-x",
                                  "-R",          "1",  "-x", "-r",      "--toggle-reverse",
                                  "-r",          "-I", "-x"})
                .out,
            "SSM TIME   : 5000.250000\n"
            "IS_PAUSE   : PAUSE\n"
            "5000.250000\n" +
                run({"date", "-d", "@5000", "+%Y/%m/%d(%a) %H:%M:%S %Z"}).out +
                "1\n"
                "0\n"
                "2.200000\n"
                "-2.200000\n"
                "1\n"
                "0\n"
                "1.000000\n");
  EXPECT_TRUE(clock_is_reset());
  const Finished all = run_tool("ssm-date");
  EXPECT_EQ(all.exit_status, 0);
  EXPECT_EQ(all.out.substr(0, 13), "SSM DATE   : ");
  EXPECT_NE(all.out.find("\nIS_PAUSE   : PLAY\n"), std::string::npos) << all.out;
  EXPECT_EQ(all.out.find("REAL"), std::string::npos);
  const Finished full = run_tool("ssm-date", {"-A"});
  std::vector<std::size_t> places;
  for (const char* label :
       {"SSM DATE   : ", "\nSSM TIME   : ", "\nREAL DATE  : ", "\nREAL TIME  : ",
        "\nSSM SPEED  : 1.000000", "\nIS_PAUSE   : PLAY", "\nIS_REVERSE : FORWARD"}) {
    places.push_back(full.out.find(label));
  }
  EXPECT_TRUE(std::is_sorted(places.begin(), places.end()) && places.back() < full.out.size())
      << full.out;
  for (const std::vector<std::string>& wrong : std::vector<std::vector<std::string>>{
           {"-h"}, {"-H"}, {"-z"}, {"-T", "noon"}, {"-P", "2"}, {"-X"}, {"stray"}}) {
    EXPECT_EQ(run_tool("ssm-date", wrong).exit_status, 1) << wrong[0];
  }
}

// --- scripts

TEST_F(SsmTools, SsmTransporterSaysWhatTookItsPlace) {
  const Finished finished = run({script("ssm-transporter"), "192.168.0.1"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("dssmctl hosts"), std::string::npos) << finished.err;
}

TEST_F(SsmTools, SsmAdvancePlayerKeepsFileNamesWithBlanks) {
  std::filesystem::create_directory(folder + "/bin");
  std::filesystem::create_symlink(ssm_tool("ssm-player"), folder + "/bin/ssm-player");
  save_log({1001});
  const std::string file = folder + "/a log";
  std::filesystem::rename(log, file);
  const Finished finished = run({"env", "PATH=" + folder + "/bin:" + std::getenv("PATH"),
                                 script("ssm-advance-player"), "-q", file},
                                {daemon.environment()});
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  EXPECT_NE(finished.err.find("renamed to 'ssm-player'"), std::string::npos) << finished.err;
  EXPECT_EQ(played_times(), std::vector<double>{1001});
}

// In a PID namespace of its own: killssm ends whatever it finds.
TEST_F(SsmTools, KillssmEndsProgramsAndTheCoordinatorButNoDssmd) {
  const std::vector<std::string> apart = {"unshare", "--user",       "--map-root-user", "--pid",
                                          "--fork",  "--mount-proc", "--kill-child"};
  std::vector<std::string> words = apart;
  words.push_back("true");
  if (run(words).exit_status != 0) GTEST_SKIP() << "no PID namespaces here";
  for (const char* name : {"/programs", "/daemon", "/coordinator"}) {
    std::filesystem::create_directory(folder + name);
  }
  for (const char* name : {"psssm", "topssm", "killssm"}) {
    std::filesystem::create_symlink(script("psssm"), folder + "/programs/" + name);
  }
  // A dssmd that has libssm.so loaded, which the real one has not.
  std::filesystem::copy(ssm_tool("ssm-monitor"), folder + "/daemon/dssmd");
  std::filesystem::copy(ssm_tool("ssm-coordinator"), folder + "/coordinator");
  std::ofstream(folder + "/coordinator/dssmd") << "#!/bin/sh\nexec sleep 1000\n";
  std::filesystem::permissions(folder + "/coordinator/dssmd", std::filesystem::perms::owner_all);
  words = apart;
  const std::string commands = R"sh(
    PATH=$1/programs:$PATH
    "$2" >"$1/monitored" & monitor=$!
    "$1/daemon/dssmd" >/dev/null & dssmd=$!
    DSSM_SOCKET=$1/coordinator/dssmd.sock "$1/coordinator/ssm-coordinator" -q & coordinator=$!
    until psssm | grep -q ssm-monitor && [ -s "$1/monitored" ] &&
        grep -q libssm /proc/$dssmd/maps &&
        [ -n "$(cat /proc/$coordinator/task/$coordinator/children)" ]; do sleep 0.01; done
    psssm | grep -c dssmd
    topssm -b -n 1 -w 200 | grep -c ssm-monitor
    killssm --help | head -n 1
    killssm -l; echo "refused $?"
    psssm | grep -c ssm-monitor
    killssm
    wait $monitor; echo "monitor $?"
    wait $coordinator; echo "coordinator $?"
    kill -0 $dssmd && echo "dssmd runs"
    kill $dssmd
    wait $dssmd
    psssm; echo "psssm $?"
  )sh";
  words.insert(words.end(), {"sh", "-c", commands, "sh", folder, ssm_tool("ssm-monitor")});
  const Finished finished = run(
      words,
      {daemon.environment(), "LD_LIBRARY_PATH=" + built("client/ssm") + ":" + built("client/src")});
  EXPECT_EQ(finished.out,
            "0\n1\nusage: killssm\nrefused 1\n1\nmonitor 0\ncoordinator 0\ndssmd runs\npsssm 1\n")
      << finished.err;
}

}  // namespace
}  // namespace dssm::test
