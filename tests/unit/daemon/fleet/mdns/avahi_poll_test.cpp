// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/mdns/avahi_poll.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include "core/base/unique_fd.hpp"

namespace dssm::daemon {
namespace {

struct AvahiPollTest : testing::Test {
  EventLoop loop = *EventLoop::open();
  LoopAvahiPoll poll{loop};
  const AvahiPoll* api = poll.api();

  struct Seen {
    AvahiPollTest* test;
    int calls = 0;
    AvahiWatchEvent events{};
    AvahiWatchEvent inside{};  // watch_get_events() in the callback
  };
};

TEST(AvahiPollDelay, IsWhatIsLeftOnTheWallClockWithinBounds) {
  const Time now = time_from_ns(1'700'000'000'000'000'000);
  EXPECT_EQ(delay_until({1'700'000'003, 500'000}, now), std::chrono::milliseconds(3500));
  EXPECT_EQ(delay_until({1'699'999'999, 0}, now), Duration::zero());
  EXPECT_EQ(delay_until({0, 0}, now), Duration::zero());
  EXPECT_EQ(delay_until({1'700'099'999, 0}, now), std::chrono::minutes(1));
  EXPECT_EQ(delay_until({INT64_MAX, 999'999}, now), std::chrono::minutes(1));
  EXPECT_EQ(delay_until({INT64_MIN, 0}, now), Duration::zero());
}

TEST_F(AvahiPollTest, AWatchMayBeFreedInItsOwnCallback) {
  int ends[2];
  ASSERT_EQ(::pipe(ends), 0);
  const UniqueFd out(ends[0]), in(ends[1]);
  ASSERT_EQ(::write(in.get(), "x", 1), 1);
  Seen seen{this};
  api->watch_new(
      api, out.get(), AVAHI_WATCH_IN,
      [](AvahiWatch* watch, int, AvahiWatchEvent events, void* data) {
        auto& noted = *static_cast<Seen*>(data);
        ++noted.calls;
        noted.events = events;
        noted.inside = noted.test->api->watch_get_events(watch);
        noted.test->api->watch_free(watch);
        noted.test->loop.stop();
      },
      &seen);
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(seen.calls, 1);
  EXPECT_EQ(seen.events, AVAHI_WATCH_IN);
  EXPECT_EQ(seen.inside, AVAHI_WATCH_IN);
  EventSource end = EventSource::timer(loop, [this] { loop.stop(); });
  end.enable_in(std::chrono::milliseconds(1));
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(seen.calls, 1) << "it is still readable, but freed";
}

TEST_F(AvahiPollTest, AWatchFollowsItsUpdates) {
  int ends[2];
  ASSERT_EQ(::pipe(ends), 0);
  const UniqueFd out(ends[0]), in(ends[1]);
  Seen seen{this};
  AvahiWatch* const watch = api->watch_new(
      api, in.get(), AVAHI_WATCH_IN,
      [](AvahiWatch*, int, AvahiWatchEvent events, void* data) {
        static_cast<Seen*>(data)->events = events;
        static_cast<Seen*>(data)->test->loop.stop();
      },
      &seen);
  api->watch_update(watch, AVAHI_WATCH_OUT);
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(seen.events, AVAHI_WATCH_OUT);
  EXPECT_EQ(api->watch_get_events(watch), 0);
  api->watch_free(watch);
}

TEST_F(AvahiPollTest, ATimeoutMayBeFreedInItsOwnCallbackAndIsDueInThePast) {
  Seen seen{this};
  const timeval past{1, 0};
  api->timeout_new(
      api, &past,
      [](AvahiTimeout* timeout, void* data) {
        auto& noted = *static_cast<Seen*>(data);
        ++noted.calls;
        noted.test->api->timeout_update(timeout, nullptr);
        noted.test->api->timeout_free(timeout);
        noted.test->loop.stop();
      },
      &seen);
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(seen.calls, 1);
}

TEST_F(AvahiPollTest, ATimeoutWithoutATimeSleepsUntilItGetsOne) {
  Seen seen{this};
  AvahiTimeout* const timeout = api->timeout_new(
      api, nullptr,
      [](AvahiTimeout*, void* data) {
        ++static_cast<Seen*>(data)->calls;
        static_cast<Seen*>(data)->test->loop.stop();
      },
      &seen);
  EventSource end = EventSource::timer(loop, [this] { loop.stop(); });
  end.enable_in(std::chrono::milliseconds(1));
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(seen.calls, 0);
  const timeval past{1, 0};
  api->timeout_update(timeout, &past);
  ASSERT_TRUE(loop.run());
  EXPECT_EQ(seen.calls, 1);
  api->timeout_free(timeout);
}

}  // namespace
}  // namespace dssm::daemon
