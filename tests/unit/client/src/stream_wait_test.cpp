// SPDX-License-Identifier: Apache-2.0
#include "client/src/stream_wait.hpp"

#include <gtest/gtest.h>

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

constexpr MonoTime kBegin{1h};
const Error kMissing{Errc::not_found, "open 'lidr:0': there is no stream 'lidr:0'"};
const Error kClock{Errc::clock_out_of_bounds, "open 'lidr:0': pc1's clock is unknown"};
const std::vector<StreamId> kKnown{{"lidar", 0, "pc1"}, {"lidar", 0, "pc2"}, {"imu", 0, "pc1"}};

struct Waiting : testing::Test {
  StreamWait wait{{"lidr", 0, ""}, kBegin};
};

TEST_F(Waiting, TriesAtOnceThenWithEventsWhereThereAreSome) {
  EXPECT_EQ(wait.next_attempt(), kBegin);
  wait.begin_attempt();
  wait.failed(kMissing, true, kBegin);
  EXPECT_EQ(wait.next_attempt(), kNever);
  wait.added();
  EXPECT_LE(wait.next_attempt(), kBegin);
  wait.begin_attempt();
  wait.failed(kClock, true, kBegin + 1s);
  EXPECT_EQ(wait.next_attempt(), kBegin + 1s + StreamWait::kRetryPause) << "no event announces it";
  wait.begin_attempt();
  wait.failed(kMissing, false, kBegin + 2s);
  EXPECT_EQ(wait.next_attempt(), kBegin + 2s + StreamWait::kRetryPause) << "nor without a watch";
}

TEST_F(Waiting, KeepsAnEventThatCameDuringAnAttempt) {
  wait.begin_attempt();
  wait.added();
  wait.failed(kMissing, true, kBegin);
  EXPECT_LE(wait.next_attempt(), kBegin);
}

TEST_F(Waiting, ReportsEachReasonOnce) {
  EXPECT_EQ(wait.next_notice(), kNever) << "nothing has failed yet";
  wait.failed(kMissing, true, kBegin);
  EXPECT_EQ(wait.next_notice(), kBegin + StreamWait::kNoticeAfter);
  EXPECT_EQ(wait.take_notice(kBegin + 2500ms, kKnown),
            "has waited 2 s for stream 'lidr': there is no stream 'lidr:0'; similar names: "
            "'lidar@pc1', 'lidar@pc2'");
  wait.failed(kMissing, true, kBegin + 3s);
  EXPECT_EQ(wait.next_notice(), kNever);
  wait.failed(kClock, true, kBegin + 4s);
  EXPECT_EQ(wait.next_notice(), kBegin + StreamWait::kNoticeAfter);
  EXPECT_EQ(wait.take_notice(kBegin + 4s, kKnown),
            "has waited 4 s for stream 'lidr': pc1's clock is unknown");
  wait.failed(kMissing, true, kBegin + 5s);
  EXPECT_EQ(wait.next_notice(), kNever);
}

TEST_F(Waiting, ComparesTheHostWhereOneIsWanted) {
  StreamWait other({"lidar", 0, "pc3"}, kBegin);
  other.failed({Errc::not_found, "there is no host 'pc3'"}, true, kBegin);
  EXPECT_EQ(other.take_notice(kBegin + 2s, kKnown),
            "has waited 2 s for stream 'lidar@pc3': there is no host 'pc3'; similar names: "
            "'lidar@pc1', 'lidar@pc2'");
}

}  // namespace
}  // namespace dssm::detail
