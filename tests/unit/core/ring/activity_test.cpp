// SPDX-License-Identifier: Apache-2.0
//
// Rates, ages and stalls, from the stamps in a ring.
#include "core/ring/activity.hpp"

#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

using namespace std::chrono_literals;
using Durations = std::vector<Duration>;

TEST(Activity, APauseIsLongerThanSeveralUsualIntervals) {
  EXPECT_EQ(pause_length(Durations{10ms, 11ms, 12ms}, 1s), 1s) << "never shorter than a second";
  EXPECT_EQ(pause_length(Durations{1s, 2s, 3s}, 1ms), 10s) << "five times the longest but one";
  EXPECT_EQ(pause_length(Durations{400ms, 160s, 400ms}, 1ms), 2s) << "one pause is not usual";
  EXPECT_EQ(pause_length(Durations{50ms, 60s, 50ms, 61s}, 1ms), 300s) << "two are";
}

TEST(Activity, TheCycleCountsOnlyWhileThereAreNoIntervals) {
  EXPECT_EQ(pause_length(Durations{}, 3s), 15s);
  EXPECT_EQ(pause_length(Durations{4s}, 3s), 20s);
  EXPECT_EQ(pause_length(Durations{10ms, 10ms}, 1h), 1s) << "a cycle far from the real one";
}

TEST(Activity, AcceptsAnyStamps) {
  EXPECT_EQ(pause_length(Durations{-1h, -2h, -3h}, 1ms), 1s);
  EXPECT_EQ(pause_length(Durations{Duration::max(), Duration::max()}, 1ms), Duration::max());
  EXPECT_EQ(pause_length(Durations{Duration::min(), Duration::min()}, 1ms), 1s);
}

class RingActivity : public testing::Test {
 protected:
  void write(Time time, Duration clock_error = 1us) {
    RingWriter writer = ring_.writer();
    writer.write(payload_for(0, 8), time, clock_error);
  }
  // `count` samples every `interval` from kStart on, and returns the stamp of the last one.
  Time write_regularly(int count, Duration interval, Time from = kStart) {
    for (int i = 0; i < count; ++i) write(from + i * interval);
    return from + (count - 1) * interval;
  }
  StreamInfo at(Time now) const {
    StreamInfo info;
    info.cycle = 10s;
    describe_activity(ring_.reader(), now, info);
    return info;
  }

  static constexpr Time kStart = time_from_ns(1'700'000'000'000'000'000);
  const TestRing ring_{8, 128};
};

TEST_F(RingActivity, IsEmptyBeforeTheFirstSample) {
  EXPECT_EQ(at(kStart).state, StreamState::empty);
  EXPECT_EQ(at(kStart).newest, kNoTid);
}

TEST_F(RingActivity, IsLiveUntilTheNewestSampleIsAsOldAsAPauseIsLong) {
  const Time last = write_regularly(50, 500ms);
  EXPECT_EQ(at(last + 2499ms).state, StreamState::live);
  EXPECT_EQ(at(last + 2499ms).age, 2499ms);
  EXPECT_EQ(at(last + 2500ms).state, StreamState::stalled);
  EXPECT_EQ(at(last + 98s).age, 98s);
  EXPECT_NEAR(at(last).rate_hz, 2, 1e-9);
}

TEST_F(RingActivity, MeasuresTheRateAfterTheNewestPause) {
  const Time resumed = write_regularly(50, 100ms) + 163s;
  write(resumed);
  EXPECT_EQ(at(resumed).rate_hz, 0) << "one sample makes no rate";
  const Time last = write_regularly(5, 100ms, resumed + 100ms);
  EXPECT_NEAR(at(last).rate_hz, 10, 1e-9);
  EXPECT_EQ(at(last + 1s).state, StreamState::stalled) << "the pause is not usual";
}

TEST_F(RingActivity, IsUnknownWhenTheStampsAreOfAnotherClock) {
  write_regularly(5, 100ms);
  write(kStart + 500ms, kForeignClockError);
  const StreamInfo info = at(kStart + 1h);
  EXPECT_EQ(info.state, StreamState::unknown);
  EXPECT_EQ(info.newest, 5);
  EXPECT_NEAR(info.rate_hz, 10, 1e-9);
}

TEST_F(RingActivity, ASampleFromTheFutureIsLive) {
  write(kStart + 5s);
  EXPECT_EQ(at(kStart).state, StreamState::live);
  EXPECT_EQ(at(kStart).age, -5s);
}

}  // namespace
}  // namespace dssm::ring
