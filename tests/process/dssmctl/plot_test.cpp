// SPDX-License-Identifier: Apache-2.0
//
// dssmctl plot.
#include <pty.h>
#include <signal.h>
#include <sys/ioctl.h>

#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct Wave {
  double height;
  float ranges[3];
};
DSSM_DESCRIBE(Wave, height, ranges)

class Plot : public FleetTest {
 protected:
  Plot() { await_streams(1); }

  // A ramp, a sample each 100 ms.
  void write(int samples) {
    for (int i = 0; i < samples; ++i, ++written_) {
      wave_.write({0.5 * written_, {1, 2, static_cast<float>(written_)}},
                  at_ns(1'000'000'000) + written_ * 100ms);
    }
  }

  Writer<Wave> wave_ = on_pc2_.create<Wave>("a.wave", depth_of(1000)).value();
  int written_ = 0;
};

TEST_F(Plot, PrintsRowsWithoutATerminal) {
  write(4);
  std::string rows;
  await([&] {  // until the other host has sent them
    rows = output({"plot", "a.wave.height", "a.wave.ranges[2]", "--for", "10ms"});
    return contains(rows, "1.300000000 1.5 3\n");
  });
  const Json row =
      Json::parse(lines_of(output({"--json", "plot", "a.wave.height", "--for", "10ms"})).back());
  EXPECT_EQ(row["time_ns"], 1'300'000'000);
  EXPECT_EQ(row["values"]["a.wave.height"], 1.5);
}

TEST_F(Plot, SaysWhichFieldsThereAre) {
  const auto refused = [&](const std::string& target) {
    const Finished plot = ctl({"plot", target});
    EXPECT_EQ(plot.exit_status, 2) << plot.err;
    return plot.err;
  };
  EXPECT_TRUE(contains(refused("a.wave.depth"), "no field 'depth'; there are 'height', 'ranges'"));
  EXPECT_TRUE(contains(refused("a.wave.ranges"), "name one of them, as a.wave.ranges[0]"));
  EXPECT_TRUE(contains(refused("a.wave.ranges[3]"), "no field"));
  EXPECT_TRUE(contains(refused("wave"), "is not STREAM.FIELD, as odometry.x"));
  (void)session_.create_raw({"raw", 0, ""}, {"", 8, 1, {}}, depth_of(4)).value();
  EXPECT_TRUE(contains(refused("raw.x"), "`dssmctl describe raw:0@pc1` may find them"));
  EXPECT_EQ(ctl({"plot", "nothing.x"}).exit_status, 1);
}

TEST_F(Plot, WritesFilesByGnuplot) {
  TestFolder folder;
  const std::string png = folder.file("a b.png"), svg = folder.file("a.svg");
  const Finished nothing = ctl({"plot", "a.wave.height", "--out", svg});
  EXPECT_EQ(nothing.exit_status, 1);
  EXPECT_TRUE(contains(nothing.err, "nothing was written to the stream yet")) << nothing.err;
  write(50);
  output({"plot", "a.wave.height", "a.wave.ranges[2]", "--out", png});
  EXPECT_TRUE(text_of(png).starts_with("\x89PNG"));
  output({"plot", "a.wave.height", "--out", svg});
  const std::string drawn = text_of(svg);
  EXPECT_TRUE(contains(drawn, "<svg")) << drawn;
  EXPECT_TRUE(contains(drawn, "a.wave.height")) << drawn;
  const Finished nowhere = ctl({"plot", "a.wave.height", "--out", folder.file("none/a.svg")});
  EXPECT_EQ(nowhere.exit_status, 1);
  EXPECT_EQ(nowhere.out, "");
  EXPECT_EQ(lines_of(nowhere.err).size(), 1U) << nowhere.err;
  EXPECT_TRUE(contains(ctl({"plot", "a.wave.height", "--out", "a.jpg"}).err,
                       "does not end in .svg or .png"));
}

TEST_F(Plot, DrawsOnATerminal) {
  write(50);
  int terminal = -1;
  winsize size{.ws_row = 12, .ws_col = 60, .ws_xpixel = 0, .ws_ypixel = 0};
  std::vector<std::string> words = argv({"plot", "a.wave.height"});
  std::vector<char*> pointers;
  for (std::string& word : words) pointers.push_back(word.data());
  pointers.push_back(nullptr);
  std::string socket = environment().front();
  const pid_t pid = ::forkpty(&terminal, nullptr, nullptr, &size);
  if (pid == 0) {
    ::putenv(socket.data());
    ::setenv("LC_ALL", "C.UTF-8", 1);
    ::execv(pointers[0], pointers.data());
    ::_exit(127);
  }
  std::string shown;
  char buffer[4096];
  // The newest value, then the right end of the ramp, which is at the top.
  while (!contains(shown, "24.5") || !contains(shown, "\xe2\xa0\x8a")) {
    const ssize_t got = ::read(terminal, buffer, sizeof buffer);
    ASSERT_GT(got, 0) << shown;
    shown.append(buffer, static_cast<std::size_t>(got));
    if (shown.size() > 100'000) FAIL() << shown;
  }
  const EndingSignal sent(pid, SIGINT);
  EXPECT_EQ(wait_for(pid), 0);
  ::close(terminal);
}

}  // namespace
}  // namespace dssm::test
