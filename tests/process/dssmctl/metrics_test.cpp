// SPDX-License-Identifier: Apache-2.0
//
// dssmctl metrics.
#include <signal.h>

#include <map>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

class Metrics : public FleetTest {
 protected:
  // What dssmctl prints, by the line's name and labels.
  std::map<std::string, double> samples() {
    std::map<std::string, double> all;
    for (const std::string& line : lines_of(output({"metrics"}))) {
      if (line.starts_with('#')) continue;
      const std::size_t space = line.rfind(' ');
      EXPECT_TRUE(all.emplace(line.substr(0, space), std::stod(line.substr(space))).second) << line;
    }
    return all;
  }
};

TEST_F(Metrics, HaveWhatIsKnownOfHostsStreamsAndDssmd) {
  auto odometry = session_.create<double>("odometry:2", depth_of(4)).value();
  odometry.write(1, at_ns(1'500'000'000));
  auto lidar = on_pc2_.create<double>("lidar", depth_of(8)).value();
  await_streams(1);
  auto reader = session_.await_reader<double>("lidar").value();
  for (int i = 0; i < 3; ++i) lidar.write(i);
  ASSERT_EQ(reader.wait_for_tid(2, kNever), WaitStatus::ready);
  pc3_.kill_hard();
  await_state("pc3", HostState::down);

  const auto all = samples();
  const auto value = [&](const std::string& name) {
    const auto found = all.find(name);
    return found == all.end() ? -1 : found->second;
  };
  EXPECT_EQ(value("dssm_build_info{version=\"" DSSM_VERSION "\"}"), 1);
  EXPECT_EQ(value(R"(dssm_host_up{host="pc1"})"), 1);
  EXPECT_EQ(value(R"(dssm_host_up{host="pc2"})"), 1);
  EXPECT_EQ(value(R"(dssm_host_up{host="pc3"})"), 0);
  EXPECT_EQ(value(R"(dssm_host_streams{host="pc2"})"), 1);
  EXPECT_FALSE(all.contains(R"(dssm_host_streams{host="pc3"})"));
  EXPECT_GT(value(R"(dssm_host_round_trip_seconds{host="pc2"})"), 0);
  EXPECT_FALSE(all.contains(R"(dssm_clock_bound_seconds{host="pc2"})"));  // there is no chronyd
  EXPECT_EQ(value(R"(dssm_stream_samples_total{stream="odometry",id="2",host="pc1"})"), 1);
  EXPECT_EQ(
      value(R"(dssm_stream_last_sample_timestamp_seconds{stream="odometry",id="2",host="pc1"})"),
      1.5);
  EXPECT_FALSE(all.contains(R"(dssm_stream_age_seconds{stream="odometry",id="2",host="pc1"})"));
  const std::string labels = R"({stream="lidar",id="0",host="pc2"})";
  EXPECT_EQ(value("dssm_stream_samples_total" + labels), 3);
  EXPECT_EQ(value("dssm_stream_sample_bytes" + labels), 8);
  EXPECT_EQ(value("dssm_stream_readers" + labels), 1);
  EXPECT_EQ(value("dssm_stream_writers" + labels), 1);
  EXPECT_EQ(value("dssm_stream_crashed_writers_total" + labels), 0);
  EXPECT_EQ(value("dssm_stream_crashed_readers_total" + labels), 0);
  EXPECT_EQ(value("dssm_mirror_received_samples_total" + labels), 3);
  EXPECT_EQ(value("dssm_mirror_received_bytes_total" + labels), 24);
  EXPECT_EQ(value("dssm_mirror_lost_samples_total" + labels), 0);
  EXPECT_FALSE(
      all.contains(R"(dssm_mirror_lost_samples_total{stream="odometry",id="2",host="pc1"})"));
  EXPECT_GT(value("dssm_ring_memory_bytes"),
            value(R"(dssm_stream_ring_memory_bytes{stream="odometry",id="2",host="pc1"})"));
  EXPECT_GT(value("dssm_ring_memory_limit_bytes"), 0);
  EXPECT_EQ(value(R"(dssm_limit_used{limit="max_streams",unit="streams"})"), 2);  // and lidar
  EXPECT_GT(value(R"(dssm_limit{limit="max_streams",unit="streams"})"), 1);
  EXPECT_GT(value("dssm_daemon_resident_memory_bytes"), 1e6);
  EXPECT_GE(value("dssm_daemon_cpu_seconds_total"), 0);
  const double now = static_cast<double>(to_ns(WallClock::now())) * 1e-9;
  EXPECT_GT(value("dssm_daemon_start_time_seconds"), now - 300);
  EXPECT_LT(value("dssm_daemon_start_time_seconds"), now + 1);
}

// A count of 0 would be taken for a new stream.
TEST_F(Metrics, LeaveOutTheStreamsOfAHostThatDoesNotAnswer) {
  auto lidar = on_pc2_.create<double>("lidar", depth_of(8)).value();
  lidar.write(1);
  await_streams(1);
  const std::string name = R"(dssm_stream_samples_total{stream="lidar",id="0",host="pc2"})";
  EXPECT_EQ(samples()[name], 1);
  ASSERT_EQ(::kill(pc2_.pid(), SIGSTOP), 0);
  EXPECT_FALSE(samples().contains(name));
  ASSERT_EQ(::kill(pc2_.pid(), SIGCONT), 0);
}

// By the parser of Prometheus' own Python client.
TEST_F(Metrics, AreOpenMetrics) {
  auto lidar = session_.create<double>("lidar", depth_of(8)).value();
  const std::string text = output({"metrics"});
  const Finished parsed = run(
      {"/usr/bin/python3", "-c",
       "import sys\n"
       "from prometheus_client.openmetrics.parser import text_string_to_metric_families as parse\n"
       "for family in parse(sys.stdin.read()):\n"
       "  assert family.documentation\n"
       "  print(family.name, family.type, family.unit)\n"},
      {}, text);
  ASSERT_EQ(parsed.exit_status, 0) << parsed.err << text;
  EXPECT_TRUE(contains(parsed.out, "dssm_stream_samples counter \n")) << parsed.out;
  EXPECT_TRUE(contains(parsed.out, "dssm_host_up gauge \n")) << parsed.out;
  EXPECT_TRUE(contains(parsed.out, "dssm_daemon_cpu_seconds counter seconds\n")) << parsed.out;
  EXPECT_TRUE(contains(parsed.out, "dssm_ring_memory_bytes gauge bytes\n")) << parsed.out;
}

// A stream also counts as stalled when nothing can write to it, which an alert depends on.
TEST_F(Metrics, StateWhatStalledMeansAsTheManualDoes) {
  auto lidar = session_.create<double>("lidar", depth_of(8)).value();
  lidar.write(1);  // what is not known of any stream is left out
  std::string help;
  await([&] {
    for (const std::string& line : lines_of(output({"metrics"}))) {
      constexpr std::string_view kHelp = "# HELP dssm_stream_stalled ";
      if (line.starts_with(kHelp)) help = line.substr(kHelp.size());
    }
    return !help.empty();
  });
  ASSERT_TRUE(help.ends_with('.')) << help;
  help.pop_back();
  const std::string row = "| `dssm_stream_stalled` | the same | " + help + " |";
  EXPECT_TRUE(contains(text_of(source("docs/metrics.md")), row)) << row;
}

TEST_F(Metrics, HaveNoOtherFormat) {
  const Finished refused = ctl({"metrics", "--json"});
  EXPECT_EQ(refused.exit_status, 2);
  EXPECT_TRUE(contains(refused.err, "OpenMetrics text")) << refused.err;
}

}  // namespace
}  // namespace dssm::test
