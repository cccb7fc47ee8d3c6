// SPDX-License-Identifier: Apache-2.0
//
// dssmctl record --black-box, as the service runs it: each of its triggers, the files of incidents,
// and what limits them.
#include <signal.h>
#include <sys/socket.h>
#include <unistd.h>

#include <algorithm>
#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <thread>

#include "client/dssmctl/black_box_streams.hpp"
#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct Power {
  double volts;
  std::int64_t number;
};
DSSM_DESCRIBE(Power, volts, number)

// Samples `first` to `last`, 1 ms apart, the last one at this moment.
void write_power(Writer<Power>& writer, std::int64_t first, std::int64_t last) {
  const Time now = WallClock::now();
  for (std::int64_t i = first; i <= last; ++i) writer.write({24, i}, now - (last - i) * 1ms);
}

// The numbers that a recording has of the stream, in order.
std::vector<std::int64_t> numbers_in(const std::string& path, const std::string& stream = "power") {
  std::vector<std::int64_t> numbers;
  const Recording recording = Recording::open(path).value();
  auto reader = recording.open_reader<Power>(stream).value();
  while (const auto sample = reader.read_next()) numbers.push_back(sample->value.number);
  return numbers;
}

std::vector<std::int64_t> range(std::int64_t first, std::int64_t last) {
  std::vector<std::int64_t> numbers;
  for (std::int64_t i = first; i <= last; ++i) numbers.push_back(i);
  return numbers;
}

// The file in "... records 'FILE'" and in "'FILE' continues".
std::string quoted_file(const std::string& line) {
  const std::size_t begin = line.rfind(" '/");
  EXPECT_NE(begin, line.npos) << line;
  return begin == line.npos ? "" : line.substr(begin + 2, line.find('\'', begin + 2) - begin - 2);
}

template <class Base>
class BlackBoxOn : public Base {
 protected:
  // The recorder's words, of which these are the first.
  std::vector<std::string> recorder(std::vector<std::string> words) {
    words.insert(words.begin(), {"record", "--black-box", "-o", folder_.path()});
    return this->argv(std::move(words));
  }
  // Until the recorder on the host of `session` has the stream open, and waits for requests.
  void await_armed(Session& session, const StreamId& id) {
    await([&] {
      const Result<StreamInfo> requests = session.stream_info({"dssm_trigger", 0, ""});
      return requests && requests->readers > 0 && session.stream_info(id).value().readers > 0;
    });
  }
  void await_armed(const StreamId& id) { await_armed(this->session_, id); }

  TestFolder folder_;
};
using BlackBox = BlackBoxOn<CtlTest>;
using BlackBoxInAFleet = BlackBoxOn<FleetTest>;

TEST_F(BlackBox, KeepsWhatWasBeforeAndAfterARequest) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  power.write({24, -1}, WallClock::now() - 100s);
  write_power(power, 0, 49);
  ASSERT_TRUE(power.set_property(std::vector{std::byte{1}}));
  Running running(recorder({"--before", "50s", "--after", "1h"}), environment());
  await_armed(power.id());
  const auto write_now = [&](std::int64_t first, std::int64_t last) {
    for (std::int64_t i = first; i <= last; ++i) power.write({24, i});
  };
  write_now(50, 59);
  ASSERT_TRUE(power.set_property(std::vector{std::byte{2}}));
  write_now(60, 99);
  const Time before = WallClock::now();
  EXPECT_TRUE(contains(output({"trigger", "hard stop/1", "--reason", "a person said so"}),
                       "hard stop/1: requested of pc1"));
  const std::string begun = running.line();
  EXPECT_TRUE(contains(begun, "trigger 'hard stop/1' of host 'pc1': a person said so; records '"))
      << begun;
  const std::string file = quoted_file(begun);
  EXPECT_TRUE(contains(file, "/incident_20") && file.ends_with("_hard_stop_1.mcap")) << file;
  write_now(100, 199);
  running.signal(SIGTERM);  // ends the incident, too
  const std::string ended = running.line();
  EXPECT_TRUE(ended.starts_with(file + ": 201 samples of 2 streams, ")) << ended;
  EXPECT_EQ(numbers_in(file), range(0, 199));
  // Other programs get to know of it.
  auto incidents = session_.await_reader<ctl::RecordedIncident>("dssm_incident").value();
  await([&] { return incidents.read_newest().status() == ReadStatus::ok; });
  const ctl::RecordedIncident incident = incidents.read_newest()->value;
  EXPECT_STREQ(incident.trigger, "hard stop/1");
  EXPECT_STREQ(incident.host, "pc1");
  EXPECT_STREQ(incident.reason, "a person said so");
  EXPECT_EQ(incident.file, file);
  EXPECT_EQ(incident.samples, 201U);
  // Its stream has no writer now, as it should be.
  EXPECT_TRUE(contains(output({"metrics"}),
                       "dssm_stream_stalled{stream=\"dssm_incident\",id=\"0\",host=\"pc1\"} 0\n"));

  const Recording recording = Recording::open(file).value();
  auto reader = recording.open_reader<Power>("power").value();
  while (const auto sample = reader.read_next()) {
    EXPECT_EQ(reader.property().value(), std::vector{std::byte(sample->value.number < 60 ? 1 : 2)})
        << sample->value.number;
  }
  ASSERT_EQ(recording.triggers().size(), 1U);
  const RecordedTrigger& trigger = recording.triggers().front();
  EXPECT_EQ(trigger.name, "hard stop/1");
  EXPECT_EQ(trigger.reason, "a person said so");
  EXPECT_EQ(trigger.host, "pc1");
  EXPECT_GE(trigger.time, before);
  EXPECT_LE(trigger.time, WallClock::now());
  EXPECT_TRUE(contains(output({"info", file}), "host pc1: a person said so"));
  EXPECT_EQ(json({"info", file})["triggers"][0]["name"], "hard stop/1");
  EXPECT_EQ(running.status(), 0);
}

// A host's clock may be behind; and a recorder that was here before leaves its requests.
TEST_F(BlackBox, TellsRequestsThatWereBeforeItByTheirNumbersNotTheirTimes) {
  auto power = session_.create<Power>("power", depth_of(8)).value();
  auto requests =
      session_.create<ctl::TriggerRequest>("dssm_trigger", History{64, std::chrono::seconds(1)})
          .value();
  ctl::TriggerRequest request{};
  ctl::set_text(request.name, "earlier");
  requests.write(request, WallClock::now() + 1h);
  Running running(recorder({"--after", "1ms"}), environment());
  // It records the stream of the requests, and waits for requests: two readers.
  await([&] { return session_.stream_info(requests.id()).value().readers == 2; });
  request = {};
  ctl::set_text(request.name, "behind");
  requests.write(request, WallClock::now() - 1h);
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "trigger 'behind' of host ''; records '")) << line;
}

TEST_F(BlackBox, IsProlongedByATriggerAndHasNoSampleTwice) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  Running running(recorder({"--after", "10s"}), environment());
  await_armed(power.id());
  write_power(power, 0, 9);
  output({"trigger", "one"});
  const std::string file = quoted_file(running.line());
  output({"trigger", "one"});  // within --min-interval
  // A second later: chunks are written when they are so old.
  await([&] {
    const Result<Recording> recording = Recording::open(file);
    return recording && !recording->streams().empty();
  });
  const MonoTime second = MonoClock::now();
  output({"trigger", "two"});
  const std::string continues = running.line();
  EXPECT_TRUE(contains(continues, "trigger 'two' of host 'pc1'; '" + file + "' continues"))
      << continues;
  write_power(power, 10, 19);
  EXPECT_TRUE(running.line().starts_with(file));
  EXPECT_GE(MonoClock::now() - second, 10s);
  EXPECT_EQ(Recording::open(file).value().triggers().size(), 2U);

  write_power(power, 20, 29);
  output({"trigger", "three"});
  const std::string next = quoted_file(running.line());
  EXPECT_NE(next, file);
  running.signal(SIGTERM);  // ends the incident, too
  EXPECT_EQ(running.status(), 0);
  EXPECT_EQ(numbers_in(next), range(20, 29));
  EXPECT_EQ(numbers_in(folder_.path()), range(0, 29));
}

TEST_F(BlackBox, EndsAnIncidentThatTriggersWouldProlongForEver) {
  auto power = session_.create<Power>("power", depth_of(64)).value();
  Running running(recorder({"--after", "1s", "--max-incident", "1s", "--min-interval", "0"}),
                  environment());
  await_armed(power.id());
  output({"trigger", "a"});
  const std::string file = quoted_file(running.line());
  while (!running.line([&] { output({"trigger", "a"}); }).starts_with(file)) {
  }
}

TEST_F(BlackBox, IsTriggeredByAFieldOverItsLimit) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  auto other = session_.create<Power>("other", depth_of(4096)).value();
  Running running(recorder({"--after", "100ms", "--trigger", "low: p*.volts < 21.5"}),
                  environment());
  await([&] { return session_.stream_info(power.id()).value().readers == 2; });
  other.write({20, 0});
  power.write({21.5, 0});
  const Time time = WallClock::now();
  power.write({21.25, 1}, time);
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "trigger 'low' of host 'pc1': volts of 'power:0@pc1' is 21.25; "))
      << line;
  const std::string file = quoted_file(line);
  EXPECT_TRUE(running.line().starts_with(file));
  EXPECT_EQ(numbers_in(file), range(0, 1));
  EXPECT_EQ(Recording::open(file).value().triggers().front().time, time);
}

TEST_F(BlackBox, NamesATriggerWhoseFieldIsNotThere) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  Running running(
      recorder({"--trigger", "power.volts < 21.5", "--trigger", "hot: power.celsius > 90"}),
      environment());
  const std::string line = running.line();
  EXPECT_TRUE(contains(line,
                       "no trigger 'hot' on 'power:0@pc1': it has no such field; there are "
                       "volts, "))
      << line;
}

TEST_F(BlackBox, IsTriggeredByAFieldThatIsDescribedLater) {
  const TypeInfo unnamed{"", sizeof(Power), alignof(Power), {}};
  RawWriter power = session_.create_raw({"power", 0, ""}, unnamed, depth_of(4096)).value();
  Running running(recorder({"--after", "100ms", "--trigger", "low: power.volts < 21.5"}),
                  environment());
  EXPECT_TRUE(contains(
      running.line(), "no trigger 'low' on 'power:0@pc1': it is not described; `dssmctl describe"));
  ASSERT_TRUE(session_.describe(power.id(), type_of<Power>()));
  await([&] { return session_.stream_info(power.id()).value().readers == 2; });
  const Power low{21.25, 0};
  power.write(std::as_bytes(std::span(&low, 1)));
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "volts of 'power:0@pc1' is 21.25; ")) << line;
  // What was opened without fields has them in the next file.
  const std::string file = quoted_file(line);
  EXPECT_TRUE(running.line().starts_with(file));
  const Recording recording = Recording::open(file).value();
  EXPECT_EQ(recording.open_reader<Power>("power").value().type(), type_of<Power>());
}

TEST_F(BlackBox, IsTriggeredByAStreamThatStalls) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  Running running(recorder({"--after", "1ms", "--trigger", "stalled power"}), environment());
  await_armed(power.id());
  // Live for a while, so that the recorder sees it, and then not; until it has noticed.
  MonoTime phase_end = deadline_in(3s), next{};
  bool is_live = true;
  const std::string line = running.line([&] {
    const MonoTime now = MonoClock::now();
    if (now >= phase_end) {
      is_live = !is_live;
      phase_end = now + 3s;
    }
    if (!is_live || now < next) return;
    next = now + 10ms;
    power.write({24, 0});
  });
  EXPECT_TRUE(contains(line, "trigger 'stalled' of host 'pc1': 'power:0@pc1' is stalled: no "))
      << line;
}

TEST_F(BlackBox, IsTriggeredByAProgramThatEndsWithoutClosing) {
  const auto power = session_.create<Power>("power", depth_of(64)).value();
  Running running(recorder({"--after", "1ms", "--trigger", "crash: crashed"}), environment());
  await_armed(power.id());
  {
    Running closes(argv({"pub", "power", "volts=1", "--rate", "100"}), environment());
    await([&] { return power.newest_tid() > 0; });
    closes.signal(SIGINT);
    EXPECT_EQ(closes.status(), 0);
  }
  await([&] { return session_.stream_info(power.id()).value().writers == 1; });
  EXPECT_EQ(session_.stream_info(power.id()).value().crashed_writers, 0U);
  Running crashes(argv({"pub", "power", "volts=1", "--rate", "100"}), environment());
  await([&] { return session_.stream_info(power.id()).value().writers == 2; });
  crashes.signal(SIGKILL);
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "trigger 'crash' of host 'pc1': dssmctl pub (pid ")) << line;
  EXPECT_TRUE(contains(line, ") ended without closing 'power:0@pc1'; records '")) << line;
  EXPECT_TRUE(contains(output({"info", "power"}), "1 writer ended without closing it"));
  EXPECT_EQ(json({"info", "power"})["crashed_writers"], 1);
}

TEST_F(BlackBox, IsTriggeredByAReaderThatEndsWithoutClosing) {
  const auto power = session_.create<Power>("power", depth_of(64)).value();
  Running running(recorder({"--after", "1ms", "--trigger", "crash: crashed"}), environment());
  await_armed(power.id());
  const auto readers = [&] { return session_.stream_info(power.id()).value().readers; };
  Running closes(argv({"echo", "power"}), environment());
  await([&] { return readers() == 2; });
  closes.signal(SIGINT);
  EXPECT_EQ(closes.status(), 0);
  await([&] { return readers() == 1; });
  EXPECT_EQ(session_.stream_info(power.id()).value().crashed_readers, 0U);
  Running crashes(argv({"echo", "power"}), environment());
  await([&] { return readers() == 2; });
  crashes.signal(SIGKILL);
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "trigger 'crash' of host 'pc1': dssmctl echo (pid ")) << line;
  EXPECT_TRUE(contains(output({"info", "power"}), "1 reader ended without closing it"));
  EXPECT_EQ(json({"info", "power"})["crashed_readers"], 1);
}

// dssmd of this test follows a chronyd of its own, without sources, which leaves the clock alone.
class BlackBoxWithClock : public testing::Test {
 protected:
  void SetUp() override {
    if (::access("/usr/sbin/chronyd", X_OK) != 0) GTEST_SKIP() << "install the package chrony";
    if (::geteuid() != 0) GTEST_SKIP() << "chronyd runs as root only";
  }
};

TEST_F(BlackBoxWithClock, IsTriggeredByAClockOutOfBounds) {
  TestFolder folder;
  std::filesystem::permissions(folder.path(), std::filesystem::perms::owner_all);
  const std::string port = std::to_string(free_port(SOCK_DGRAM));
  std::ofstream(folder.file("chrony.conf"))
      << "bindcmdaddress 127.0.0.1\nport 0\nlocal stratum 1\ncmdport " << port << "\npidfile "
      << folder.file("chronyd.pid") << "\n";
  pid_t chronyd = -1;
  const auto start_chronyd = [&] {
    std::filesystem::remove(folder.file("chronyd.pid"));
    chronyd = start({"/usr/sbin/chronyd", "-x", "-d", "-L", "1", "-u", "root", "-f",
                     folder.file("chrony.conf")});
  };
  const auto kill_chronyd = [&] {
    ::kill(chronyd, SIGKILL);
    wait_for(std::exchange(chronyd, -1));
  };
  start_chronyd();
  DaemonProcess daemon({"--chronyd", "127.0.0.1:" + port});
  Session session = session_with(daemon);
  const auto clock = [&] { return session.list_hosts().value().at(0).clock; };
  await([&] { return clock() && clock()->status == ClockStatus::synchronized; });
  Running running({dssmctl_path(), "record", "--black-box", "-o", folder.path(), "--after", "1ms",
                   "--trigger", "clock pc*"},
                  {daemon.environment()});
  // Good for a while, so that the recorder sees it, and then not; until it has noticed.
  MonoTime phase_end = deadline_in(3s);
  const std::string line = running.line([&] {
    if (MonoClock::now() < phase_end) return;
    phase_end = deadline_in(3s);
    if (chronyd >= 0) return kill_chronyd();
    start_chronyd();
  });
  if (chronyd >= 0) kill_chronyd();
  EXPECT_TRUE(
      contains(line, "trigger 'clock' of host 'pc1': the clock of host 'pc1' is not good: "))
      << line;
}

TEST_F(BlackBox, CompletesTheFileOfARecorderThatWasKilled) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  std::string file;
  {
    Running running(recorder({"--after", "1h"}), environment());
    await_armed(power.id());
    write_power(power, 0, 99);
    output({"trigger", "a"});
    file = quoted_file(running.line());
    write_power(power, 100, 199);
    await([&] {
      const Result<Recording> recording = Recording::open(file);
      return recording && std::ranges::any_of(recording->streams(), [](const auto& stream) {
               return stream.id.name == "power" && stream.samples == 200;
             });
    });
    running.signal(SIGKILL);
    running.status();
  }
  EXPECT_EQ(Recording::open(file).value().triggers().size(), 1U);
  EXPECT_FALSE(Recording::open(file).value().warnings().empty());
  Running again(recorder({}), environment());
  EXPECT_TRUE(contains(again.line(), "'" + file + "' was not finished, and is completed"));
  EXPECT_EQ(Recording::open(file).value().warnings(), std::vector<std::string>());
  EXPECT_EQ(numbers_in(file), range(0, 199));
}

TEST_F(BlackBox, WaitsForTheNextTriggerWhenTheDiskIsFull) {
  auto power = session_.create<Power>("power", depth_of(100'000)).value();
  std::vector<std::string> words = recorder({"--after", "1h", "--compression", "none"});
  // No file may become longer, which is as a full disk is.
  words.insert(words.begin(), {"env", "--ignore-signal=XFSZ", "prlimit", "--fsize=300000"});
  Running running(words, environment());
  await_armed(power.id());
  write_power(power, 0, 5'999);  // what is left of these fits into the next file
  output({"trigger", "large"});
  const std::string file = quoted_file(running.line());
  const std::string failed = running.line([&] { power.write({24, -1}); });
  EXPECT_TRUE(contains(failed, "File too large; nothing more is recorded")) << failed;
  EXPECT_TRUE(running.line().starts_with(file));
  EXPECT_TRUE(Recording::open(file).value().warnings().empty()) << "a whole file";

  write_power(power, 20'000, 20'009);
  output({"trigger", "small"});
  const std::string next = quoted_file(running.line());
  running.signal(SIGTERM);
  const std::string ended = running.line();
  EXPECT_TRUE(ended.starts_with(next)) << ended;
  const std::vector<std::int64_t> numbers = numbers_in(next);
  ASSERT_GE(numbers.size(), 10U);
  EXPECT_EQ(std::vector(numbers.end() - 10, numbers.end()), range(20'000, 20'009));
}

TEST_F(BlackBox, StaysWhileDssmdIsRestarted) {
  auto power = session_.create<Power>("power", depth_of(4096)).value();
  Running running(recorder({"--after", "1ms"}), environment());
  await_armed(power.id());
  write_power(power, 0, 9);
  daemon_.kill_hard();
  daemon_.start();
  await_armed(power.id());
  output({"trigger", "a"});
  const std::string file = quoted_file(running.line());
  EXPECT_TRUE(running.line().starts_with(file));
  EXPECT_EQ(numbers_in(file), range(0, 9));
}

TEST_F(BlackBox, ClosesStreamsThatAreRemovedButNotTheOneOfRequests) {
  auto power = std::optional(session_.create<Power>("power", depth_of(64)).value());
  Running running(recorder({"--before", "0", "--after", "1ms"}), environment());
  await_armed(power->id());
  // Two: it also records them. It would say so if they were removed before it had them open.
  await([&] { return session_.stream_info({"dssm_trigger", 0, ""}).value().readers == 2; });
  const StreamId id = power->id();
  power.reset();
  ASSERT_TRUE(session_.remove(id));
  await([&] {
    const std::vector<OpenInfo> opens = session_.list_opens().value();
    return std::ranges::none_of(opens, [&](const OpenInfo& open) { return open.stream == id; });
  });
  power = session_.create<Power>("power", depth_of(64)).value();
  ASSERT_TRUE(session_.remove({"dssm_trigger", 0, ""}));
  await_armed(id);
  output({"trigger", "a"});
  const std::string begun = running.line();
  EXPECT_TRUE(begun.ends_with("_a.mcap'")) << begun;
}

TEST_F(BlackBox, KeepsTheQuotaOverRestartsAndLeavesOtherFilesAlone) {
  auto power = std::optional(session_.create<Power>("power", depth_of(20'000)).value());
  std::ofstream(folder_.file("mine.mcap")) << std::string(100'000, 'x');
  constexpr std::uintmax_t kQuota = 1'000'000;
  std::vector<std::string> files, deleted;
  for (int i = 0; i < 6; ++i) {  // each more than a fifth of the quota
    Running running(recorder({"--after", "1ms", "--compression", "none", "--quota", "1000000"}),
                    environment());
    await_armed(power->id());
    write_power(*power, i * 5'000, i * 5'000 + 4'999);
    output({"trigger", "number_" + std::to_string(i)});
    const auto next_line = [&] {
      std::string line;
      while ((line = running.line()).ends_with(" is deleted, because of --quota")) {
        deleted.push_back(quoted_file(line));
      }
      return line;
    };
    files.push_back(quoted_file(next_line()));
    EXPECT_TRUE(next_line().starts_with(files.back()));
    running.signal(SIGTERM);
    EXPECT_EQ(running.status(), 0);
    ASSERT_TRUE(session_.remove(power->id()));  // what it has is in a file
    power = session_.create<Power>("power", depth_of(20'000)).value();
  }
  // The last one was written after the last check.
  Running running(recorder({"--quota", "1000000"}), environment());
  await_armed(power->id());
  std::uintmax_t total = 0;
  for (const auto& entry : std::filesystem::directory_iterator(folder_.path())) {
    if (entry.path().filename() != "mine.mcap") total += entry.file_size();
  }
  EXPECT_LE(total, kQuota);
  EXPECT_GE(total, kQuota / 4);
  EXPECT_FALSE(std::filesystem::exists(files.front()));
  ASSERT_FALSE(deleted.empty());
  EXPECT_EQ(deleted.front(), files.front());
  EXPECT_TRUE(std::filesystem::exists(files.back()));
  EXPECT_TRUE(std::filesystem::exists(folder_.file("mine.mcap")));
}

TEST_F(BlackBox, SaysWhatIsWrong) {
  const Finished none = ctl({"trigger", "a"});
  EXPECT_EQ(none.exit_status, 1);
  EXPECT_TRUE(contains(none.err, "no host has a black box that waits for triggers")) << none.err;
  const Finished folder = ctl({"record", "--black-box", "-o", folder_.file("no")});
  EXPECT_EQ(folder.exit_status, 1);
  EXPECT_TRUE(contains(folder.err, "mkdir -p '" + folder_.file("no") + "'")) << folder.err;
  std::ofstream(folder_.file("record.conf")) << "black_box = true\nbefor = \"10s\"\n";
  const Finished config = ctl({"record", "--config", folder_.file("record.conf")});
  EXPECT_EQ(config.exit_status, 2);
  EXPECT_TRUE(contains(config.err, "befor")) << config.err;
}

// It records the requests, as all streams, and does nothing else with them.
TEST_F(BlackBox, IsNotAnotherProgramThatReadsRequests) {
  const auto requests = session_.create<ctl::TriggerRequest>("dssm_trigger", depth_of(8)).value();
  Running running(argv({"record", "-o", folder_.file("a.mcap")}), environment());
  await([&] { return session_.stream_info(requests.id()).value().readers == 1; });
  const Finished none = ctl({"trigger", "a"});
  EXPECT_EQ(none.exit_status, 1);
  EXPECT_TRUE(contains(none.err, "no host has a black box that waits for triggers")) << none.err;
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
}

TEST_F(BlackBox, TakesItsOptionsFromAFile) {
  auto power = session_.create<Power>("power", depth_of(64)).value();
  const auto other = session_.create<Power>("other", depth_of(64)).value();
  std::ofstream(folder_.file("record.conf"))
      << "black_box = true\nstreams = [\"power\"]\nafter = \"1ms\"\noutput = \"" << folder_.path()
      << "\"\ntrigger = [\"high: power.volts > 25\"]\n";
  Running running(argv({"record", "--config", folder_.file("record.conf")}), environment());
  await([&] { return session_.stream_info(power.id()).value().readers == 2; });
  power.write({26, 0});
  const std::string file = quoted_file(running.line());
  EXPECT_TRUE(running.line().starts_with(file + ": 1 sample of 1 stream, "));
}

// --- other hosts

TEST_F(BlackBoxInAFleet, IsTriggeredFromAnotherHost) {
  auto power = on_pc2_.create<Power>("power", depth_of(64)).value();
  std::vector<std::string> words = recorder({"--after", "1ms"});
  Running running(words, {pc2_.environment()});
  await_armed(on_pc2_, power.id());
  await_streams(2);
  write_power(power, 0, 9);
  EXPECT_TRUE(contains(output({"trigger", "far"}), "far: requested of pc2"));
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "trigger 'far' of host 'pc1'; records '")) << line;
  EXPECT_TRUE(running.line().starts_with(quoted_file(line)));
  EXPECT_EQ(numbers_in(quoted_file(line)), range(0, 9));
}

TEST_F(BlackBoxInAFleet, HasThePastOfAHostThatIsLost) {
  auto here = session_.create<Power>("here", depth_of(64)).value();
  auto there = on_pc2_.create<Power>("there", depth_of(4096)).value();
  await_streams(1);
  write_power(here, 0, 9);
  Running running(recorder({"--after", "1ms", "--trigger", "lost: stalled there"}), environment());
  await_armed(there.id());
  const auto mirror = [&] { return session_.stream_info(there.id()).value().mirror; };
  // Live for so long that the recorder has seen it.
  const MonoTime end = deadline_in(3s);
  std::int64_t number = 0;
  while (MonoClock::now() < end) {
    write_power(there, number, number + 9);
    number += 10;
    await([&] { return mirror() && mirror()->newest == number - 1; });
    std::this_thread::sleep_for(10ms);  // the rate of the stream
  }
  pc2_.kill_hard();
  const std::string line = running.line();
  EXPECT_TRUE(contains(line, "trigger 'lost' of host 'pc2': 'there:0@pc2' is lost: its host ") ||
              contains(line, "'there:0@pc2' is stalled"))
      << line;
  EXPECT_TRUE(running.line().starts_with(quoted_file(line)));
  EXPECT_EQ(numbers_in(quoted_file(line), "here"), range(0, 9));
  EXPECT_EQ(numbers_in(quoted_file(line), "there"), range(0, number - 1));
}

}  // namespace
}  // namespace dssm::test
