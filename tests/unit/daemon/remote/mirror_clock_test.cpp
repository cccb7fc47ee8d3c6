// SPDX-License-Identifier: Apache-2.0
//
// Which samples of a mirror count, and by what, as reports of its owner come on both connections.
#include <gtest/gtest.h>

#include "daemon/remote/mirror_ring.hpp"
#include "tests/unit/daemon/remote/fake_clock_assessor.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

MirrorClock::Report report(Duration bound, std::uint8_t anchor = 1) {
  auto made = std::make_shared<wire::ClockReport>();
  made->clock.bound = bound;
  made->anchor = {anchor};
  return made;
}

class MirrorClockTest : public testing::Test {
 protected:
  bool is_suspect(Tid tid) const {
    const ring::ClockAssessment found = clock.assessment();
    return tid >= found.suspect_first && tid <= found.suspect_last;
  }

  const StreamId id{"lidar", 0, "pc2"};
  FakeClockAssessor assessor;
  MirrorClock clock{&assessor, id};
  MonoTime now{1000s};
};

TEST_F(MirrorClockTest, WithoutAnAssessorAllTimesAreGood) {
  const MirrorClock free(nullptr, id);
  EXPECT_TRUE(free.assessment().same_clock);
  EXPECT_TRUE(free.check_opening());
  EXPECT_EQ(free.reason(), "");
}

TEST_F(MirrorClockTest, AStreamIsOpenedWhenSomethingIsAllowed) {
  clock.on_owner(report(1ms), kNoTid, now);
  EXPECT_TRUE(clock.check_opening());
  EXPECT_EQ(clock.reason(), "");
  clock.on_owner(report(1ms + 1ns), kNoTid, now);
  const Result<void> refused = clock.check_opening();
  ASSERT_FALSE(refused);
  EXPECT_EQ(refused.error().code, Errc::clock_out_of_bounds);
  EXPECT_EQ(clock.reason(), "not 'lidar:0@pc2'");
}

TEST_F(MirrorClockTest, AStreamIsOpenedUntilItsOwnerReports) {
  EXPECT_FALSE(clock.has_report());
  EXPECT_TRUE(clock.check_opening());
  clock.on_owner(nullptr, kNoTid, now);  // a dssmd that reports nothing of its clock
  EXPECT_TRUE(clock.has_report());
  EXPECT_FALSE(clock.check_opening());
}

TEST_F(MirrorClockTest, MarkedStreamsAreOpenedAndHaveAReason) {
  assessor.policy = ClockPolicy::mark;
  clock.on_owner(report(2ms), kNoTid, now);
  EXPECT_TRUE(clock.check_opening());
  EXPECT_EQ(clock.reason(), "not 'lidar:0@pc2'");
}

TEST_F(MirrorClockTest, SamplesThatComeWhileTheOwnersClockIsUnknownStaySuspect) {
  clock.on_owner(report(1us), 9, now);
  EXPECT_FALSE(is_suspect(9));
  clock.on_owner(report(kUnknownClockError), 9, now);  // it was set
  EXPECT_FALSE(is_suspect(9));
  EXPECT_TRUE(is_suspect(10));
  clock.on_owner(report(kUnknownClockError), 15, now);
  EXPECT_TRUE(is_suspect(10)) << "from the first one on";
  clock.on_owner(report(1us), 20, now);
  EXPECT_FALSE(is_suspect(9));
  EXPECT_TRUE(is_suspect(10));
  EXPECT_TRUE(is_suspect(20));
  EXPECT_FALSE(is_suspect(21));
}

TEST_F(MirrorClockTest, WhatWasSuspectOnceStaysSoWhenTheClockIsSetAgain) {
  clock.on_owner(report(1us), 9, now);
  for (const Tid newest : {10, 20}) {
    clock.on_owner(report(kUnknownClockError), newest, now);
    clock.on_owner(report(1us), newest + 5, now);
  }
  EXPECT_FALSE(is_suspect(10));
  EXPECT_TRUE(is_suspect(11));
  EXPECT_TRUE(is_suspect(25));
  EXPECT_FALSE(is_suspect(26));
}

TEST_F(MirrorClockTest, WhatWasStampedAgainstAnotherReferenceIsSuspect) {
  clock.on_owner(report(1us, 1), 9, now);
  clock.on_owner(report(1us, 2), 12, now);
  EXPECT_TRUE(is_suspect(0));
  EXPECT_TRUE(is_suspect(12));
  EXPECT_FALSE(is_suspect(13));
}

TEST_F(MirrorClockTest, WhatIsMeasuredOfAClockThatWasSetBackIsOfSamplesThatCameAfterIt) {
  const auto reported = [](std::int64_t setting, Duration settled_from) {
    auto made = std::make_shared<wire::ClockReport>(*report(1us));
    made->setting = setting;
    made->setting_from = Time(3h);
    made->settled_from = Time(settled_from);
    return made;
  };
  const auto first = [this] { return clock.assessment().measured_first_tid; };
  assessor.measured_from = Time(2h);
  clock.on_owner(reported(1, 0h), 9, now, {{11}});
  EXPECT_EQ(first(), 0) << "it was not set back, or not for long";
  clock.on_owner(reported(1, 1h), 12, now);
  EXPECT_EQ(first(), INT64_MAX) << "which ones is said on the stream's channel";
  clock.on_owner(reported(1, 1h), 12, now, {{20}});
  EXPECT_EQ(first(), 21) << "those up to there were written before";
  clock.on_owner(reported(1, 1h), 30, now);
  clock.on_owner(reported(1, 1h), 30, now, {{35}});
  EXPECT_EQ(first(), 21) << "still";
  clock.on_owner(reported(1, 0h), 30, now);  // it was overtaken by the others
  clock.on_owner(reported(1, 1h), 30, now);
  EXPECT_EQ(first(), 21);
  clock.on_owner(nullptr, 30, now);
  clock.on_owner(reported(1, 1h), 30, now);
  EXPECT_EQ(first(), 21);
  clock.on_new_ring();
  EXPECT_EQ(first(), INT64_MAX);
  clock.on_owner(reported(1, 1h), kNoTid, now, {{0}});
  EXPECT_EQ(first(), 1);
  assessor.measured_from = Time(3h);
  EXPECT_EQ(first(), 0) << "it never showed such times before";
}

TEST_F(MirrorClockTest, AReportThatWasOvertakenHasNoEffect) {
  const auto of_line = [](std::int64_t line_ns, Duration bound) {
    auto made = std::make_shared<wire::ClockReport>(*report(bound));
    made->line.raw = RawTime(Duration(line_ns));
    return made;
  };
  clock.on_owner(of_line(7, 2us), 9, now);
  clock.on_owner(of_line(6, 1us), 9, now);
  EXPECT_EQ(clock.assessment().added, 2us);
  clock.on_owner(of_line(8, 3us), 9, now);
  EXPECT_EQ(clock.assessment().added, 3us);
}

TEST_F(MirrorClockTest, SamplesOfAnEarlierBootOfTheirOwnerAreNotMeasured) {
  const auto of_boot = [](const char* boot_id) {
    auto made = std::make_shared<wire::ClockReport>(*report(1us));
    made->boot_id = boot_id;
    return made;
  };
  const auto first = [this] { return clock.assessment().measured_first_tid; };
  clock.on_owner(of_boot("one"), 9, now);
  EXPECT_EQ(first(), 0);
  clock.on_owner(nullptr, 12, now);
  clock.on_owner(of_boot("two"), 12, now);
  EXPECT_EQ(first(), 13);
  clock.on_owner(of_boot("two"), 20, now);
  EXPECT_EQ(first(), 13);
  clock.on_new_ring();
  EXPECT_EQ(first(), 0);
}

// By their own clocks, which the owner's says nothing about.
TEST_F(MirrorClockTest, SamplesThatOtherHostsWriteAreNotMeasured) {
  assessor.measured = 1us;
  clock.on_owner(report(2ms), 9, now);
  EXPECT_EQ(clock.assessment().measured, kUnknownClockError) << "not before the owner says so";
  EXPECT_TRUE(clock.check_opening());
  clock.on_owner(report(2ms), 9, now, {{9, false}});
  EXPECT_EQ(clock.assessment().measured, 1us);
  EXPECT_EQ(clock.assessment().recent, 1us);
  clock.on_owner(report(2ms), 9, now, {{9, true}});
  EXPECT_EQ(clock.assessment().measured, kUnknownClockError);
  EXPECT_EQ(clock.assessment().recent, kUnknownClockError);
  EXPECT_FALSE(clock.check_opening());
  EXPECT_NE(clock.reason().find("programs on other PCs write to it"), std::string::npos);
  assessor.measured = kUnknownClockError;
  EXPECT_EQ(clock.reason(), "not 'lidar:0@pc2'") << "not because of those";
}

TEST_F(MirrorClockTest, ClockErrorsFromBeforeASlewAreSuspect) {
  const auto shows = [](RawTime raw, Duration wall) {
    auto made = std::make_shared<wire::ClockReport>(*report(1us));
    made->line = {raw, Time(wall), 0, 10us};
    return made;
  };
  clock.on_owner(shows(RawTime(1s), 1s), 9, now);
  clock.on_owner(shows(RawTime(2s), 2s + MirrorClock::kSlewed), 11, now);
  EXPECT_EQ(clock.assessment().suspect_last, kNoTid) << "a usual correction";
  clock.on_owner(shows(RawTime(3s), 3s + 1ms), 12, now);
  EXPECT_EQ(clock.assessment().suspect_first, 13);
  clock.on_time(20, now + MirrorClock::kStaleFor - 1ns);
  EXPECT_EQ(clock.assessment().suspect_last, INT64_MAX);
  clock.on_time(25, now + MirrorClock::kStaleFor);
  EXPECT_EQ(clock.assessment().suspect_first, 13);
  EXPECT_EQ(clock.assessment().suspect_last, 25);
}

TEST_F(MirrorClockTest, ANewRingHasNoSuspectSamples) {
  clock.on_owner(report(1us, 1), 9, now);
  clock.on_owner(report(1us, 2), 12, now);
  clock.on_new_ring();
  EXPECT_FALSE(is_suspect(0));
}

TEST_F(MirrorClockTest, ANewRingOfAnUnknownClockIsAllSuspect) {
  clock.on_owner(report(kUnknownClockError), 9, now);
  clock.on_new_ring();
  EXPECT_TRUE(is_suspect(0));
}

}  // namespace
}  // namespace dssm::daemon
