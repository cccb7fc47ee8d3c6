// SPDX-License-Identifier: Apache-2.0
//
// dssmctl property and playback.
#include <fstream>
#include <iterator>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

struct Property : CtlTest {
  Writer<double> writer_ = session_.create<double>("s", depth_of(4)).value();
  const std::string bytes_{"\0\x01\xff calib\n", 10};
};

TEST_F(Property, GivesBackTheBytesThatWereSet) {
  const Finished set = ctl({"property", "set", "s"}, bytes_);
  EXPECT_EQ(set.exit_status, 0) << set.err;
  EXPECT_EQ(set.out, "s:0@pc1: property of 10 bytes set\n");
  EXPECT_EQ(output({"property", "get", "s"}), bytes_);
  const Json property = json({"property", "get", "s"});
  EXPECT_EQ(property["stream"], "s:0@pc1");
  EXPECT_EQ(property["property_bytes"], 10);
  EXPECT_EQ(property["property_hex"], "0001ff2063616c69620a");
}

TEST_F(Property, ComesFromAndGoesToFiles) {
  const std::string in = daemon_.runtime_dir() + "/in";
  const std::string out = daemon_.runtime_dir() + "/out";
  std::ofstream(in) << bytes_;
  EXPECT_EQ(json({"property", "set", "s", in})["property_bytes"], 10);
  EXPECT_EQ(output({"property", "get", "s", out}), "");
  std::ifstream file(out);
  EXPECT_EQ(std::string(std::istreambuf_iterator<char>(file), {}), bytes_);
}

TEST_F(Property, IsMissingUntilSetAndAfterSettingNothing) {
  Finished get = ctl({"property", "get", "s"});
  EXPECT_EQ(get.exit_status, 1);
  EXPECT_NE(get.err.find("'s:0"), std::string::npos) << get.err;
  EXPECT_EQ(ctl({"property", "set", "s"}, "x").exit_status, 0);
  EXPECT_EQ(ctl({"property", "set", "s", "/dev/null"}).exit_status, 0);
  EXPECT_EQ(ctl({"property", "get", "s"}).exit_status, 1);
}

TEST_F(Property, NamesTheFileOrStreamThatIsMissing) {
  const Finished file = ctl({"property", "set", "s", "/nonexistent/file"});
  EXPECT_EQ(file.exit_status, 1);
  EXPECT_NE(file.err.find("'/nonexistent/file'"), std::string::npos) << file.err;
  const Finished stream = ctl({"property", "set", "t"}, "x");
  EXPECT_EQ(stream.exit_status, 1);
  EXPECT_NE(stream.err.find("is it 's'?"), std::string::npos) << stream.err;
}

TEST_F(Property, RefusesToReadWithoutEnd) {
  const Finished finished = ctl({"property", "set", "s", "/dev/zero"});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_NE(finished.err.find("longer than the 1.00 MiB"), std::string::npos) << finished.err;
}

using Playback = CtlTest;

TEST_F(Playback, ShowsAndTurnsTheClock) {
  const PlaybackClock clock = session_.open_playback_clock().value();
  EXPECT_EQ(json({"playback"})["speed"], 1.0);
  EXPECT_EQ(json({"playback", "set", "--speed", "2", "--offset", "5"})["offset_s"], 5.0);
  EXPECT_EQ(clock.setting().speed, 2);
  EXPECT_EQ(clock.setting().offset_s, 5);
  EXPECT_TRUE(contains(output({"playback", "pause"}), "paused:  yes\n"));
  EXPECT_TRUE(clock.setting().paused);
  output({"playback", "set", "--time", "1000"});
  EXPECT_NEAR(clock.now_s(), 1000, 1e-6);
  const std::string text = output({"playback", "show"});
  EXPECT_NE(text.find("time:    1000.000000 s\n"), std::string::npos) << text;
  EXPECT_TRUE(contains(output({"playback", "show", "--iso"}), "time:    1970-01-01T00:16:40.0"));
  output({"playback", "set", "--time", "2026-11-27T08:00:00Z"});
  EXPECT_NEAR(clock.now_s(), 1'795'766'400, 1e-3);
  EXPECT_NE(text.find("paused:  yes\n"), std::string::npos) << text;
  output({"playback", "resume"});
  EXPECT_FALSE(clock.setting().paused);
  output({"playback", "reset"});
  EXPECT_EQ(clock.setting().speed, 1);
  EXPECT_EQ(clock.setting().offset_s, 0);
}

}  // namespace
}  // namespace dssm::test
