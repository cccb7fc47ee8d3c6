// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hz, bw and delay. The tests give every stamp themselves, so that the right answers are
// known to the last digit, whenever the samples were written.
#include <signal.h>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct Meter : CtlTest {
  Writer<double> writer_ = session_.create<double>("s", depth_of(16)).value();

  void write_at(std::initializer_list<std::int64_t> times_ms) {
    for (const std::int64_t ms : times_ms) writer_.write(0, at_ns(ms * 1'000'000));
  }
  Json first_report(std::vector<std::string> words) {
    words.insert(words.end(), {"--count", "1"});
    return json(words);
  }
};

TEST_F(Meter, HzFollowsExactlyFromTheStamps) {
  write_at({1000, 1002, 1006, 1010, 1014, 1019, 1024, 1031, 1040});  // 2 4 4 4 5 5 7 9
  const Json report = first_report({"hz", "s"});
  EXPECT_EQ(report["stream"], "s:0@pc1");
  EXPECT_EQ(report["intervals"], 8);
  EXPECT_EQ(report["seen_samples"], 9);
  EXPECT_EQ(report["lost_samples"], 0);
  EXPECT_DOUBLE_EQ(report["rate_hz"].get<double>(), 200);
  EXPECT_DOUBLE_EQ(report["interval_mean_ns"].get<double>(), 5e6);
  EXPECT_EQ(report["interval_min_ns"], 2'000'000);
  EXPECT_EQ(report["interval_max_ns"], 9'000'000);
  EXPECT_DOUBLE_EQ(report["interval_std_dev_ns"].get<double>(), 2e6);
  EXPECT_EQ(report["final"], false);
}

TEST_F(Meter, HzPrintsTheNumbersForPeople) {
  write_at({1000, 1002, 1006, 1010, 1014, 1019, 1024, 1031, 1040});
  EXPECT_EQ(output({"hz", "s", "-n", "1"}),
            "average rate: 200.000 Hz\n"
            "\tmin: 2.00 ms max: 9.00 ms std dev: 2.00 ms window: 9\n");
}

TEST_F(Meter, HzUsesTheNewestSamplesOfItsWindow) {
  write_at({0, 1000, 2000, 2010, 2020});
  const Json report = first_report({"hz", "s", "--window", "3"});
  EXPECT_EQ(report["intervals"], 2);
  EXPECT_DOUBLE_EQ(report["rate_hz"].get<double>(), 100);
}

TEST_F(Meter, HzHasNoRateWhereTheStampsDoNotAdvance) {
  write_at({1000, 1000, 1000});
  EXPECT_TRUE(first_report({"hz", "s"})["rate_hz"].is_null());
  EXPECT_NE(output({"hz", "s", "-n", "1"}).find("average rate: unknown"), std::string::npos);
}

TEST_F(Meter, HzTakesStampsThatRunBackwards) {
  write_at({1000, 1010, 1005, 1020});
  const Json report = first_report({"hz", "s"});
  EXPECT_EQ(report["interval_min_ns"], -5'000'000);
  EXPECT_EQ(report["interval_max_ns"], 15'000'000);
}

TEST_F(Meter, HzReportsAnEmptyStreamAfterAnInterval) {
  const Json report = first_report({"hz", "s", "--interval", "0.01"});
  for (const char* key : {"rate_hz", "age_ns", "interval_mean_ns", "interval_std_dev_ns"}) {
    EXPECT_TRUE(report[key].is_null()) << key;
  }
  EXPECT_EQ(output({"hz", "s", "-n", "1", "-i", "0.01"}), "no samples yet\n");
}

TEST_F(Meter, HzReportsThatNothingNewCame) {
  write_at({1000, 1010});
  const auto lines = lines_of(output({"hz", "s", "-n", "2", "-i", "0.01"}));
  ASSERT_EQ(lines.size(), 3U);
  EXPECT_EQ(lines[2], "no new samples");
}

TEST_F(Meter, HzCountsNewSamplesAndTakesNoIntervalAcrossAGap) {
  auto small = session_.create<double>("small", depth_of(4)).value();
  small.write(0, at_ns(0));
  small.write(0, at_ns(10));
  Running hz(argv({"hz", "small", "--json", "--interval", "0.02"}), environment());
  EXPECT_EQ(Json::parse(hz.line())["seen_samples"], 2);
  hz.stop();
  for (int i = 2; i < 102; ++i) small.write(0, at_ns(i * 10));  // the newest 3 stay
  hz.signal(SIGCONT);
  Json report;
  do {
    report = Json::parse(hz.line());
  } while (report["new_samples"] == 0);
  EXPECT_EQ(report["seen_samples"], 5);
  EXPECT_EQ(report["lost_samples"], 97);
  EXPECT_EQ(report["intervals"], 3);  // one before the gap, two behind it
  EXPECT_EQ(report["interval_max_ns"], 10);
}

TEST_F(Meter, HzRestartsItsWindowAfterAPause) {
  write_at({1000, 1100, 1200, 1300, 164300, 164400, 164500});
  const Json report = first_report({"hz", "s"});
  EXPECT_EQ(report["intervals"], 2);
  EXPECT_DOUBLE_EQ(report["rate_hz"].get<double>(), 10);
  EXPECT_EQ(report["paused_ns"], 163 * kSecond);
  EXPECT_EQ(output({"hz", "s", "-n", "1"}),
            "paused for 2m43s, window restarted\n"
            "average rate: 10.000 Hz\n"
            "\tmin: 100 ms max: 100 ms std dev: 0 ns window: 3\n");
}

TEST_F(Meter, HzHasNoRateOfAStreamThatIsStalled) {
  const Time last = WallClock::now() - 6s;
  for (int i = 4; i >= 0; --i) writer_.write(0, last - i * 20ms);
  const Json report = first_report({"hz", "s"});
  EXPECT_TRUE(report["rate_hz"].is_null());
  EXPECT_GE(report["stalled_ns"], 6 * kSecond);
  EXPECT_DOUBLE_EQ(report["interval_mean_ns"].get<double>(), 2e7);
  const std::string text = output({"hz", "s", "-n", "1"});
  EXPECT_TRUE(text.starts_with("no new samples for ")) << text;
  EXPECT_FALSE(contains(text, "Hz")) << text;
}

TEST_F(Meter, SeveralStreamsHaveARowEach) {
  auto other = session_.create<double>("other", depth_of(16)).value();
  auto empty = session_.create<double>("empty", depth_of(16)).value();
  write_at({1000, 1010});
  for (int i = 0; i < 3; ++i) other.write(0, at_ns(i * 20'000'000));
  EXPECT_EQ(output({"hz", "s", "other", "empty", "-n", "1"}),
            "STREAM             RATE      MIN      MAX  STD DEV  WINDOW  NOTE\n"
            "s:0@pc1      100.000 Hz  10.0 ms  10.0 ms     0 ns       2\n"
            "other:0@pc1   50.000 Hz  20.0 ms  20.0 ms     0 ns       3\n"
            "empty:0@pc1           -        -        -        -       0  no samples yet\n\n");
  EXPECT_EQ(output({"bw", "s", "empty", "-n", "1"}),
            "STREAM       BANDWIDTH  PAYLOAD        RATE  WINDOW  NOTE\n"
            "s:0@pc1        800 B/s  8 bytes  100.000 Hz       2\n"
            "empty:0@pc1          -        -           -       0  no samples yet\n\n");
  const auto lines = lines_of(output({"bw", "s", "other", "-n", "1", "--json"}));
  ASSERT_EQ(lines.size(), 2U);
  EXPECT_EQ(Json::parse(lines[0])["stream"], "s:0@pc1");
  EXPECT_DOUBLE_EQ(Json::parse(lines[0])["bytes_per_second"].get<double>(), 800);
  EXPECT_EQ(Json::parse(lines[1])["stream"], "other:0@pc1");
  EXPECT_DOUBLE_EQ(Json::parse(lines[1])["bytes_per_second"].get<double>(), 400);
}

TEST_F(Meter, SeveralStreamsAreFollowedUntilTheLastOneEnds) {
  auto other = session_.create<double>("other", depth_of(16)).value();
  Running delay(argv({"delay", "s", "other", "--json", "--interval", "0.05"}), environment());
  const auto write_both = [&] {
    writer_.write(0);
    other.write(0);
  };
  std::map<std::string, bool> seen;
  while (!seen["s:0@pc1"] || !seen["other:0@pc1"]) {
    const Json report = Json::parse(delay.line(write_both));
    seen[report["stream"]] = report["samples"] > 0;
  }
  ASSERT_TRUE(session_.remove({"other", 0, ""}));
  std::uint64_t before = 0, now = 0;  // samples of the other one
  for (int i = 0; i < 6 || now == before; ++i) {
    const Json report = Json::parse(delay.line([&] { writer_.write(0); }));
    if (report["stream"] == "s:0@pc1") before = std::exchange(now, report["seen_samples"]);
  }
  ASSERT_TRUE(session_.remove({"s", 0, ""}));
  const std::string rest = delay.rest();
  EXPECT_TRUE(contains(rest, "'other:0@pc1': it was removed")) << rest;
  EXPECT_TRUE(contains(rest, "; and follow 's:0@pc1': it was removed")) << rest;
  EXPECT_EQ(delay.status(), 1);
}

TEST_F(Meter, HzPrintsALastReportAtItsEnd) {
  write_at({1000, 1010});
  Running hz(argv({"hz", "s", "--interval", "1000"}), environment());
  EXPECT_EQ(hz.line(), "average rate: 100.000 Hz");
  hz.line();
  hz.signal(SIGINT);
  EXPECT_EQ(hz.line(), "--- s:0@pc1: 2 samples, 0 lost ---");
  EXPECT_EQ(hz.line(), "average rate: 100.000 Hz");
  EXPECT_EQ(hz.status(), 0);

  Running as_json(argv({"hz", "s", "--interval", "1000", "--json"}), environment());
  EXPECT_EQ(Json::parse(as_json.line())["final"], false);
  as_json.signal(SIGTERM);
  EXPECT_EQ(Json::parse(as_json.line())["final"], true);
  EXPECT_EQ(as_json.status(), 0);
}

TEST_F(Meter, BwIsTheRateTimesWhatTheSamplesHave) {
  auto wide = session_.create_raw({"wide", 0, ""}, {"", 4000, 1, {}}, depth_of(8)).value();
  const std::vector<std::byte> payload(4000);
  for (int i = 0; i < 5; ++i) wide.write(payload, at_ns(i * 20'000'000));
  const Json report = first_report({"bw", "wide"});
  EXPECT_EQ(report["payload_bytes"], 4000);
  EXPECT_DOUBLE_EQ(report["rate_hz"].get<double>(), 50);
  EXPECT_DOUBLE_EQ(report["bytes_per_second"].get<double>(), 200'000);
  EXPECT_EQ(output({"bw", "wide", "-n", "1"}),
            "average: 195 KiB/s\n\tpayload: 4000 bytes rate: 50.000 Hz window: 5\n");
  for (int i = 5; i < 8; ++i) wide.write(std::span(payload).first(1000), at_ns(i * 20'000'000));
  const Json shorter = first_report({"bw", "wide", "--window", "4"});
  EXPECT_EQ(shorter["payload_bytes"], 4000) << "of the stream";
  EXPECT_DOUBLE_EQ(shorter["mean_payload_bytes"].get<double>(), 1750);
  EXPECT_DOUBLE_EQ(shorter["bytes_per_second"].get<double>(), 87'500);
}

TEST_F(Meter, DelayIsTheAgeOfSamplesWhenTheyArrive) {
  constexpr Duration kAge = 10s;
  const MonoTime begin = MonoClock::now();
  Running delay(argv({"delay", "s", "--json", "--interval", "0.05"}), environment());
  Json report;
  do {
    report = Json::parse(delay.line([&] { writer_.write(0, WallClock::now() - kAge); }));
  } while (report["samples"] == 0);
  const Duration elapsed = MonoClock::now() - begin;
  EXPECT_GE(report["delay_min_ns"].get<std::int64_t>(), to_ns(kAge));
  EXPECT_LE(report["delay_max_ns"].get<std::int64_t>(), to_ns(kAge + elapsed));
  EXPECT_GE(report["delay_mean_ns"].get<double>(), report["delay_min_ns"].get<double>());
  EXPECT_LE(report["delay_mean_ns"].get<double>(), report["delay_max_ns"].get<double>());
  EXPECT_EQ(report["new_samples"], report["seen_samples"]);
  EXPECT_EQ(report["delay_error_ns"], 0);  // one clock
}

TEST_F(Meter, DelayIgnoresSamplesFromBeforeItsStart) {
  write_at({1000, 1010});
  const Json report = first_report({"delay", "s", "--interval", "0.01"});
  EXPECT_EQ(report["seen_samples"], 0);
  EXPECT_TRUE(report["delay_mean_ns"].is_null());
  EXPECT_EQ(output({"delay", "s", "-n", "1", "-i", "0.01"}), "no new samples\n");
}

}  // namespace
}  // namespace dssm::test
