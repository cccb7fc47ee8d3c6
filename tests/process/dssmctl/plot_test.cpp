// SPDX-License-Identifier: Apache-2.0
//
// dssmctl plot.
#include <pty.h>
#include <signal.h>
#include <sys/ioctl.h>
#include <termios.h>

#include <algorithm>
#include <utility>

#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;
using Strings = std::vector<std::string>;

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

class PlotOnATerminal : public Plot {
 protected:
  ~PlotOnATerminal() override {
    if (pid_ > 0) ::kill(pid_, SIGKILL), wait_for(pid_);
    if (terminal_ >= 0) ::close(terminal_);
  }

  void plot(Strings words) {
    words.insert(words.begin(), "plot");
    const winsize size{.ws_row = 12, .ws_col = 60, .ws_xpixel = 0, .ws_ypixel = 0};
    words = argv(words);
    std::vector<char*> pointers;
    for (std::string& word : words) pointers.push_back(word.data());
    pointers.push_back(nullptr);
    std::string socket = environment().front();
    pid_ = ::forkpty(&terminal_, nullptr, nullptr, &size);
    if (pid_ == 0) {
      ::putenv(socket.data());
      ::setenv("LC_ALL", "C.UTF-8", 1);
      ::execv(pointers[0], pointers.data());
      ::_exit(127);
    }
  }

  // Until the terminal has got all of these.
  void await_shown(const Strings& parts) {
    const auto is_missing = [&](const std::string& part) { return !contains(shown_, part); };
    while (std::any_of(parts.begin(), parts.end(), is_missing)) {
      ASSERT_TRUE(read_some()) << shown_;
      if (shown_.size() > 100'000) FAIL() << shown_;
    }
  }
  bool read_some() {
    char buffer[4096];
    const ssize_t got = ::read(terminal_, buffer, sizeof buffer);
    if (got > 0) shown_.append(buffer, static_cast<std::size_t>(got));
    return got > 0;
  }

  // Reads all until the program has ended, and returns its status.
  int end() {
    while (read_some()) {
    }
    return wait_for(std::exchange(pid_, -1));
  }

  std::string shown_;
  pid_t pid_ = -1;
  int terminal_ = -1;
};

TEST_F(PlotOnATerminal, DrawsUntilCtrlC) {
  write(50);
  plot({"a.wave.height"});
  // The newest value, the right end of the ramp, which is at the top, and the keys.
  await_shown({"24.5", "\xe2\xa0\x8a", "q quit"});
  const EndingSignal sent(pid_, SIGINT);
  EXPECT_EQ(end(), 0);
}

TEST_F(PlotOnATerminal, EndsByQ) {
  write(50);
  plot({"a.wave.height", "a.wave.ranges[2]"});
  await_shown({"24.5", "q quit"});
  ASSERT_EQ(::write(terminal_, "xq", 2), 2);  // another key does nothing
  EXPECT_EQ(end(), 0);
  // Of two charts no line was cut off: the keys come last, and nothing typed is among them.
  EXPECT_TRUE(contains(shown_, "q quit\x1b[K\r\n\x1b[J")) << shown_;
  EXPECT_FALSE(contains(shown_, "xq")) << shown_;
  termios now{};
  ASSERT_EQ(::tcgetattr(terminal_, &now), 0);
  EXPECT_TRUE(now.c_lflag & ECHO);
}

}  // namespace
}  // namespace dssm::test
