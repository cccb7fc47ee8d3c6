// SPDX-License-Identifier: Apache-2.0
//
// The page of dssm-view in a browser (page.py). Its screenshots are in the build folder, in
// tests/process/view/page.
#include <signal.h>

#include <cmath>
#include <dssm/recording.hpp>
#include <filesystem>
#include <map>
#include <optional>

#include "tests/process/view/view_fixture.hpp"

namespace dssm::test {
namespace {

struct Wheels {
  double x;
  float speed[2];
  std::int32_t ticks;
};
DSSM_DESCRIBE(Wheels, x, speed, ticks)

struct PlanarScan {
  float first_rad, step_rad;
  float range_m[64];
};
DSSM_DESCRIBE(PlanarScan, first_rad, step_rad, range_m)

struct PlanarPose {
  double x_m, y_m, theta_rad;
};
DSSM_DESCRIBE(PlanarPose, x_m, y_m, theta_rad)

struct Lamp {
  double watts;
  std::int32_t is_on;
};
DSSM_DESCRIBE(Lamp, watts, is_on)

struct Photo {
  std::uint16_t width, height;
  std::uint8_t channels, pixels[3 * 20 * 10];
};
DSSM_DESCRIBE(Photo, width, height, channels, pixels)

// 32 x 16 pixels of the colour 207, 35, 51.
constexpr std::string_view kJpeg =
    "ffd8ffe000104a46494600010100000100010000ffdb004300a06e788c7864a08c828cb4aaa0bef0fffff0dcdcf0"
    "ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffdb00"
    "4301aab4b4f0d2f0ffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffffff"
    "ffffffffffffffffffffffffffffffffffffffffffc00011080010002003012200021101031101ffc40015000101"
    "00000000000000000000000000000002ffc40014100100000000000000000000000000000000ffc4001601010101"
    "00000000000000000000000000000103ffc40014110100000000000000000000000000000000ffda000c03010002"
    "110311003f009011a0003fffd9";

std::vector<std::byte> bytes_of_hex(std::string_view hex) {
  std::vector<std::byte> bytes;
  for (std::size_t i = 0; i < hex.size(); i += 2) {
    bytes.push_back(static_cast<std::byte>(std::stoi(std::string(hex.substr(i, 2)), nullptr, 16)));
  }
  return bytes;
}

constexpr char kMotion[] = "motion:0@pc1";

class ViewPage : public ViewTest {
 protected:
  // page.py in the background, for `check`.
  std::vector<std::string> page_argv(const std::string& check,
                                     std::vector<std::string> arguments) const {
    std::vector<std::string> argv = {"/usr/bin/python3", source("tests/process/view/page.py"),
                                     check, url_, built("tests/process/view/page")};
    argv.insert(argv.end(), arguments.begin(), arguments.end());
    return argv;
  }

  // All lines of `page` until its end; the last one is "ok". Calls `meanwhile` over and over.
  template <class Meanwhile>
  std::vector<std::string> lines(Running& page, Meanwhile meanwhile) {
    std::vector<std::string> lines;
    for (;;) {
      std::string line = page.line(meanwhile);
      if (line.empty()) break;
      lines.push_back(std::move(line));
      if (lines.back() == "ok") break;
    }
    std::string all;
    for (const std::string& line : lines) all += line + "\n";
    EXPECT_TRUE(!lines.empty() && lines.back() == "ok") << all << page.rest();
    return lines;
  }
  void expect_ok(const std::string& check, std::vector<std::string> arguments) {
    Running page(page_argv(check, std::move(arguments)), {});
    lines(page, [] {});
  }
};

TEST_F(ViewPage, ShowsHostsStreamsAndProgramsWhateverTheirNamesAre) {
  const std::string program = "<img src=x onerror=alert(1)>";
  Session other =
      Session::connect({.socket_path = daemon_.socket_path(), .program = program}).value();
  auto motion = other.create<Wheels>("motion", depth_of(8)).value();
  motion.write({});
  auto lidar = on_pc2_.create<double>("lidar:3", depth_of(8)).value();
  await_streams(1);
  auto reader = session_.await_reader<double>("lidar:3").value();
  Running page(page_argv("overview", {program, kMotion, "lidar:3@pc2"}), {});
  for (const std::string& line : lines(page, [] {})) std::printf("%s\n", line.c_str());
}

TEST_F(ViewPage, FollowsASignalAndHoldsIt) {
  for (const char* ended : {"a", "b"}) {
    session_.create<Lamp>(ended, depth_of(8)).value().write({40, 1});
  }
  auto motion = session_.create<Wheels>("motion", depth_of(1000)).value();
  int ticks = 0;
  Running page(page_argv("signal", {kMotion, "x"}), {});
  lines(page, [&] {
    motion.write({std::sin(0.05 * ticks), {0, 0}, ticks});
    ++ticks;
    std::this_thread::sleep_for(std::chrono::milliseconds(10));  // the stream's cycle
  });
}

TEST_F(ViewPage, AlignsPlotsOfAnyValues) {
  auto motion = session_.create<Wheels>("motion", depth_of(100)).value();
  for (int i = 0; i < 50; ++i) {
    const auto x = static_cast<float>(i);
    motion.write({1e10 + i, {1e-8F * x, 3e12F * x}, i}, at_ns(kSecond + i * 10'000'000));
  }
  expect_ok("axes", {kMotion, "x", "speed[0]", "speed[1]", "ticks"});
}

TEST_F(ViewPage, ShowsTheSamplesOfTheSlidersInstantAsDssmctlDoes) {
  constexpr int kSamples = 200;
  constexpr std::int64_t kCycle = 10'000'000;  // ns
  auto motion = session_.create<Wheels>("motion", depth_of(kSamples + 1)).value();
  auto lidar = on_pc2_.create<std::int64_t>("lidar", depth_of(kSamples + 1)).value();
  for (int i = 0; i < kSamples; ++i) {
    motion.write({1.0 * i, {0, 0}, i}, at_ns(1000 * kSecond + i * kCycle));
    lidar.write(i, at_ns(1000 * kSecond + i * kCycle + i % 3 * 1'000'000));
  }
  await_streams(1);
  Running page(page_argv("slider", {kMotion, "lidar:0@pc2"}), {});
  int instants = 0;
  for (const std::string& line : lines(page, [] {})) {
    const std::vector<std::string> words = words_of(line);
    if (words.size() != 4 || words[0] != "at") continue;
    ++instants;
    const std::string& ns = words[1];
    ASSERT_GT(ns.size(), 9U) << line;
    const std::string t = ns.substr(0, ns.size() - 9) + "." + ns.substr(ns.size() - 9);
    EXPECT_EQ(json({"echo", kMotion, "--at", t})["tid"].dump(), words[2]) << line;
    EXPECT_EQ(json({"echo", "lidar:0@pc2", "--at", t})["tid"].dump(), words[3]) << line;
  }
  EXPECT_EQ(instants, 6);
}

TEST_F(ViewPage, StepsFromTheOldestSample) {
  const auto ns = [](std::int64_t i) {  // 1 Hz at first, then 1 kHz
    return 1000 * kSecond + std::min<std::int64_t>(i, 90) * kSecond +
           std::max<std::int64_t>(i - 90, 0) * 1'000'000;
  };
  auto motion = session_.create<Wheels>("motion", depth_of(201)).value();
  for (int i = 0; i < 200; ++i) motion.write({}, at_ns(ns(i)));
  expect_ok("oldest", {kMotion, std::to_string(ns(0)), std::to_string(ns(1))});
}

TEST_F(ViewPage, BeginsWhereARingThatIsWrittenHasSamples) {
  auto motion = session_.create<Wheels>("motion", depth_of(301)).value();  // 3 s
  Running page(page_argv("oldest_live", {kMotion}), {});
  lines(page, [&] {
    motion.write({});
    std::this_thread::sleep_for(std::chrono::milliseconds(10));  // the stream's cycle
  });
}

TEST_F(ViewPage, KeepsWhatIsChosenInItsUrl) {
  auto motion = session_.create<Wheels>("motion", depth_of(8)).value();
  motion.write({});
  expect_ok("link", {kMotion, "x", "speed[1]", "ticks"});
}

TEST_F(ViewPage, DrawsScansPosesImagesAndBytes) {
  PlanarScan wall{-1.5F, 3.0F / 64, {}};
  std::fill(std::begin(wall.range_m), std::end(wall.range_m), 4.0F);
  auto scan = session_.create<PlanarScan>("scan", depth_of(8)).value();
  scan.write(wall);
  auto pose = session_.create<PlanarPose>("pose", depth_of(64)).value();
  pose.write({9, 9, 0}, at_ns(kSecond));  // long before the trail
  for (int i = 0; i < 50; ++i)
    pose.write({0.1 * i, 0.05 * i, 0.5}, at_ns(1000 * kSecond + i * 10'000'000));
  // The pixel at column x and row y is x + y.
  constexpr std::size_t kColumns = 160, kRows = 120;
  std::vector<std::byte> picture(kColumns * kRows);
  for (std::size_t i = 0; i < picture.size(); ++i) {
    picture[i] = static_cast<std::byte>(i % kColumns + i / kColumns);
  }
  auto image =
      session_.create_raw({"camera", 0, ""}, TypeInfo{"", picture.size(), 1, {}}, depth_of(8))
          .value();
  image.write(picture);
  const std::vector<std::byte> some = {std::byte{0xde}, std::byte{0xad}, std::byte{0xbe},
                                       std::byte{0xef}, std::byte{0}};
  auto raw =
      session_.create_raw({"raw", 0, ""}, TypeInfo{"", some.size(), 1, {}}, depth_of(8)).value();
  raw.write(some);
  expect_ok("views", {"scan:0@pc1", "pose:0@pc1", "camera:0@pc1", "raw:0@pc1"});
}

TEST_F(ViewPage, DrawsColours) {
  // The pixel at column x and row y is (x, y, 200) or (x, y, 100).
  const auto fill = [](auto* pixels, std::size_t columns, std::size_t rows, int blue) {
    using Byte = std::remove_pointer_t<decltype(pixels)>;
    for (std::size_t i = 0; i < columns * rows; ++i) {
      pixels[3 * i] = static_cast<Byte>(i % columns);
      pixels[3 * i + 1] = static_cast<Byte>(i / columns);
      pixels[3 * i + 2] = static_cast<Byte>(blue);
    }
  };
  std::vector<std::byte> picture(std::size_t{3} * 160 * 120);
  fill(picture.data(), 160, 120, 200);
  const auto write_raw = [&](const char* name, const std::vector<std::byte>& bytes) {
    auto stream =
        session_.create_raw({name, 0, ""}, TypeInfo{"", bytes.size(), 1, {}}, depth_of(8)).value();
    stream.write(bytes);
    return stream;
  };
  const auto rgb = write_raw("rgb", picture);
  const auto jpeg = write_raw("jpeg", bytes_of_hex(kJpeg));
  Photo photo{20, 10, 3, {}};
  fill(photo.pixels, 20, 10, 100);
  auto described = session_.create<Photo>("photo", depth_of(8)).value();
  described.write(photo);
  expect_ok("pictures", {"rgb:0@pc1", "photo:0@pc1", "jpeg:0@pc1"});
}

TEST_F(ViewPage, EmptiesViewsWithoutASampleAtTheInstant) {
  auto early = session_.create<Wheels>("early", depth_of(8)).value();
  auto late = session_.create<Wheels>("late", depth_of(8)).value();
  std::vector<std::byte> grey(160 * 120, std::byte{70});
  auto image =
      session_.create_raw({"camera", 0, ""}, TypeInfo{"", grey.size(), 1, {}}, depth_of(8)).value();
  for (const std::int64_t ms : {0, 500, 1000}) {
    const Time time = at_ns(1000 * kSecond + ms * 1'000'000);
    early.write({}, time);
    if (ms == 0) continue;
    late.write({}, time);
    image.write(grey, time);
  }
  expect_ok("absent", {"early:0@pc1", "late:0@pc1", "camera:0@pc1"});
}

TEST_F(ViewPage, ShowsFieldsThatAreKnownLater) {
  const StreamId wheel{"wheel_state", 0, ""}, lamp{"lamp", 0, ""};
  const std::vector<std::byte> bytes(16);
  for (const StreamId& id : {wheel, lamp}) {
    const char* const type = id == wheel ? "WheelState" : "";
    session_.create_raw(id, TypeInfo{type, bytes.size(), 8, {}}, depth_of(8)).value().write(bytes);
  }
  Running page(page_argv("described_later", {"wheel_state:0@pc1", "lamp:0@pc1", "travel_m"}), {});
  ASSERT_EQ(page.line(), "hex") << page.rest();
  {
    Running program({built("tests/process/view/state_writer")}, {daemon_.environment()});
    ASSERT_EQ(page.line(), "of the program") << page.rest();
  }
  output({"describe", "lamp", "--from", built("tests/process/view/state_writer"), "--type",
          "LampState"});
  lines(page, [] {});
}

TEST_F(ViewPage, ShowsTheFieldsOfAStreamThatIsCreatedAgain) {
  auto wheels = std::optional(session_.create<Wheels>("thing", depth_of(8)).value());
  wheels->write({});
  Running page(page_argv("recreated", {"thing:0@pc1", "watts"}), {});
  ASSERT_EQ(page.line(), "shown") << page.rest();
  ASSERT_TRUE(session_.remove(wheels->id()));
  auto lamp = session_.create<Lamp>("thing", depth_of(8)).value();
  lamp.write({40, 1});
  lines(page, [] {});
}

TEST_F(ViewPage, ExportsWhatThePlotsShow) {
  constexpr int kSamples = 100;
  constexpr std::int64_t kCycle = 10'000'000;  // ns
  auto motion = session_.create<Wheels>("motion", depth_of(kSamples + 1)).value();
  for (int i = 0; i < kSamples; ++i) {
    motion.write({0.1 * i, {}, -i}, at_ns(1000 * kSecond + i * kCycle));
  }
  Running page(page_argv("export", {kMotion, "x", "ticks"}), {});
  std::map<std::string, std::string> files;
  for (const std::string& line : lines(page, [] {})) {
    const std::vector<std::string> words = words_of(line);
    if (words.size() == 2) files[words[0]] = words[1];
  }
  const std::vector<std::string> rows = lines_of(text_of(files["csv"]));
  ASSERT_EQ(rows.size(), 1U + kSamples);
  EXPECT_EQ(rows[0], "time_ns,motion:0@pc1 tid,motion:0@pc1 x,motion:0@pc1 ticks");
  EXPECT_EQ(rows[1], "1000000000000,0,0,0");
  EXPECT_EQ(rows[51], "1000500000000,50,5,-50");
  EXPECT_TRUE(text_of(files["png"]).starts_with("\x89PNG"));
  std::filesystem::rename(files["png"], built("tests/process/view/page/export.png"));
  std::filesystem::remove(files["csv"]);
}

TEST_F(ViewPage, SavesARecordingAndShowsAProperty) {
  auto motion = session_.create<Wheels>("motion", depth_of(101)).value();
  for (int i = 0; i < 100; ++i) motion.write({0.5 * i, {}, i});
  constexpr std::string_view kProperty = "wheel_m = 0.1";
  ASSERT_TRUE(motion.set_property(std::as_bytes(std::span(kProperty))));
  Running page(page_argv("save", {kMotion}), {});
  std::string path;
  for (const std::string& line : lines(page, [] {})) {
    if (line.starts_with("saved ")) path = line.substr(6);
  }
  const Recording recording = Recording::open(path).value();
  ASSERT_EQ(recording.streams().size(), 1U);
  EXPECT_EQ(recording.streams()[0].samples, 100U);
  std::filesystem::remove(path);
}

// Its first 50 seconds, all of which the rings hold.
TEST_F(ViewPage, ShowsTheDriveOfTheExample) {
  const std::string programs = "docs/examples/vehicle/";
  if (!std::filesystem::exists(built(programs + "lidar"))) {
    GTEST_SKIP() << "the example is not built";
  }
  // The encoder's debug information is there until it ends, 2.5 s after that.
  const std::string start_at =
      std::to_string(to_ns(WallClock::now() + std::chrono::seconds(6)) / kSecond);
  const auto replay = [&](const std::string& program, const DaemonProcess& dssmd) {
    return Running(
        {built(programs + program), "--log", source(programs + "data/freiburg-079.carmen.log.gz"),
         "--speed", "20", "--to", "50", "--start-at", start_at},
        {dssmd.environment()});
  };
  // Both programs may be slow, but no scan is to be left out.
  Running localizer({built(programs + "localizer"), "--deadline", "60"}, {daemon_.environment()});
  Running encoder = replay("encoder", daemon_), lidar = replay("lidar", pc2_);
  // Of a program of SSM, which describes nothing: the fields are in its debug information.
  Json odometry;
  await([&] {
    const auto answers = run_client(url_, "ask", {R"({"op":"type","stream":"odometry@pc1"})"});
    odometry = answers.size() == 1 ? Json::parse(answers[0]) : Json::object();
    return odometry.value("status", "") == "ok";
  });
  EXPECT_TRUE(contains(odometry.dump(), "theta_rad")) << odometry;
  expect_ok("drive", {"lidar:0@pc2", "pose:0@pc1"});
}

TEST_F(ViewPage, ShowsThatAHostIsDown) {
  auto lamp = on_pc2_.create<Lamp>("lamp", depth_of(8)).value();
  lamp.write({40, 1});
  await_streams(1);
  Running page(page_argv("host_down", {"pc2", "lamp:0@pc2"}), {});
  ASSERT_EQ(page.line(), "ready") << page.rest();
  pc2_.kill_hard();
  lines(page, [] {});
}

TEST_F(ViewPage, ReconnectsToDssmView) {
  Running page(page_argv("reconnect", {}), {});
  ASSERT_EQ(page.line(), "ready") << page.rest();
  view_.signal(SIGKILL);
  view_.status();
  ASSERT_EQ(page.line(), "lost") << page.rest();
  const std::string address = url_.substr(std::string("http://").size());
  Running again(view_argv({"--listen", address.substr(0, address.size() - 1)}), environment());
  ASSERT_TRUE(contains(again.line(), url_));
  lines(page, [] {});
}

TEST_F(ViewPage, FitsAPhone) {
  auto motion = session_.create<Wheels>("a-name-as-long-as-it-is-allowed", depth_of(8)).value();
  motion.write({});
  auto reader = session_.await_reader<Wheels>(motion.id().str()).value();
  expect_ok("phone", {motion.id().str()});
}

}  // namespace
}  // namespace dssm::test
