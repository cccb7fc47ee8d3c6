// SPDX-License-Identifier: Apache-2.0
//
// Names for the bytes of an SSM program: its struct is unedited, and dssmctl reads it from the
// program's debug information.
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <signal.h>

#include <array>
#include <chrono>
#include <optional>

#include "tests/process/ssm/run_program.hpp"
#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

// The programs of these tests name their types by a typedef, and use some of them nowhere.
#ifdef __clang__
#define SKIP_WITHOUT_NAMES() GTEST_SKIP() << "clang's debug information lacks names of their types"
#else
#define SKIP_WITHOUT_NAMES()
#endif

using testing::AnyOf;
using testing::HasSubstr;
using testing::Not;

const StreamId kStream{"spur_odometry", 3, {}};

// The stream that the program old_logger reads: 40 bytes, and nothing more is known of them.
struct Describe : testing::Test {
  DaemonProcess daemon{{"--log-level", "warning"}};
  Session session = connect(daemon);
  const std::string folder = make_temp_dir();
  RawWriter writer =
      session.create_raw(kStream, {"", 40, 1, {}}, History{10, std::chrono::milliseconds(50)})
          .value();
  std::optional<PipedProgram> program;

  Describe() {
    constexpr std::array<double, 3> kWheels{0.05, 0.051, 0.3};
    EXPECT_TRUE(writer.set_property(std::as_bytes(std::span(kWheels))));
    constexpr std::array<double, 5> kOdometry{1.5, -2, 0.25, 3, 4};
    writer.write(std::as_bytes(std::span(kOdometry)), time_from_ns(1'000'000'000));
  }
  ~Describe() override {
    if (program) end_program();
    remove_tree(folder);
  }

  void start_program(const std::string& name) {
    program.emplace(
        std::vector<std::string>{built("tests/process/ssm/" + name), folder + "/odometry.log"},
        daemon.environment());
    EXPECT_EQ(program->line(), "start");
  }
  void end_program() {
    ::kill(program->pid(), SIGINT);
    std::string rest;
    EXPECT_EQ(program->end(rest), 0);
    program.reset();
  }
  Finished ctl(std::vector<std::string> words) const {
    words.insert(words.begin(), built("client/dssmctl/dssmctl"));
    return run(words, {daemon.environment()});
  }
};

TEST_F(Describe, GivesTheStreamOfAProgramNamesThatStay) {
  SKIP_WITHOUT_NAMES();
  start_program("old_logger-debug");
  const Finished described = ctl({"describe", "spur_odometry:3"});
  ASSERT_EQ(described.exit_status, 0) << described.err;
  EXPECT_THAT(described.out, HasSubstr("'Spur_Odometry' (40 bytes, aligned to 8), from "
                                       "'old_logger-debug' (pid"));
  EXPECT_THAT(described.out, HasSubstr("theta"));
  end_program();
  daemon.kill_hard();
  daemon.start();
  await([&] { return session.stream_info(kStream).has_value(); });

  const Finished echo = ctl({"echo", "--last", "--json", "spur_odometry:3"});
  ASSERT_EQ(echo.exit_status, 0) << echo.err;
  EXPECT_THAT(echo.out, HasSubstr(R"("fields":{"x":1.5,"y":-2.0,"theta":0.25,"v":3.0,"w":4.0})"));
  EXPECT_EQ(echo.err, "");
  const std::string recording = folder + "/odometry.mcap";
  const Finished record = ctl({"record", "--past", "1h", "spur_odometry:3", "-o", recording});
  ASSERT_EQ(record.exit_status, 0) << record.err;
  EXPECT_THAT(ctl({"info", "--json", recording}).out, HasSubstr("theta"));

  const Finished again = ctl({"describe", "spur_odometry:3", "--from", "/proc/self/exe"});
  EXPECT_EQ(again.exit_status, 1);
  EXPECT_THAT(again.err, HasSubstr("--force"));
  EXPECT_THAT(again.err, Not(HasSubstr("theta"))) << "one line, whatever the type has";
}

TEST_F(Describe, EchoAndRecordTakeTheFieldsOfAProgramThatRuns) {
  start_program("old_logger-debug");
  const Finished echo = ctl({"echo", "--last", "spur_odometry:3"});
  ASSERT_EQ(echo.exit_status, 0) << echo.err;
  EXPECT_THAT(echo.out, HasSubstr("theta: 0.25\n"));
  EXPECT_THAT(echo.err,
              HasSubstr("dssmctl describe spur_odometry:3@pc1` shows it so everywhere\n"));
  const Finished plot = ctl({"plot", "spur_odometry:3.theta", "--for", "10ms"});
  EXPECT_EQ(plot.exit_status, 0) << plot.err;
  EXPECT_THAT(plot.out, HasSubstr(" 0.25\n"));
  const std::string file = folder + "/odometry.mcap";
  const Finished record = ctl({"record", "--for", "10ms", "-o", file});
  EXPECT_EQ(record.exit_status, 0) << record.err;
  EXPECT_THAT(
      record.err,
      HasSubstr("dssmctl: record: with fields from the debug information of their programs: "
                "spur_odometry:3@pc1\n"));
  EXPECT_THAT(ctl({"info", "--json", file}).out, HasSubstr("theta"));
  const Finished others =
      ctl({"record", "--for", "10ms", "--type", "Other", "-o", folder + "/other.mcap"});
  EXPECT_EQ(others.exit_status, 0) << others.err;
  EXPECT_THAT(others.err, Not(HasSubstr("debug information"))) << "the stream is not recorded";
  EXPECT_TRUE(session.stream_info(kStream)->type.fields.empty()) << "they change nothing";
}

TEST_F(Describe, SaysWhyThereAreNoNames) {
  SKIP_WITHOUT_NAMES();
  start_program("old_logger-gnu++98");
  const Finished bare = ctl({"describe", "spur_odometry:3"});
  EXPECT_EQ(bare.exit_status, 1);
  EXPECT_THAT(bare.err, HasSubstr("'old_logger-gnu++98' (pid"));
  // Sanitizers bring some types into a program without any.
  EXPECT_THAT(bare.err, AnyOf(HasSubstr("compile it with -g"), HasSubstr("no type of 40 bytes")));
  EXPECT_THAT(bare.err, HasSubstr("--from"));
  EXPECT_THAT(ctl({"echo", "--last", "spur_odometry:3"}).out, HasSubstr("payload: 40 bytes"));
  const Finished all = ctl({"describe"});
  EXPECT_EQ(all.exit_status, 1);
  EXPECT_THAT(all.err, HasSubstr("some streams could not be described"));

  const std::string debug = built("tests/process/ssm/old_logger-debug");
  const Finished other =
      ctl({"describe", "spur_odometry:3", "--from", debug, "--type", "Spur_Odometry_Property"});
  EXPECT_EQ(other.exit_status, 1);
  EXPECT_THAT(other.err, HasSubstr("24 bytes"));
  const Finished file =
      ctl({"describe", "spur_odometry:3", "--from", debug, "--type", "Spur_Odometry"});
  EXPECT_EQ(file.exit_status, 0) << file.err;
  EXPECT_THAT(file.out, Not(HasSubstr("not described")));
}

}  // namespace
}  // namespace dssm::test
