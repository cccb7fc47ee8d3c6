// SPDX-License-Identifier: Apache-2.0
//
// All verbs on streams of other hosts.
#include <signal.h>

#include <fstream>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;
using Remote = FleetTest;
using Strings = std::vector<std::string>;

// Sample i has the time 100 + i seconds.
void write(Writer<double>& writer, int first, int last) {
  for (int i = first; i <= last; ++i) writer.write(i / 2.0, at_ns((100 + i) * kSecond));
}

TEST_F(Remote, LsShowsTheStreamsOfAllHostsOwnOnesFirst) {
  auto zebra = session_.create<double>("zebra", depth_of(4)).value();
  auto lidar = on_pc3_.create<double>("lidar", depth_of(8)).value();
  auto odom = on_pc2_.create<double>("odom:1", depth_of(4)).value();
  await_streams(2);
  const Strings lines = lines_of(output({"ls"}));
  ASSERT_EQ(lines.size(), 4U);
  const auto first_words = [&](std::size_t line) {
    const Strings words = words_of(lines[line]);
    return Strings(words.begin(), words.begin() + 3);
  };
  EXPECT_EQ(first_words(0), (Strings{"NAME", "ID", "HOST"}));
  EXPECT_EQ(first_words(1), (Strings{"zebra", "0", "pc1"}));
  EXPECT_EQ(first_words(2), (Strings{"odom", "1", "pc2"}));
  EXPECT_EQ(first_words(3), (Strings{"lidar", "0", "pc3"}));
  EXPECT_EQ(output({"ls", "--names"}), "zebra\nodom:1\nlidar\n");
  EXPECT_EQ(output({"ls", "--names", "--sort", "host", "-r"}), "lidar\nodom:1\nzebra\n");
  EXPECT_EQ(output({"ls", "--names", "--own"}), "zebra\n");

  const Json streams = json({"ls"})["streams"];
  EXPECT_EQ(streams[2]["stream"], "lidar:0@pc3");
  EXPECT_EQ(streams[2]["host"], "pc3");
  EXPECT_EQ(streams[2]["depth"], 8);
  EXPECT_EQ(streams[2]["channels"], 0);
  EXPECT_EQ(json({"ls", "--own"})["streams"].size(), 1U);
}

TEST_F(Remote, LsWithoutStreamsNamesHostsThatAreNotReached) {
  EXPECT_TRUE(ctl({"ls"}).err.starts_with("dssmctl: ls: no streams; programs create them"));
  pc2_.kill_hard();
  await_state("pc2", HostState::down);
  EXPECT_EQ(ctl({"ls"}).err, "dssmctl: ls: no streams; not reached: pc2; see `dssmctl hosts`\n");
}

TEST_F(Remote, NamesOpenTheRightStreamWhereSeveralHaveTheName) {
  auto here = session_.create<double>("odom", depth_of(4)).value();
  auto on_2 = on_pc2_.create<double>("odom", depth_of(4)).value();
  auto lidar_2 = on_pc2_.create<double>("lidar", depth_of(4)).value();
  auto lidar_3 = on_pc3_.create<double>("lidar", depth_of(4)).value();
  await_streams(3);
  const Strings names = lines_of(output({"ls", "--names"}));
  EXPECT_EQ(names, (Strings{"odom", "odom@pc2", "lidar@pc2", "lidar@pc3"}));
  const Json streams = json({"ls"})["streams"];
  for (std::size_t i = 0; i < names.size(); ++i) {
    EXPECT_EQ(json({"info", names[i]})["stream"], streams[i]["stream"]) << names[i];
  }
  const Finished ambiguous = ctl({"echo", "lidar", "--last"});
  EXPECT_EQ(ambiguous.exit_status, 1);
  EXPECT_TRUE(contains(ambiguous.err, "pc2") && contains(ambiguous.err, "pc3")) << ambiguous.err;
}

TEST_F(Remote, EchoShowsThePastAndTheNewestSample) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  write(writer, 0, 9);
  await_streams(1);
  for (const char* name : {"s", "s@pc2", "s:0@pc2"}) {
    const Json newest = json({"echo", name, "--last"});
    EXPECT_EQ(newest["stream"], "s:0@pc2");
    EXPECT_EQ(newest["tid"], 9);
    EXPECT_EQ(newest["time_ns"], 109 * kSecond);
    EXPECT_EQ(newest["fields"]["value"], 4.5);
    EXPECT_EQ(json({"echo", name, "--at", "104.5"})["tid"], 4);
  }
}

TEST_F(Remote, EchoShowsEachSampleOnceAsItComes) {
  auto writer = on_pc2_.create<double>("s", depth_of(1000)).value();
  await_streams(1);
  Running echo(argv({"echo", "s", "--json"}), environment());
  int next = 0;
  const auto write_one = [&] { write(writer, next, next), ++next; };
  std::int64_t tid = Json::parse(echo.line(write_one))["tid"];
  while (tid < next - 1) tid = Json::parse(echo.line())["tid"];  // it may have begun late
  for (int i = 0; i < 20; ++i) {
    write_one();
    EXPECT_EQ(Json::parse(echo.line())["tid"], next - 1);
  }
  echo.signal(SIGINT);
  echo.rest();
  EXPECT_EQ(echo.status(), 0);
}

TEST_F(Remote, HzAndBwFollowFromTheOwnersStamps) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  write(writer, 0, 9);
  await_streams(1);
  const Json hz = json({"hz", "s@pc2", "--count", "1"});
  EXPECT_EQ(hz["stream"], "s:0@pc2");
  EXPECT_EQ(hz["seen_samples"], 10);
  EXPECT_DOUBLE_EQ(hz["rate_hz"].get<double>(), 1);
  EXPECT_EQ(hz["restarts"], 0);
  EXPECT_DOUBLE_EQ(json({"bw", "s@pc2", "--count", "1"})["bytes_per_second"].get<double>(), 8);
}

// Both dssmd of the test have one kernel.
TEST_F(Remote, DelayKnowsThatTwoHostsHaveOneClock) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  await_streams(1);
  Running delay(argv({"delay", "s@pc2", "--interval", "0.05"}), environment());
  std::string line;
  do {
    line = delay.line([&] { writer.write(0, WallClock::now() - 9s); });
  } while (!line.starts_with("average delay: 9."));

  Running as_json(argv({"delay", "s@pc2", "--interval", "0.05", "--json"}), environment());
  Json report;
  do {
    report = Json::parse(as_json.line([&] { writer.write(0, WallClock::now() - 9s); }));
  } while (report["samples"] == 0);
  EXPECT_EQ(report["delay_error_ns"], 0);
}

TEST_F(Remote, InfoShowsOwnerChannelsAndTheMirrorsState) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  write(writer, 0, 9);
  await_streams(1);
  EXPECT_TRUE(json({"info", "s"})["mirror"].is_null());
  EXPECT_FALSE(contains(output({"info", "s"}), "mirror:"));

  const auto newest_only = session_.open_reader<double>("s").value();
  EXPECT_EQ(json({"info", "s"})["mirror"]["history_wanted"], false);
  EXPECT_TRUE(contains(output({"info", "s"}),
                       "history:      9 samples are on its host only, until a program here"));
  auto reader = session_.open_reader<double>("s", FetchHistory::at_once).value();
  const Json info = json({"info", "s"});
  EXPECT_EQ(info["host"], "pc2");
  EXPECT_EQ(info["channels"], 1);
  EXPECT_EQ(info["writers"], 1);
  EXPECT_EQ(info["users"][0]["program"], "the test");
  EXPECT_EQ(info["mirror"]["state"], "live");
  EXPECT_EQ(info["mirror"]["newest_tid"], 9);
  EXPECT_EQ(info["mirror"]["received_samples"], 10);
  EXPECT_EQ(info["mirror"]["received_bytes"], 80);
  EXPECT_EQ(info["mirror"]["gap_samples"], 0);
  EXPECT_EQ(info["mirror"]["filling_samples"], 0);
  EXPECT_EQ(info["mirror"]["reconnects"], 0);
  EXPECT_EQ(info["mirror"]["restarts"], 0);
  EXPECT_TRUE(info["mirror"]["error"].is_null());
  const std::string text = output({"info", "s"});
  for (const char* part : {"s:0@pc2\n", "owner:        host pc2\n", "channels:     1 to other",
                           "mirror:       live\n", "10 samples, 80 bytes, up to tid 9\n"}) {
    EXPECT_TRUE(contains(text, part)) << part << " in\n" << text;
  }

  pc2_.kill_hard();
  await_state("pc2", HostState::down);
  const Json alone = json({"info", "s@pc2"});
  EXPECT_EQ(alone["mirror"]["state"], "owner unavailable");
  EXPECT_FALSE(alone["mirror"]["error"].get<std::string>().empty());
}

TEST_F(Remote, CreateAndRmWorkOnTheNamedHost) {
  EXPECT_EQ(json({"create", "s:2@pc2", "--size", "24", "--depth", "10"}),
            Json::parse(R"({"stream":"s:2@pc2","created":true,"payload_bytes":24,
                            "depth":10,"cycle_ns":100000000})"));
  EXPECT_EQ(on_pc2_.stream_info({"s", 2, ""}).value().depth, 10U);
  EXPECT_EQ(json({"create", "s:2@pc2", "--size", "24", "--depth", "99"})["created"], false);
  EXPECT_EQ(json({"ls", "--own"})["streams"].size(), 0U);
  await_streams(1);
  EXPECT_EQ(json({"rm", "s:2@pc2"})["removed"][0], "s:2@pc2");
  EXPECT_EQ(on_pc2_.list_own_streams().value().size(), 0U);
}

TEST_F(Remote, CreateWithoutAHostMakesAnOwnStreamWhateverOthersHave) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  await_streams(1);
  EXPECT_EQ(json({"create", "s", "--size", "8", "--depth", "4"}),
            Json::parse(R"({"stream":"s:0@pc1","created":true,"payload_bytes":8,
                            "depth":4,"cycle_ns":100000000})"));
}

TEST_F(Remote, PropertiesCrossBothWays) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  await_streams(1);
  EXPECT_EQ(ctl({"property", "set", "s@pc2"}, "calibrated").exit_status, 0);
  EXPECT_EQ(output({"property", "get", "s@pc2"}), "calibrated");
  EXPECT_EQ(on_pc2_.property({"s", 0, ""}).value().size(), 10U);
}

TEST_F(Remote, SimilarNamesAreFoundOnOtherHosts) {
  auto writer = on_pc2_.create<double>("lidar", depth_of(16)).value();
  await_streams(1);
  EXPECT_TRUE(contains(ctl({"echo", "lidr"}).err, "is it 'lidar'?"));
  EXPECT_TRUE(contains(ctl({"info", "lidar@pc3"}).err, "is it 'lidar@pc2'?"));
}

TEST_F(Remote, EchoAndHzEndWhenTheOwnerRemovesTheStream) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  write(writer, 0, 1);
  await_streams(1);
  Running echo(argv({"echo", "s", "--csv"}), environment());
  Running hz(argv({"hz", "s", "--interval", "1000"}), environment());
  hz.line();
  hz.line();
  echo.line();
  echo.line([&] { write(writer, 2, 2); });
  ASSERT_TRUE(on_pc2_.remove(writer.id()));
  EXPECT_TRUE(contains(echo.rest(), "'s:0@pc2': it was removed"));
  EXPECT_EQ(echo.status(), 1);
  EXPECT_TRUE(contains(hz.rest(), "'s:0@pc2': it was removed"));
  EXPECT_EQ(hz.status(), 1);
}

// The owner's dssmd comes back and gets the ring from the program that holds it.
TEST_F(Remote, EchoContinuesWhileTheOwnerIsDownAndAfterwards) {
  auto writer = on_pc2_.create<double>("s", depth_of(10'000)).value();
  await_streams(1);
  Running echo(argv({"echo", "s", "--json"}), environment());
  const auto write_one = [&] { writer.write(1); };
  std::int64_t tid = Json::parse(echo.line(write_one))["tid"];
  for (const bool crash : {true, false}) {
    crash ? pc2_.kill_hard() : static_cast<void>(pc2_.stop());
    await_state("pc2", HostState::down);
    const Tid written_meanwhile = writer.write(2);
    pc2_.start();
    while (tid < written_meanwhile + 10) {
      const Json line = Json::parse(echo.line(write_one), nullptr, false);
      ASSERT_TRUE(line.is_object()) << line;
      ASSERT_EQ(line["tid"], tid + 1);
      EXPECT_EQ(line["lost"], 0);
      tid = line["tid"];
    }
  }
}

TEST_F(Remote, EchoAwaitsAHostThatDoesNotAnswer) {
  auto writer = on_pc2_.create<double>("s", depth_of(16)).value();
  writer.write(1);
  await_streams(1);
  ::kill(pc2_.pid(), SIGSTOP);
  Running echo(argv({"echo", "s@pc2", "--wait", "60", "--count", "1", "--csv"}), environment());
  await_state("pc2", HostState::down);
  ::kill(pc2_.pid(), SIGCONT);
  const std::string first = echo.line();
  // Unless it was slow to start, and the host had returned.
  if (first != "tid,time_ns,clock_error_ns,value") {
    EXPECT_TRUE(first.starts_with("dssmctl: echo: waits up to 60.0 s: ")) << first;
    EXPECT_EQ(echo.line(), "tid,time_ns,clock_error_ns,value");
  }
  // What was written before may have been there when a slow echo began.
  const std::string sample = echo.line([&] { writer.write(1); });
  EXPECT_TRUE(sample.ends_with(",1")) << sample;
  echo.rest();
  EXPECT_EQ(echo.status(), 0);
}

// The same, but that program takes its time: meanwhile there is no such stream.
TEST_F(Remote, EchoContinuesWhenTheStreamReturnsLaterThanItsOwner) {
  const std::vector<std::byte> payload(4);
  output({"--socket", pc2_.socket_path(), "create", "s", "--size", "4", "--depth", "100000"});
  Running holder(argv({"--socket", pc2_.socket_path(), "echo", "s"}), environment());
  await([&] { return on_pc2_.stream_info({"s", 0, ""}).value().readers == 1; });
  await_streams(1);
  Running echo(argv({"echo", "s", "--csv"}), environment());
  echo.line();  // the header
  // Two samples, one after the other: after the second one it follows for sure.
  Tid tid = kNoTid;
  for (int i = 0; i < 2; ++i) {
    auto writer = on_pc2_.open_raw_writer({"s", 0, ""}).value();
    tid = std::stoll(echo.line([&] { writer.write(payload); }));
  }
  pc2_.stop();
  holder.stop();
  pc2_.start();
  // The mirror's, until pc2 says that there is none.
  await([&] { return !session_.stream_info({"s", 0, "pc2"}); });
  // Nobody sees from outside that echo has noticed; it looks every 100 ms.
  for (const MonoTime noticed = deadline_in(300ms); MonoClock::now() < noticed;) {
    ASSERT_FALSE(session_.stream_info({"s", 0, "pc2"}));
  }
  holder.signal(SIGCONT);
  await([&] { return on_pc2_.stream_info({"s", 0, ""}).has_value(); });
  const Tid last = on_pc2_.open_raw_writer({"s", 0, ""}).value().write(payload);
  while (tid < last) {
    const std::string line = echo.line();
    ASSERT_TRUE(line.starts_with(std::to_string(tid + 1) + ",")) << line;
    ++tid;
  }
}

TEST_F(Remote, FollowersContinueWithTheRingOfARecreatedStream) {
  auto writer = std::optional(on_pc2_.create<double>("s", depth_of(1000)).value());
  write(*writer, 0, 9);
  await_streams(1);
  Running echo(argv({"echo", "s", "--json"}), environment());
  Running hz(argv({"hz", "s", "--json", "--interval", "0.05"}), environment());
  EXPECT_EQ(Json::parse(echo.line([&] { writer->write(1); }))["restarts"], 0);
  EXPECT_EQ(Json::parse(hz.line())["restarts"], 0);
  // Gone with all who held it, and created anew.
  writer.reset();
  ASSERT_TRUE(on_pc2_.remove({"s", 0, ""}));
  writer = on_pc2_.create<double>("s", depth_of(1000)).value();
  write(*writer, 0, 4);

  const auto await_news = [](Running& running) {
    std::string line;
    while ((line = running.line()).starts_with('{')) {
    }
    EXPECT_EQ(line, "dssmctl: 's:0@pc2': the stream restarted");
  };
  await_news(echo);
  for (int tid = 0; tid <= 4; ++tid) {
    const Json sample = Json::parse(echo.line());
    EXPECT_EQ(sample["tid"], tid);
    EXPECT_EQ(sample["restarts"], 1);
    EXPECT_EQ(sample["lost"], 0);
  }
  await_news(hz);
  const Json report = Json::parse(hz.line());
  EXPECT_EQ(report["restarts"], 1);
  EXPECT_EQ(report["lost_samples"], 0);
}

TEST_F(Remote, DescribedStreamsAreSeenByAllHosts) {
  RawWriter writer = on_pc2_.create_raw({"odom", 0, ""}, {"", 8, 8, {}}, depth_of(4)).value();
  const double x = 1.5;
  writer.write(std::as_bytes(std::span(&x, 1)), at_ns(kSecond));
  await_streams(1);
  auto mirrored = session_.open_raw_reader({"odom", 0, "pc2"}).value();
  ASSERT_TRUE(mirrored.type().fields.empty());

  const TypeInfo type{"Odometry", 8, 8, {{"x", Scalar::float64, 0, 1, 8}}};
  ASSERT_TRUE(session_.describe({"odom", 0, "pc2"}, type));
  EXPECT_EQ(on_pc2_.stream_info({"odom", 0, ""})->type, type);
  await([&] { return session_.open_raw_reader({"odom", 0, "pc2"})->type() == type; });
  EXPECT_EQ(on_pc3_.describe({"odom", 0, "pc2"}, type).error().code, Errc::not_found)
      << "pc3 does not know pc2";
}

}  // namespace
}  // namespace dssm::test
