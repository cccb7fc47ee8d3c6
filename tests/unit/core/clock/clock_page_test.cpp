// SPDX-License-Identifier: Apache-2.0
//
// What programs read on the clock page, and that its layout is the documented one.
#include "core/clock/clock_page.hpp"

#include <gtest/gtest.h>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

// The bound is 100 us at second 50, grows by 50 us a second, and was at most 400 us since second
// 40.
ClockPageState state() {
  ClockPageState made;
  made.wall = Time(50s);
  made.mono = MonoClock::now();
  made.clock.status = ClockStatus::synchronized;
  made.clock.bound = 100us;
  made.clock.ageing_ppb = 50'000;
  made.earlier_from = Time(40s);
  made.earlier_bound = 400us;
  return made;
}

class ClockPageTest : public testing::Test {
 protected:
  ClockPage page{};
};

// The numbers of docs/clocks.md "The shared page", by hand.
TEST(ClockPageLayout, HasItsDocumentedOffsets) {
  EXPECT_EQ(offsetof(ClockPage, magic), 0u);
  EXPECT_EQ(offsetof(ClockPage, layout_version), 8u);
  EXPECT_EQ(offsetof(ClockPage, boot_id), 16u);
  EXPECT_EQ(offsetof(ClockPage, state), 56u);
  EXPECT_EQ(sizeof(ClockPage), 4096u);
  EXPECT_EQ(offsetof(ClockPageState, wall), 0u);
  EXPECT_EQ(offsetof(ClockPageState, earlier_from), 8u);
  EXPECT_EQ(offsetof(ClockPageState, earlier_bound), 16u);
  EXPECT_EQ(offsetof(ClockPageState, limit), 24u);
  EXPECT_EQ(offsetof(ClockPageState, mono), 32u);
  EXPECT_EQ(offsetof(ClockPageState, clock), 40u);
  EXPECT_EQ(offsetof(ClockPageState, base_mono), 112u);
  EXPECT_EQ(offsetof(ClockPageState, base_wall), 120u);
  EXPECT_EQ(offsetof(ClockPageState, base_width), 128u);
  EXPECT_EQ(offsetof(ClockPageState, reference), 136u);
  EXPECT_EQ(sizeof(ClockPageState), 256u);
  EXPECT_EQ(offsetof(ClockSnapshot, bound), 0u);
  EXPECT_EQ(offsetof(ClockSnapshot, ageing_ppb), 8u);
  EXPECT_EQ(offsetof(ClockSnapshot, status), 16u);
  EXPECT_EQ(offsetof(ClockSnapshot, reason), 17u);
  EXPECT_EQ(offsetof(ClockSnapshot, basis), 18u);
  EXPECT_EQ(offsetof(ClockSnapshot, stratum), 20u);
  EXPECT_EQ(offsetof(ClockSnapshot, root_bound), 24u);
  EXPECT_EQ(offsetof(ClockSnapshot, root), 32u);
  EXPECT_EQ(offsetof(ClockSnapshot, offset), 48u);
  EXPECT_EQ(offsetof(ClockSnapshot, update_interval), 56u);
  EXPECT_EQ(offsetof(ClockSnapshot, age), 64u);
  EXPECT_EQ(sizeof(ClockSnapshot), 72u);
  EXPECT_EQ(ClockPage::kLayoutVersion, 3u) << "raise it with every change, and fix this test";
}

TEST_F(ClockPageTest, StatesNothingUntilSomethingIsStored) {
  EXPECT_EQ(clock_error_at(page, WallClock::now()), std::nullopt);
  EXPECT_EQ(status_of(page), ClockStatus::unknown);
}

TEST_F(ClockPageTest, TheStatusIsUnknownWhenItIsOld) {
  ClockPageState stated = state();
  page.state.store(stated);
  EXPECT_EQ(status_of(page), ClockStatus::synchronized);
  stated.mono -= 2 * kMaxUse;
  page.state.store(stated);
  EXPECT_EQ(status_of(page), ClockStatus::unknown);
}

TEST_F(ClockPageTest, TheBoundGrowsWithTheSamplesTime) {
  page.state.store(state());
  EXPECT_EQ(clock_error_at(page, Time(50s)), 100us);
  EXPECT_EQ(clock_error_at(page, Time(52s)), 200us);
  EXPECT_EQ(clock_error_at(page, Time(50s) + 1ns), 100us + 1ns) << "rounded up";
}

TEST_F(ClockPageTest, ATimeBeforeTheStatementHasTheGreatestBoundSince) {
  page.state.store(state());
  EXPECT_EQ(clock_error_at(page, Time(50s) - 1ns), 400us);
  EXPECT_EQ(clock_error_at(page, Time(40s)), 400us);
}

TEST_F(ClockPageTest, StatesNothingAboutTimesThatItDoesNotCover) {
  page.state.store(state());
  EXPECT_EQ(clock_error_at(page, Time(40s) - 1ns), std::nullopt);
  EXPECT_EQ(clock_error_at(page, Time(50s) + kMaxUse), 275us);
  EXPECT_EQ(clock_error_at(page, Time(50s) + kMaxUse + 1ns), std::nullopt)
      << "dssmd does not run, or it is not a time of this clock";
  EXPECT_EQ(clock_error_at(page, Time::max()), std::nullopt);
  EXPECT_EQ(clock_error_at(page, Time::min()), std::nullopt);
}

TEST_F(ClockPageTest, WithoutABoundAllIsUnknown) {
  ClockPageState none = state();
  none.clock.bound = kUnknownClockError;
  none.earlier_from = none.wall;
  page.state.store(none);
  EXPECT_EQ(clock_error_at(page, Time(50s)), kUnknownClockError);
  EXPECT_EQ(clock_error_at(page, Time(49s)), std::nullopt);
}

}  // namespace
}  // namespace dssm::clock
