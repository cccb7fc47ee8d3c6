// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/playback_clock_owner.hpp"

#include <gtest/gtest.h>

#include <limits>

namespace dssm::daemon {
namespace {

constexpr double kNan = std::numeric_limits<double>::quiet_NaN();

double now_s() { return static_cast<double>(to_ns(WallClock::now())) * 1e-9; }

class PlaybackLease : public testing::Test {
 protected:
  // What another host sends whose clock has that speed.
  static proto::FollowPlayback request(std::uint64_t driver, double speed) {
    proto::FollowPlayback message;
    message.set_driver(driver);
    message.set_driver_name("play@pc" + std::to_string(driver));
    message.mutable_playback()->mutable_run()->set_speed(speed);
    message.mutable_playback()->mutable_before()->set_speed(1);
    return message;
  }
  double speed() const {
    const UniqueFd clock = owner_.get().value();
    return clock::PlaybackRecord::open_untrusted(clock.get()).value()->load().run.speed;
  }

  mutable PlaybackClockOwner owner_;
  const MonoTime start_ = MonoClock::now();
};

TEST_F(PlaybackLease, EndsWhenTheDriverIsGone) {
  int renewals = 0;
  owner_.on_lease([&] { ++renewals; });
  EXPECT_EQ(owner_.check_lease(start_), kNever);
  ASSERT_TRUE(owner_.follow_untrusted(request(1, 3), start_));
  ASSERT_TRUE(owner_.follow_untrusted(request(1, 4), start_ + std::chrono::seconds(1)));
  EXPECT_EQ(renewals, 2);
  const MonoTime end = start_ + std::chrono::seconds(1) + PlaybackClockOwner::kLease;
  EXPECT_EQ(owner_.check_lease(end - Duration(1)), end);
  EXPECT_EQ(speed(), 4);
  EXPECT_EQ(owner_.check_lease(end), kNever);
  EXPECT_EQ(speed(), 1);
}

TEST_F(PlaybackLease, BelongsToOneDriver) {
  ASSERT_TRUE(owner_.follow_untrusted(request(1, 3), start_));
  const Result<void> other = owner_.follow_untrusted(request(2, 5), start_);
  ASSERT_FALSE(other);
  EXPECT_EQ(other.error().code, Errc::conflict);
  EXPECT_EQ(other.error().message, "its playback clock follows 'play@pc1'; end that first");
  EXPECT_EQ(owner_.lead(request(2, 0), "play@pc3", 3, start_).error().code, Errc::conflict);
  EXPECT_EQ(speed(), 3);
  // Late, but before check_lease().
  ASSERT_TRUE(owner_.follow_untrusted(request(2, 5), start_ + PlaybackClockOwner::kLease));
  EXPECT_EQ(speed(), 5);
  proto::FollowPlayback end = request(2, 5);
  end.set_ends(true);
  ASSERT_TRUE(owner_.follow_untrusted(end, start_ + PlaybackClockOwner::kLease));
  EXPECT_EQ(speed(), 1);
  ASSERT_TRUE(owner_.follow_untrusted(request(3, 6), start_ + PlaybackClockOwner::kLease));
}

TEST_F(PlaybackLease, OfAProgramThatWasKilledGoesToTheNextOneAtOnce) {
  ASSERT_TRUE(owner_.lead(request(1, 0), "play@pc1", 7, start_));
  owner_.on_client_gone(8);
  EXPECT_EQ(owner_.lead(request(2, 0), "play@pc1", 8, start_).error().code, Errc::conflict);
  owner_.on_client_gone(7);
  ASSERT_TRUE(owner_.lead(request(2, 0), "play@pc1", 9, start_));
  EXPECT_EQ(owner_.lead(request(1, 0), "play@pc1", 7, start_).error().code, Errc::conflict);
}

TEST_F(PlaybackLease, NamesTheDriverOfAnotherHostUntilItEnds) {
  EXPECT_EQ(owner_.followed_driver(start_), "");
  ASSERT_TRUE(owner_.lead(request(1, 0), "play@pc1", 1, start_));
  EXPECT_EQ(owner_.followed_driver(start_), "") << "a program of this PC";
  const MonoTime end = start_ + PlaybackClockOwner::kLease;
  proto::FollowPlayback follow = request(2, 3);
  follow.set_driver_name("play\n@pc2");
  ASSERT_TRUE(owner_.follow_untrusted(follow, end));
  EXPECT_EQ(owner_.followed_driver(end), "play?@pc2");
  // Late, but before check_lease().
  EXPECT_EQ(owner_.followed_driver(end + PlaybackClockOwner::kLease), "");
  follow.set_ends(true);
  ASSERT_TRUE(owner_.follow_untrusted(follow, end));
  EXPECT_EQ(owner_.followed_driver(end), "");
}

TEST_F(PlaybackLease, RefusesWhatIsNoClock) {
  EXPECT_EQ(owner_.follow_untrusted(request(0, 3), start_).error().code, Errc::invalid_argument);
  EXPECT_EQ(owner_.follow_untrusted(request(1, kNan), start_).error().code, Errc::invalid_argument);
  for (const double change_s : {now_s() + 60, kNan}) {
    proto::FollowPlayback late = request(1, 3);
    late.mutable_playback()->set_change_s(change_s);
    EXPECT_EQ(owner_.follow_untrusted(late, start_).error().code, Errc::invalid_argument);
  }
  EXPECT_EQ(speed(), 1);
}

TEST_F(PlaybackLease, LeadsWithWhatThisClockIs) {
  const UniqueFd clock = owner_.get().value();
  const auto record = clock::PlaybackRecord::open_untrusted(clock.get()).value();
  record->update([](const auto&) { return clock::PlaybackSetting{{1, 2, 1, 4}, 5, {6, 7, 0, 9}}; });
  proto::FollowPlayback message;
  message.set_driver(8);
  const proto::FollowPlayback lead = owner_.lead(message, "play@pc1", 1, start_).value();
  EXPECT_EQ(lead.driver(), 8U);
  EXPECT_EQ(lead.driver_name(), "play@pc1");
  const proto::Playback& playback = lead.playback();
  EXPECT_EQ(playback.run().offset_s(), 1);
  EXPECT_EQ(playback.run().speed(), 2);
  EXPECT_TRUE(playback.run().paused());
  EXPECT_EQ(playback.run().paused_at_s(), 4);
  EXPECT_EQ(playback.change_s(), 5);
  EXPECT_EQ(playback.before().offset_s(), 6);
  EXPECT_FALSE(playback.before().paused());
  // Another host takes exactly that.
  PlaybackClockOwner other;
  ASSERT_TRUE(other.follow_untrusted(lead, start_));
  const UniqueFd theirs = other.get().value();
  const auto copy = clock::PlaybackRecord::open_untrusted(theirs.get()).value()->load();
  EXPECT_EQ(copy.run.paused_at_s, 4);
  EXPECT_EQ(copy.change_s, 5);
  EXPECT_EQ(copy.before.speed, 7);
}

}  // namespace
}  // namespace dssm::daemon
