// SPDX-License-Identifier: Apache-2.0
//
// dssm-view --open: a recording as the page and Foxglove's clients meet it, without a dssmd.
#include <gtest/gtest.h>

#include <bit>
#include <dssm/recording.hpp>
#include <memory>

#include "tests/process/view/view_fixture.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

struct DrivenPose {
  double x_m, y_m, theta_rad;
};
DSSM_DESCRIBE(DrivenPose, x_m, y_m, theta_rad)

constexpr std::int64_t kBeginNs = 1'700'000'000'000'000'000;
constexpr std::int64_t kMs = 1'000'000;

Time after(std::int64_t ms) { return at_ns(kBeginNs + ms * kMs); }
std::string ns_after(std::int64_t ms) { return std::to_string(kBeginNs + ms * kMs); }

// Twenty seconds of a pose each 10 ms, whose owner restarted after ten; of the first half ten
// samples were lost, and one of the second is a peak. And of another host a counter each 100 ms,
// and a switch that begins after 1.2 s.
class ViewRecording : public testing::Test {
 protected:
  static constexpr std::int64_t kHalf = 1000;  // samples
  static constexpr double kPeak = 1e6;

  ViewRecording() {
    RecordingWriter writer = RecordingWriter::create(file_).value();
    RecordedStream pose{{"pose", 0, "pc1"}, type_of<DrivenPose>(), 64, {}, 1, {}, {}};
    const std::uint32_t first = writer.add_stream(pose).value();
    pose.incarnation = 2;
    const RecordedStream counter{{"counter", 3, "pc2"}, type_of<double>(), 64, {}, 1, {}, {}};
    const std::uint32_t counts = writer.add_stream(counter).value();
    const RecordedStream late{{"switch", 0, "pc2"}, type_of<double>(), 64, {}, 1, {}, {}};
    const std::uint32_t switches = writer.add_stream(late).value();
    std::uint32_t second = 0;
    for (std::int64_t i = 0; i < 2 * kHalf; ++i) {
      if (i == kHalf) second = writer.add_stream(pose).value();
      const Tid tid = i % kHalf + 1;
      if (i == 500) {
        EXPECT_TRUE(writer.add_gap(first, tid, 10));
      }
      if (i % 10 == 0) write(writer, counts, i / 10 + 1, i * 10, static_cast<double>(i));
      if (i % 10 == 0 && i >= 120) write(writer, switches, i / 10 - 11, i * 10, 1.0);
      if (i >= 500 && i < 510) continue;
      const double x = i == 1234 ? kPeak : static_cast<double>(i);
      write(writer, i < kHalf ? first : second, tid, i * 10, DrivenPose{x, 2, 3});
    }
    EXPECT_TRUE(writer.add_trigger({"bumper", "it touched something", "pc1", after(5000)}));
    EXPECT_TRUE(writer.finish());
    view_ = std::make_unique<Running>(
        view_argv({"--listen", "127.0.0.1:0", "--open", file_}),
        std::vector<std::string>{"DSSM_SOCKET=" + folder_.file("no-dssmd.sock")});
    const std::string line = view_->line();
    const std::size_t at = line.find("http://");
    EXPECT_NE(at, std::string::npos) << line;
    if (at != std::string::npos) url_ = line.substr(at);
  }

  template <class T>
  static void write(RecordingWriter& writer, std::uint32_t stream, Tid tid, std::int64_t ms,
                    const T& value) {
    SampleInfo info;
    info.tid = tid;
    info.time = after(ms);
    info.payload_bytes = sizeof value;
    EXPECT_TRUE(writer.write(stream, info, std::chrono::microseconds(7),
                             std::as_bytes(std::span(&value, 1))));
  }

  Json ask(const Json& request) const {
    const std::vector<std::string> answers = run_client(url_, "ask", {request.dump()});
    return answers.size() == 1 ? Json::parse(answers[0]) : Json();
  }
  // Of the pose at that time.
  double x_at(std::int64_t ms) const {
    const Json answer =
        ask({{"op", "at"}, {"streams", {"pose@pc1", "counter:3@pc2"}}, {"t_ns", ns_after(ms)}});
    const Json& sample = answer["samples"][0];
    EXPECT_EQ(sample["status"], "ok") << answer;
    EXPECT_EQ(answer["samples"][1]["status"], "ok") << answer;
    EXPECT_EQ(sample["clock_error_ns"], "7000");
    const std::string hex = sample.value("payload", "");
    EXPECT_EQ(hex.size(), 2 * sizeof(DrivenPose));
    std::uint64_t x = 0;  // little-endian
    for (std::size_t i = 8; i-- > 0 && hex.size() >= 16;) {
      x = x << 8 | std::stoul(hex.substr(2 * i, 2), nullptr, 16);
    }
    return std::bit_cast<double>(x);
  }

  const TestFolder folder_;
  const std::string file_ = folder_.file("drive.mcap");
  std::unique_ptr<Running> view_;
  std::string url_;
};

// Metrics are the vehicle's.
TEST_F(ViewRecording, HasNoMetrics) {
  const Finished finished = run({"/usr/bin/python3", "-c",
                                 "import sys, urllib.request, urllib.error\n"
                                 "try: urllib.request.urlopen(sys.argv[1])\n"
                                 "except urllib.error.HTTPError as error:\n"
                                 "  print(error.code, error.read().decode())\n",
                                 url_ + "metrics"});
  EXPECT_EQ(finished.out, "404 there is nothing at /metrics; the page is at /\n\n") << finished.err;
}

TEST_F(ViewRecording, IsListedWithItsStreams) {
  const Json answer = ask({{"op", "overview"}});
  EXPECT_EQ(answer["recording"], Json({"drive.mcap"}));
  EXPECT_EQ(answer["range"]["oldest_ns"], ns_after(0));
  EXPECT_EQ(answer["range"]["newest_ns"], ns_after(20 * kHalf - 10));
  ASSERT_EQ(answer["streams"].size(), 3U) << answer;
  const Json& counter = answer["streams"][0];
  EXPECT_EQ(counter["stream"], "counter:3@pc2");
  EXPECT_NEAR(counter["rate_hz"].get<double>(), 10, 0.01);
  const Json& pose = answer["streams"][1];
  EXPECT_EQ(pose["state"], "recorded");
  EXPECT_EQ(pose["samples"], 2 * kHalf - 10);
  EXPECT_EQ(pose["lost_samples"], 10);
  EXPECT_EQ(pose["oldest_ns"], ns_after(0));
  ASSERT_EQ(answer["events"].size(), 1U) << answer;
  EXPECT_EQ(answer["events"][0]["text"], "bumper on pc1: it touched something");
}

TEST_F(ViewRecording, IsReadByTimeAcrossARestart) {
  EXPECT_EQ(x_at(3004), 300);
  EXPECT_EQ(x_at(15'000), 1500);
  EXPECT_EQ(x_at(5050), 499);  // the ones after it were lost
  EXPECT_EQ(x_at(9999), 999);
}

TEST_F(ViewRecording, HasCurvesOfAllOfItWithEachPeak) {
  const Json answer = ask({{"op", "signals"},
                           {"stream", "pose@pc1"},
                           {"fields", {"x_m"}},
                           {"from_ns", ns_after(0)},
                           {"to_ns", ns_after(20 * kHalf)},
                           {"points", 100}});
  EXPECT_EQ(answer["samples"], 2 * kHalf - 10) << answer;
  EXPECT_EQ(answer["lost"], 10);
  EXPECT_EQ(answer["left_out"], 0);
  const Json& curve = answer["curves"][0];
  EXPECT_LE(curve["values"].size(), 110U);
  double greatest = 0, time_s = 0;
  bool has_gap = false;
  for (std::size_t i = 0; i < curve["values"].size(); ++i) {
    if (curve["values"][i].is_null()) {
      has_gap = true;
    } else if (curve["values"][i].get<double>() > greatest) {
      greatest = curve["values"][i];
      time_s = curve["times"][i];
    }
  }
  EXPECT_EQ(greatest, kPeak);
  EXPECT_NEAR(time_s, 12.34, 1e-6);
  EXPECT_TRUE(has_gap);
  const Json part = ask({{"op", "signals"},
                         {"stream", "pose@pc1"},
                         {"fields", {"x_m"}},
                         {"from_ns", ns_after(12'000)},
                         {"to_ns", ns_after(12'045)},
                         {"points", 100}});
  // With one before and one after the range.
  EXPECT_EQ(part["curves"][0]["values"], Json({1200, 1201, 1202, 1203, 1204, 1205}));
}

TEST_F(ViewRecording, IsPlayedByFoxglovesPlaybackControl) {
  const std::string all = joined(
      run_client(url_, "play", {"pause 1 " + ns_after(3004), "play 100 " + ns_after(18'000)}));
  EXPECT_TRUE(contains(all, "from 1700000000.000000000 to 1700000019.990000000\n")) << all;
  EXPECT_TRUE(contains(all, "state paused " + ns_after(3004) + " seek 0\n")) << all;
  EXPECT_TRUE(contains(all, "pose@pc1 " + ns_after(3000) + "\n")) << all;
  EXPECT_TRUE(contains(all, "counter:3@pc2 " + ns_after(3000) + "\n")) << all;
  EXPECT_TRUE(contains(all, "state playing " + ns_after(18'000) + " seek 1\n")) << all;
  EXPECT_TRUE(contains(all, "state ended " + ns_after(19'990) + "\n")) << all;
  // From 18 s on, each once and in order, beside the one that was there.
  EXPECT_TRUE(contains(all, "played pose@pc1 200 in order\n")) << all;
  EXPECT_TRUE(contains(all, "played counter:3@pc2 20 in order\n")) << all;
}

TEST_F(ViewRecording, IsPlayedInTheBrowser) {
  const Finished page = run({"/usr/bin/python3", source("tests/process/view/page.py"), "recording",
                             url_, built("tests/process/view/page"), "pose:0@pc1", "switch:0@pc2",
                             ns_after(0), ns_after(19'990)});
  EXPECT_EQ(page.exit_status, 0) << page.out << page.err;
}

TEST(ViewOpen, SaysWhatIsWrongWithAFile) {
  const TestFolder folder;
  const Finished missing = run(view_argv({"--open", folder.file("none.mcap")}));
  EXPECT_EQ(missing.exit_status, 1);
  EXPECT_TRUE(contains(missing.err, "none.mcap")) << missing.err;
}

}  // namespace
}  // namespace dssm::test
