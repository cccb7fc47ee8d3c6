// SPDX-License-Identifier: Apache-2.0
//
// The watch, with a chronyd and clocks that do what the test says.
#include "daemon/clock/clock_watch.hpp"

#include <fcntl.h>
#include <sys/resource.h>

#include "tests/unit/daemon/clock/fake_chronyd.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

class LinesLogger final : public Logger {
 public:
  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override {
    // Only that a descriptor is missing is no event of the clock.
    EXPECT_EQ(fields.message_id.empty(), text.starts_with("watch the wall clock")) << text;
    lines.push_back((level == LogLevel::warning ? "warning: " : "") + std::string(text));
  }
  std::vector<std::string> lines;
};

class ClockWatchTest : public testing::Test, protected ClockWatch::Observer {
 protected:
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  LinesLogger logger;
  clock::Instant now{MonoTime(1000s), Time(1'795'000'000s), {}};
  clock::Tick tick;
  clock::Tracking tracking;
  Duration age{};  // of its last measurement
  bool is_silent = false;
  int requests = 0;
  FakeChronyd chronyd{loop, [this](const FakeChronyd::Request& request) {
                        ++requests;
                        tracking.updated = now.wall - tracking.offset - age;
                        if (!is_silent) chronyd.answer(request, reply_of(tracking));
                      }};
  std::unique_ptr<ClockWatch> watch;
  int clock_events = 0;

  ClockWatchTest() {
    tracking.reference_id = 0x0a000001;
    tracking.stratum = 11;
    tracking.leap = 0;
    tracking.update_interval = 1s;
    tracking.offset = 10us;
    tracking.root = {20us, 60us};
    restart();
  }
  void on_clock() override {
    ++clock_events;
    watch->log_change(watch->state());
  }

  void restart() {
    const ClockWatch::Options options{
        chronyd.address(), {}, [this] { return now; }, 50ms, [this] { return tick; }};
    ClockWatch::Observer& observer = *this;
    watch = std::make_unique<ClockWatch>(loop, options, observer, logger);
  }
  void pass(Duration time) {
    now.mono += time;
    now.wall += time;
  }
  void until_events(int count) {
    run_until(loop, [&, wanted = clock_events + count] { return clock_events >= wanted; });
  }
  // Until something was logged that has `text` in it.
  void until_logged(const std::string& text) {
    run_until(loop, [&] { return logged(text) > 0; });
  }
  long logged(const std::string& text) const {
    return std::count_if(logger.lines.begin(), logger.lines.end(), [&](const std::string& line) {
      return line.find(text) != std::string::npos;
    });
  }
  void until_status(ClockStatus status) {
    run_until(loop, [&] { return watch->state().status == status; });
  }
};

TEST_F(ClockWatchTest, StatesABoundAfterTheFirstAnswer) {
  EXPECT_EQ(watch->state().status, ClockStatus::unknown);
  EXPECT_EQ(watch->source(), std::nullopt);
  EXPECT_EQ(watch->state().update_interval, 0s);
  until_events(1);
  const ClockSnapshot state = watch->state();
  EXPECT_EQ(state.status, ClockStatus::synchronized);
  EXPECT_EQ(state.basis, ClockBasis::root);
  EXPECT_GE(state.bound, 60us);
  EXPECT_LE(state.bound, 60us + 10ns);
  ASSERT_TRUE(watch->source());
  EXPECT_EQ(watch->source()->str(), "10.0.0.1");
  EXPECT_NEAR(static_cast<double>(watch->state().update_interval.count()), 1e9, 1e3);
  until_events(2);
  EXPECT_EQ(logger.lines,
            std::vector<std::string>({"this PC's clock is within 0.060 ms of the right "
                                      "time (limit 1.500 ms)"}))
      << "what does not change is told once";
}

TEST_F(ClockWatchTest, LogsThatChronydIsMissingStopsAndStartsAgain) {
  chronyd.stop();
  until_logged("warning: there is no chronyd at '" + chronyd.address().str() + "'");
  EXPECT_EQ(watch->state().status, ClockStatus::unknown) << "it has never been heard";
  until_events(2);
  EXPECT_EQ(logger.lines.size(), 1u);
  chronyd.start();
  until_logged("answers again; this PC's clock is within");
  chronyd.stop();
  until_events(1);
  EXPECT_EQ(logged("there is no chronyd"), 2);
  EXPECT_EQ(watch->state().status, ClockStatus::out_of_bounds);
  EXPECT_EQ(watch->state().reason, ClockReason::no_chronyd);
  EXPECT_EQ(watch->source(), std::nullopt);
  chronyd.start();
  until_status(ClockStatus::synchronized);
  until_events(1);
  EXPECT_EQ(logged("answers again"), 2);
}

TEST_F(ClockWatchTest, LogsThatChronydDoesNotAnswer) {
  until_events(1);
  is_silent = true;
  pass(4s);
  EXPECT_EQ(watch->state().reason, ClockReason::silent) << "nobody waits for a callback";
  until_logged("warning: chronyd at");
  EXPECT_EQ(logged("does not report the state of this PC's clock; the clock has no bound: it does "
                   "not answer"),
            1);
  until_events(2);
  EXPECT_EQ(logger.lines.size(), 2u);
  is_silent = false;
  until_logged("answers again");
}

TEST_F(ClockWatchTest, LogsThatChronydHasNeverAnswered) {
  is_silent = true;
  until_events(1);
  EXPECT_TRUE(logger.lines.empty()) << "it may be starting";
  pass(4s);
  until_logged("does not report the state");
  EXPECT_EQ(watch->state().status, ClockStatus::unknown);
}

TEST_F(ClockWatchTest, GivesAStartingChronydTime) {
  chronyd.stop();
  until_events(1);
  is_silent = true;
  chronyd.start();
  run_until(loop, [&] { return requests == 2; });
  EXPECT_EQ(logger.lines.size(), 1u) << "there is no chronyd";
  pass(4s);
  until_logged("does not report the state");
}

TEST_F(ClockWatchTest, TreatsNonsenseAsNoAnswer) {
  tracking.root.delay = -1s;
  until_events(1);
  EXPECT_EQ(watch->state().status, ClockStatus::unknown);
  EXPECT_EQ(watch->source(), std::nullopt);
  pass(4s);
  until_logged("its values are not possible");
}

TEST_F(ClockWatchTest, LogsThatChronydIsNotSynchronized) {
  tracking.leap = clock::Tracking::kUnsynchronized;
  until_logged("warning: chronyd does not know the time, so");
  EXPECT_EQ(watch->state().reason, ClockReason::unsynchronized);
  tracking.leap = 0;
  until_logged("this PC's clock is within");
}

TEST_F(ClockWatchTest, LogsWhyTheClockIsTooFarAway) {
  tracking.offset = -2ms;
  until_logged("more than its limit of 1.500 ms: it is off by 2.000 ms");
  EXPECT_EQ(watch->state().reason, ClockReason::too_far);
  tracking.offset = 1us;
  until_logged("is within");
  tracking.root.delay = 4ms;
  until_logged("the source that chronyd follows is that far");
}

TEST_F(ClockWatchTest, LogsThatChronydHasNoNewMeasurements) {
  until_events(1);
  age = 8s;
  until_logged(
      "right time (limit 1.500 ms), but chronyd has learned nothing for 8.000 s: that grows by "
      "0.056 ms each second");
  EXPECT_EQ(watch->state().status, ClockStatus::holdover);
  age = 60s;
  until_logged(
      "warning: this PC's clock may be wrong by 3.435 ms, more than its limit of 1.500 ms: "
      "chronyd has learned nothing for 60.000 s");
}

TEST_F(ClockWatchTest, VoidsTheBoundOfAClockThatWasSet) {
  for (const Duration step : {Duration(1h), Duration(-200ms)}) {
    until_status(ClockStatus::synchronized);
    now.wall += step;
    EXPECT_EQ(watch->state().reason, ClockReason::stepped);
    EXPECT_EQ(watch->state().bound, kUnknownClockError);
    // chronyd measures once for each question.
    for (int i = 1; i < clock::ClockEstimator::kUpdatesAfterStep; ++i) {
      pass(1s);
      until_events(1);
      EXPECT_EQ(watch->state().reason, ClockReason::stepped) << i;
    }
    pass(1s);
    until_events(1);
    EXPECT_EQ(watch->state().status, ClockStatus::synchronized);
  }
  EXPECT_EQ(logged("warning: this PC's clock was set forward by 3600.000 s; it is out of bounds"),
            1);
  EXPECT_EQ(logged("warning: this PC's clock was set back by 200.000 ms; it is out of bounds"), 1);
  EXPECT_EQ(logged("is within"), 3);
  EXPECT_EQ(logger.lines.size(), 5u);
  EXPECT_EQ(logged("left out"), 0);
}

TEST_F(ClockWatchTest, DoesNotFillTheLogWithSteps) {
  until_events(1);
  const auto step = [this] {
    now.wall += 1s;
    watch->state();
  };
  for (int i = 0; i < 100; ++i) step();
  EXPECT_EQ(logged("was set"), 4);
  pass(1min);
  step();
  EXPECT_EQ(logged("was set forward by 1.000 s (96 steps before this were left out);"), 1);
}

TEST_F(ClockWatchTest, DoesNotFillTheLogWithChanges) {
  // Each answer is another change; the fifth and the sixth are too many.
  for (int i = 0; i < 6; ++i) {
    tracking.offset = i % 2 ? 2ms : 1ms;
    until_events(1);
  }
  EXPECT_EQ(logger.lines.size(), 4u);
  EXPECT_NE(logger.lines.back().find("off by 2.000 ms"), std::string::npos);
  // The seventh is what lasts; it is told when there is room for it.
  tracking.offset = 1ms;
  until_events(1);
  EXPECT_EQ(logger.lines.size(), 4u);
  pass(1min);
  until_logged(
      "is within 1.050 ms of the right time (limit 1.500 ms) (2 changes before this were left "
      "out)");
  until_events(1);
  EXPECT_EQ(logger.lines.size(), 5u);
}

TEST_F(ClockWatchTest, NoticesStepsThatHappenedWhileNoDssmdRan) {
  until_events(1);
  const clock::Instant base = watch->base();
  EXPECT_EQ(base.mono, now.mono);
  pass(10s);
  restart();
  watch->resume(base, {});
  EXPECT_EQ(watch->base().mono, base.mono);
  until_events(1);
  EXPECT_EQ(watch->state().status, ClockStatus::synchronized) << "nothing has";
  pass(10s);
  now.wall -= 5ms;
  restart();
  watch->resume(base, {});
  until_events(1);
  EXPECT_EQ(watch->state().reason, ClockReason::stepped);
  EXPECT_EQ(logged("was set back by 5.000 ms"), 1);
}

TEST_F(ClockWatchTest, MeasuresAgainstTheReferencePc) {
  tracking.root = {800us, 100us};
  const clock::ReferenceReport report{tracking.reference_id, {780us, 60us}};
  until_events(1);
  watch->on_reference(report);
  pass(clock::ClockEstimator::kMeasurementsBack * 1001ms);
  until_events(1);
  watch->on_reference(report);
  const ClockSnapshot state = watch->state();
  EXPECT_EQ(state.basis, ClockBasis::reference);
  EXPECT_GE(state.bound, 50us);
  EXPECT_LE(state.bound, 50us + 10ns);
  watch->on_reference({});
  EXPECT_EQ(watch->state().basis, ClockBasis::root);
}

TEST_F(ClockWatchTest, TakesOtherLimits) {
  until_events(1);
  watch->set({.limit = 50us});
  EXPECT_EQ(watch->state().reason, ClockReason::too_far);
  until_logged("more than its limit of 0.050 ms");
}

TEST_F(ClockWatchTest, ReportsCheaplyThatNothingHasChanged) {
  tick = {now.mono, now.wall - time_from_ns(0) - now.mono.time_since_epoch()};
  EXPECT_TRUE(watch->may_differ()) << "nothing was known";
  EXPECT_FALSE(watch->may_differ());
  tick.mono += ClockWatch::kMaxDelay - 1ns;
  EXPECT_FALSE(watch->may_differ());
  tick.mono += 1ns;
  EXPECT_TRUE(watch->may_differ()) << "what time alone changes";
  EXPECT_FALSE(watch->may_differ());
  tick.difference += 1ns;
  EXPECT_TRUE(watch->may_differ()) << "the clock was set";
  EXPECT_FALSE(watch->may_differ());
}

TEST_F(ClockWatchTest, LivesWithoutDescriptors) {
#ifdef __SANITIZE_ADDRESS__
  GTEST_SKIP() << "the sanitizers of clang need descriptors of their own, to look at objects";
#endif
  watch.reset();
  rlimit before{};
  ASSERT_EQ(::getrlimit(RLIMIT_NOFILE, &before), 0);
  const int free = ::fcntl(0, F_DUPFD_CLOEXEC, 0);
  ::close(free);
  rlimit none = before;
  none.rlim_cur = static_cast<rlim_t>(free);
  ASSERT_EQ(::setrlimit(RLIMIT_NOFILE, &none), 0);
  restart();
  until_events(1);
  EXPECT_EQ(logged("warning: watch the wall clock for steps: Too many open files"), 1);
  ASSERT_EQ(::setrlimit(RLIMIT_NOFILE, &before), 0);
  until_status(ClockStatus::synchronized);
}

}  // namespace
}  // namespace dssm::daemon
