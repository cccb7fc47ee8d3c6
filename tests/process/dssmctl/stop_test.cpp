// SPDX-License-Identifier: Apache-2.0
//
// How the verbs that run without end come to one.
#include <signal.h>

#include <array>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

const char* const kEndlessVerbs[] = {"echo", "hz", "bw", "delay"};

struct Stop : CtlTest {
  Writer<double> writer_ = session_.create<double>("s", depth_of(1 << 14)).value();

  // Waits until `readers` processes read the stream, dssmctl among them.
  void await_readers(std::uint32_t readers) {
    await([&] { return session_.stream_info(writer_.id()).value().readers == readers; });
  }
};

TEST_F(Stop, EndsWithSuccessOnASignalWhileNothingIsWritten) {
  for (const char* verb : kEndlessVerbs) {
    for (const int number : {SIGINT, SIGTERM}) {
      Running running(argv({verb, "s", "--wait", "1"}), environment());
      await_readers(1);
      running.signal(number);
      running.rest();
      EXPECT_EQ(running.status(), 0) << verb;
      await_readers(0);
    }
  }
}

TEST_F(Stop, EndsWithSuccessOnASignalWhileAwaitingAStream) {
  Running running(argv({"echo", "never", "--wait", "1000"}), environment());
  EXPECT_TRUE(contains(running.line(), "waits up to 16m40s: "));
  running.signal(SIGINT);
  EXPECT_EQ(running.rest(), "");
  EXPECT_EQ(running.status(), 0);
}

TEST_F(Stop, EndsQuietlyWhenItsReaderHasEnough) {
  Running echo(argv({"echo", "s"}), environment());
  EXPECT_TRUE(echo.line([&] { writer_.write(1); }).starts_with("tid: "));
  echo.close_output();
  for (int i = 0; i < 1000; ++i) writer_.write(1);
  EXPECT_EQ(echo.status(), 0);
}

TEST_F(Stop, EndsQuietlyWhenItsReaderHasEnoughWhileNothingIsWritten) {
  for (const char* verb : kEndlessVerbs) {
    Running running(argv({verb, "s", "--wait", "1"}), environment());
    await_readers(1);
    running.close_output();
    EXPECT_EQ(running.status(), 0) << verb;
    await_readers(0);
  }
}

TEST_F(Stop, ShowsTheLastSamplesOfARemovedStreamAndFails) {
  Running echo(argv({"echo", "s", "--csv"}), environment());
  echo.line();
  echo.line([&] { writer_.write(1); });
  const Tid last = writer_.write(2);
  ASSERT_TRUE(session_.remove(writer_.id()));
  const std::vector<std::string> lines = lines_of(echo.rest());
  EXPECT_EQ(echo.status(), 1);
  ASSERT_GE(lines.size(), 2U);
  EXPECT_TRUE(lines[lines.size() - 2].starts_with(std::to_string(last) + ","))
      << lines[lines.size() - 2];
  EXPECT_TRUE(lines.back().starts_with("dssmctl: echo: ")) << lines.back();
  EXPECT_NE(lines.back().find("'s:0@pc1': it was removed"), std::string::npos) << lines.back();
}

TEST_F(Stop, MeasuresOnceMoreWhenTheStreamIsRemoved) {
  writer_.write(1, at_ns(0));
  writer_.write(1, at_ns(10'000'000));
  Running hz(argv({"hz", "s", "--interval", "1000"}), environment());
  EXPECT_EQ(hz.line(), "average rate: 100.000 Hz");
  hz.line();
  ASSERT_TRUE(session_.remove(writer_.id()));
  EXPECT_EQ(hz.line(), "--- s:0@pc1: 2 samples, 0 lost ---");
  EXPECT_NE(hz.rest().find("it was removed"), std::string::npos);
  EXPECT_EQ(hz.status(), 1);
}

TEST_F(Stop, ContinuesWithARecreatedStream) {
  ASSERT_TRUE(session_.remove(writer_.id()));
  writer_ = session_.create<double>("s", depth_of(1 << 20)).value();  // nobody is lapped
  writer_.write(1);
  Running echo(argv({"echo", "s", "--json"}), environment());
  Running hz(argv({"hz", "s", "--json", "--interval", "0.05"}), environment());
  EXPECT_EQ(Json::parse(echo.line([&] { writer_.write(1); }))["restarts"], 0);
  EXPECT_EQ(Json::parse(hz.line())["restarts"], 0);
  ASSERT_TRUE(session_.remove(writer_.id()));
  writer_ = session_.create<double>("s", depth_of(16)).value();
  for (int i = 0; i < 3; ++i) writer_.write(i);

  const auto await_news = [](Running& running) {
    std::string line;
    while ((line = running.line()).starts_with('{')) {
    }
    EXPECT_EQ(line, "dssmctl: 's:0@pc1': the stream restarted");
  };
  await_news(echo);
  for (int tid = 0; tid < 3; ++tid) {
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

TEST_F(Stop, FailsWhenTheStreamIsRecreatedWithAnotherType) {
  Running echo(argv({"echo", "s"}), environment());
  echo.line([&] { writer_.write(1); });
  ASSERT_TRUE(session_.remove(writer_.id()));
  auto other = session_.create<float>("s", depth_of(16)).value();
  const std::string rest = echo.rest();
  EXPECT_NE(rest.find("continue with the new ring of 's:0@pc1'"), std::string::npos) << rest;
  EXPECT_EQ(echo.status(), 1);
}

TEST_F(Stop, ContinuesWhileTheDaemonIsDownAndAfterwards) {
  Running echo(argv({"echo", "s", "--json"}), environment());
  std::int64_t tid = Json::parse(echo.line([&] { writer_.write(1); }))["tid"];
  const auto follow = [&] {
    const Tid written = writer_.write(1);
    while (tid < written) {
      const Json line = Json::parse(echo.line(), nullptr, false);
      ASSERT_TRUE(line.is_object()) << line;
      EXPECT_EQ(line["tid"], tid + 1);
      tid = line["tid"];
    }
  };
  daemon_.kill_hard();
  ASSERT_NO_FATAL_FAILURE(follow());
  daemon_.start();
  await_readers(1);
  ASSERT_NO_FATAL_FAILURE(follow());
  ASSERT_TRUE(session_.remove(writer_.id()));
  EXPECT_NE(echo.rest().find("it was removed"), std::string::npos);
  EXPECT_EQ(echo.status(), 1);
}

// From its first sample on echo has all that it needs to go on without dssmd.
TEST_F(Stop, ContinuesWhenTheDaemonEndsWhileTheFirstSampleIsShown) {
  using Large = std::array<double, 1 << 14>;
  Writer<Large> writer = session_.create<Large>("large", depth_of(4)).value();
  writer.write(Large{});
  Running echo(argv({"echo", "large", "--last", "-n", "2", "--full", "--json"}), environment());
  echo.await_output();
  daemon_.kill_hard();
  for (int tid = 0; tid < 2; ++tid) {
    const Json line = Json::parse(echo.line(), nullptr, false);
    ASSERT_TRUE(line.is_object()) << line;
    EXPECT_EQ(line["tid"], tid);
    writer.write(Large{});
  }
  EXPECT_EQ(echo.rest(), "");
  EXPECT_EQ(echo.status(), 0);
}

}  // namespace
}  // namespace dssm::test
