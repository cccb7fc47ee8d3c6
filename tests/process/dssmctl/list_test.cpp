// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls and info.
#include <fcntl.h>
#include <signal.h>
#include <stdlib.h>
#include <sys/ioctl.h>
#include <termios.h>
#include <unistd.h>

#include <array>
#include <regex>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

struct Pose {
  double x;
  float v[2];
};
DSSM_DESCRIBE(Pose, x, v)

using Ls = CtlTest;
using Info = CtlTest;
using Strings = std::vector<std::string>;

TEST_F(Ls, ShowsOnlyTheHeaderWithoutStreams) {
  const Finished nothing = ctl({"ls"});
  EXPECT_EQ(nothing.exit_status, 0);
  EXPECT_TRUE(nothing.err.starts_with("dssmctl: ls: no streams; ")) << nothing.err;
  EXPECT_EQ(nothing.out,
            "NAME  ID  HOST  SIZE  DEPTH  CYCLE  RATE  AGE  STATE  WRITERS  READERS  TYPE\n");
  EXPECT_EQ(output({"ls", "--names"}), "");
  EXPECT_EQ(json({"ls"}), Json::parse(R"({"streams":[]})"));
}

TEST_F(Ls, ShowsWhatIsKnownOfEachStreamInAlignedColumns) {
  auto pose = session_.create<Pose>("pose:3", depth_of(8)).value();
  auto empty =
      session_.create<std::array<std::byte, 100>>("a_rather_long_name", depth_of(4)).value();
  auto reader = session_.open_reader<Pose>("pose:3").value();
  for (int i = 0; i < 5; ++i) pose.write({}, at_ns(1'000'000'000 + i * 20'000'000));

  const Strings lines = lines_of(output({"ls"}));
  ASSERT_EQ(lines.size(), 3U);
  const Strings row = words_of(lines[1]);
  ASSERT_GE(row.size(), 12U);
  EXPECT_EQ(Strings(row.begin(), row.begin() + 8),
            (Strings{"pose", "3", "pc1", "16", "8", "10.0", "ms", "50.0"}));
  EXPECT_EQ(Strings(row.end() - 3, row.end()), (Strings{"1", "1", "Pose"}));
  const Strings other = words_of(lines[2]);
  EXPECT_EQ(Strings(other.begin(), other.begin() + 11),
            (Strings{"a_rather_long_name", "0", "pc1", "100", "4", "10.0", "ms", "-", "-", "empty",
                     "1"}));
  // Numbers end where their column's title ends, texts begin where it begins.
  const std::size_t size_end = lines[0].find("SIZE") + 4;
  EXPECT_EQ(lines[1].substr(size_end - 2, 2), "16");
  EXPECT_EQ(lines[2].substr(size_end - 3, 3), "100");
  EXPECT_EQ(lines[1].find("Pose"), lines[0].find("TYPE"));
}

TEST_F(Ls, PrintsTheSameAsJsonWithUnits) {
  auto pose = session_.create<Pose>("pose:3", depth_of(8)).value();
  const Time last = WallClock::now();
  // So slow that it is not stalled when dssmd answers late.
  for (int i = 4; i >= 0; --i) pose.write({}, last - i * std::chrono::seconds(20));
  auto raw = session_.create_raw({"raw", 0, ""}, {"", 7, 1, {}}, depth_of(4)).value();

  const Time before = WallClock::now();
  const Json document = json({"ls"});
  const Json& streams = document["streams"];
  ASSERT_EQ(streams.size(), 2U);
  EXPECT_TRUE(output({"ls", "--json"}).starts_with("{\n  \"streams\": [\n    {\n      \"stream\""))
      << "indented as all documents";
  const Json& stream = streams[0];
  EXPECT_EQ(stream["stream"], "pose:3@pc1");
  EXPECT_EQ(stream["name"], "pose");
  EXPECT_EQ(stream["id"], 3);
  EXPECT_EQ(stream["host"], "pc1");
  EXPECT_EQ(stream["type"], "Pose");
  EXPECT_EQ(stream["payload_bytes"], 16);
  EXPECT_EQ(stream["depth"], 8);
  EXPECT_EQ(stream["cycle_ns"], 10'000'000);
  EXPECT_DOUBLE_EQ(stream["rate_hz"].get<double>(), 0.05);
  EXPECT_EQ(stream["newest_tid"], 4);
  EXPECT_EQ(stream["oldest_tid"], 0);
  EXPECT_EQ(stream["newest_time_ns"], to_ns(last));
  EXPECT_GE(stream["age_ns"].get<std::int64_t>(), to_ns(before - last));
  EXPECT_LE(stream["age_ns"].get<std::int64_t>(), to_ns(WallClock::now() - last));
  EXPECT_EQ(stream["state"], "live");
  EXPECT_EQ(stream["writers"], 1);
  EXPECT_EQ(stream["readers"], 0);
  EXPECT_EQ(stream["incarnation"], pose.incarnation());
  EXPECT_EQ(stream["creator_pid"], ::getpid());
  const Json& empty = streams[1];
  for (const char* key :
       {"type", "rate_hz", "age_ns", "newest_tid", "oldest_tid", "newest_time_ns"}) {
    EXPECT_TRUE(empty[key].is_null()) << key;
  }
}

TEST_F(Ls, SaysWhenNoStreamFits) {
  auto a = session_.create<double>("a", depth_of(4)).value();
  EXPECT_EQ(ctl({"ls", "zzz*"}).err, "dssmctl: ls: no streams that fit 'zzz*'; there is 1 other\n");
  EXPECT_EQ(ctl({"ls", "zzz*", "--json"}).err, "");
}

TEST_F(Ls, ShowsStalledStreamsAndNoRateOfThem) {
  std::optional pose = session_.create<Pose>("pose", depth_of(8)).value();
  const Time last = WallClock::now() - std::chrono::seconds(6);
  for (int i = 4; i >= 0; --i) pose->write({}, last - i * std::chrono::milliseconds(20));
  const Json stalled = json({"ls"})["streams"][0];
  EXPECT_EQ(stalled["state"], "stalled");
  EXPECT_TRUE(stalled["rate_hz"].is_null());
  EXPECT_GE(stalled["age_ns"], 6 * kSecond);
  const Strings row = words_of(lines_of(output({"ls"}))[1]);
  EXPECT_EQ(row[7], "-") << "RATE";
  EXPECT_EQ(row[10], "stalled");
  const std::string info = output({"info", "pose"});
  EXPECT_TRUE(std::regex_search(
      info, std::regex("\nstate: +stalled: no sample for .*, but open for writing in 1 program\n")))
      << info;
  EXPECT_FALSE(contains(info, "\nrate:")) << info;

  pose.reset();
  EXPECT_EQ(json({"ls"})["streams"][0]["state"], "no writer");
  EXPECT_TRUE(contains(output({"info", "pose"}), "no writer: no sample for "));
}

TEST_F(Ls, KnowsNoAgeByTheStampsOfARecording) {
  auto pose = session_.create<Pose>("pose", depth_of(8)).value();
  for (int i = 0; i < 5; ++i) pose.write({}, at_ns(i * 20'000'000));
  const Json stream = json({"ls"})["streams"][0];
  EXPECT_TRUE(stream["state"].is_null());
  EXPECT_TRUE(stream["age_ns"].is_null());
  EXPECT_DOUBLE_EQ(stream["rate_hz"].get<double>(), 50);
}

TEST_F(Ls, SortsByWhatIsAskedAndByCreationOtherwise) {
  auto b = session_.create_raw({"b", 0, ""}, {"T2", 30, 1, {}}, depth_of(4)).value();
  auto a = session_.create_raw({"a", 1, ""}, {"T3", 10, 1, {}}, depth_of(8)).value();
  auto c = session_.create_raw({"c", 2, ""}, {"T1", 20, 1, {}}, depth_of(2)).value();
  const std::vector<std::byte> payload(10);
  // Ages are looked at one after the other: the difference is greater than that takes.
  a.write(payload, WallClock::now() - std::chrono::seconds(2));
  c.write(std::vector<std::byte>(20), WallClock::now());
  EXPECT_EQ(output({"ls", "--names"}), "b\na:1\nc:2\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "name"}), "a:1\nb\nc:2\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "id", "-r"}), "c:2\na:1\nb\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "size"}), "a:1\nc:2\nb\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "depth"}), "c:2\nb\na:1\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "type"}), "c:2\nb\na:1\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "age"}), "c:2\na:1\nb\n");
}

TEST_F(Ls, ShowsForeignNamesEscapedAndGivesThemToProgramsAsTheyAre) {
  auto writer = session_.create<double>("caf\xc3\xa9", depth_of(4)).value();
  const Finished finished = run(argv({"ls"}), {daemon_.environment(), "LC_ALL=C"});
  EXPECT_EQ(words_of(lines_of(finished.out)[1])[0], "caf\\xc3\\xa9");
  EXPECT_EQ(output({"ls", "--names"}), "caf\xc3\xa9\n");
  EXPECT_EQ(json({"ls"})["streams"][0]["name"], "caf\xc3\xa9");
}

// What a program prints when its standard output is a terminal.
std::string on_terminal(const Strings& argv, const Strings& environment,
                        unsigned short columns = 0) {
  const int master = ::posix_openpt(O_RDWR | O_NOCTTY | O_CLOEXEC);
  EXPECT_EQ(::grantpt(master), 0);
  EXPECT_EQ(::unlockpt(master), 0);
  const int slave = ::open(::ptsname(master), O_RDWR | O_NOCTTY | O_CLOEXEC);
  termios raw{};
  ::tcgetattr(slave, &raw);
  ::cfmakeraw(&raw);
  ::tcsetattr(slave, TCSANOW, &raw);
  const winsize size{24, columns, 0, 0};
  ::ioctl(slave, TIOCSWINSZ, &size);
  const pid_t pid = start(argv, environment, slave);
  EXPECT_EQ(wait_for(pid), 0);  // a terminal keeps 4 KiB for us: more than is printed here
  ::close(slave);
  std::string text(4096, '\0');
  const ssize_t got = ::read(master, text.data(), text.size());
  ::close(master);
  text.resize(got > 0 ? static_cast<std::size_t>(got) : 0);
  return text;
}

TEST_F(Ls, PrintsABoldHeaderOnATerminalUnlessNoColorIsSet) {
  EXPECT_TRUE(
      on_terminal(argv({"ls"}), {daemon_.environment(), "NO_COLOR="}).starts_with("\x1b[1mNAME"));
  EXPECT_TRUE(on_terminal(argv({"ls"}), {daemon_.environment(), "NO_COLOR=1"}).starts_with("NAME"));
}

TEST_F(Ls, FitsATerminalOf80Columns) {
  auto pose = session_.create<Pose>("front_camera:1", depth_of(1000)).value();
  auto raw = session_
                 .create_raw({"camera", 0, ""}, {"vehicle::drivers::CameraFrame", 1 << 20, 1, {}},
                             depth_of(4))
                 .value();
  const Strings env = {daemon_.environment(), "NO_COLOR=1", "LC_ALL=C"};
  const Strings lines = lines_of(on_terminal(argv({"ls"}), env, 80));
  ASSERT_EQ(lines.size(), 3U);
  for (const std::string& line : lines) EXPECT_LE(line.size(), 80U) << line;
  EXPECT_EQ(words_of(lines[0])[1], "HOST") << "the id is the first column to go";
  EXPECT_TRUE(lines[1].starts_with("front_camera:1 ")) << "but not the id";
  EXPECT_TRUE(contains(lines[0], "RATE") && contains(lines[0], "STATE") &&
              contains(lines[0], "READERS"))
      << lines[0];
  EXPECT_EQ(on_terminal(argv({"ls", "--wide"}), env, 80), output({"ls"}));
  EXPECT_EQ(on_terminal(argv({"ls", "-w"}), env, 80), output({"ls"}));
  EXPECT_EQ(on_terminal(argv({"ls"}), env, 200), output({"ls"}));
}

TEST_F(Ls, PrintsUtf8InALocaleThatHasIt) {
  auto writer = session_.create<double>("caf\xc3\xa9", depth_of(4)).value();
  auto evil = session_.create<double>("e\xe2\x80\xaevil", depth_of(4)).value();
  const Finished finished = run(argv({"ls"}), {daemon_.environment(), "LC_ALL=C.UTF-8"});
  const Strings lines = lines_of(finished.out);
  EXPECT_TRUE(lines[1].starts_with("caf\xc3\xa9 ")) << finished.out;
  EXPECT_TRUE(lines[2].starts_with("e\\xe2\\x80\\xaevil ")) << finished.out;
  // Aligned by columns, of which the e with its accent takes one.
  EXPECT_EQ(lines[1].find("pc1"), lines[2].find("pc1") + 1);
}

TEST_F(Ls, SendsNoForeignBytesToATerminal) {
  auto writer = session_.create<double>("caf\xc3\xa9", depth_of(4)).value();
  EXPECT_EQ(on_terminal(argv({"ls", "--names"}), {daemon_.environment(), "LC_ALL=C"}),
            "caf\\xc3\\xa9\n");
}

TEST_F(Info, ShowsFieldsUsersAndSamples) {
  auto pose = session_.create<Pose>("pose", depth_of(8)).value();
  auto reader = session_.open_reader<Pose>("pose").value();
  pose.write({}, at_ns(1'500'000'000));
  ASSERT_TRUE(pose.set_property_as(1.5));
  const std::string text = output({"info", "pose"});
  for (const char* part : {"pose:0@pc1\n", "'Pose' (16 bytes, aligned to 8)", "8 slots",
                           "tid 0 to 0", "1.500000000", "8 bytes", "float64", "float32", "the test",
                           "writer", "writers:      1\n", "readers:      1\n", "VIA", "local"}) {
    EXPECT_NE(text.find(part), std::string::npos) << part << " in\n" << text;
  }

  const Json info = json({"info", "pose"});
  EXPECT_EQ(info["fields"], Json::parse(R"([
      {"name":"x","kind":"float64","offset_bytes":0,"count":1,"stride_bytes":8},
      {"name":"v","kind":"float32","offset_bytes":8,"count":2,"stride_bytes":4}])"));
  EXPECT_EQ(info["alignment_bytes"], 8);
  EXPECT_EQ(info["property_bytes"], 8);
  EXPECT_GT(info["memory_bytes"], 8 * 64);
  EXPECT_EQ(info["incarnation"], pose.incarnation());
  ASSERT_EQ(info["users"].size(), 2U);
  EXPECT_EQ(info["users"][0]["role"], "writer");
  EXPECT_EQ(info["users"][1]["role"], "reader");
  EXPECT_EQ(info["users"][0]["pid"], ::getpid());
  EXPECT_EQ(info["users"][0]["program"], "the test");
}

TEST_F(Info, PrintsTimesAsIso8601) {
  auto pose = session_.create<Pose>("pose", depth_of(8)).value();
  pose.write({}, at_ns(1'500'000'000));
  EXPECT_TRUE(contains(output({"--iso", "info", "pose"}), "1970-01-01T00:00:01.500000000Z"));
}

TEST_F(Info, WatchPrintsABlockForEachChange) {
  auto pose = session_.create<Pose>("pose", depth_of(8)).value();
  Running watch(argv({"info", "pose", "--watch"}), environment());
  std::string line;
  do {
    line = watch.line();
  } while (!line.starts_with("writers:"));
  EXPECT_TRUE(line.ends_with(" 1"));
  const auto second = session_.create<Pose>("pose", depth_of(8)).value();
  do {
    line = watch.line();
  } while (!line.starts_with("writers:"));
  EXPECT_TRUE(line.ends_with(" 2")) << "nothing is printed while nothing changes";
  watch.signal(SIGINT);
  watch.rest();
  EXPECT_EQ(watch.status(), 0);

  Running as_json(argv({"info", "--watch", "--json"}), environment());
  EXPECT_EQ(Json::parse(as_json.line())["streams"], 1);
  auto other = session_.create<Pose>("other", depth_of(8)).value();
  EXPECT_EQ(Json::parse(as_json.line([] {}))["host"], "pc1");
}

TEST_F(Info, DescribesTheDaemonWithoutAStream) {
  auto pose = session_.create<Pose>("pose", depth_of(8)).value();
  const Json info = json({"info"});
  EXPECT_EQ(info["host"], "pc1");
  EXPECT_EQ(info["pid"], daemon_.pid());
  EXPECT_EQ(info["streams"], 1);
  EXPECT_NE(output({"info"}).find("pc1"), std::string::npos);
}

TEST_F(Info, ShowsHowMuchOfEachLimitIsUsed) {
  auto pose = session_.create<Pose>("pose", depth_of(8)).value();
  auto reader = session_.open_reader<Pose>("pose").value();
  const Json info = json({"info"});
  const auto limit = [&](const std::string& name) {
    for (const Json& one : info["limits"]) {
      if (one["name"] == name) return one;
    }
    return Json();
  };
  const auto counted = [](const char* name, int used, int of, const char* unit) {
    return Json{{"name", name}, {"used", used}, {"limit", of}, {"unit", unit}};
  };
  EXPECT_EQ(limit("max_streams"), counted("max_streams", 1, 4096, "streams"));
  EXPECT_EQ(limit("max_memory")["used"], info["memory_bytes"]);
  EXPECT_EQ(limit("max_memory")["limit"], info["memory_limit_bytes"]);
  EXPECT_EQ(limit("max_opens"), counted("max_opens", 2, 65536, "open streams"));
  EXPECT_EQ(limit("max_opens_per_client"),
            counted("max_opens_per_client", 2, 16384, "open streams"));
  // The test, and dssmctl itself.
  EXPECT_EQ(limit("max_clients"), counted("max_clients", 2, 4096, "programs"));
  EXPECT_EQ(limit("max_clients_per_user")["limit"], 2048);
  EXPECT_EQ(limit("long messages"), counted("long messages", 0, 256 << 20, "bytes"));
  EXPECT_EQ(limit("max_connections"), counted("max_connections", 0, 256, "connections"));
  EXPECT_EQ(limit("max_peer_memory"), counted("max_peer_memory", 0, 96 << 20, "bytes"));
  EXPECT_EQ(info["limits"].size(), 15U);
  const std::string text = output({"info"});
  EXPECT_TRUE(std::regex_search(text, std::regex("\nLIMIT +USED +OF +UNIT\n"))) << text;
  EXPECT_TRUE(std::regex_search(text, std::regex("\nmax_streams +1 +4096 +streams\n"))) << text;
  EXPECT_TRUE(std::regex_search(text, std::regex("\nlong messages +0 bytes +256.* MiB\n"))) << text;
}

}  // namespace
}  // namespace dssm::test
