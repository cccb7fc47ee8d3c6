// SPDX-License-Identifier: Apache-2.0
#include "core/channel/connect_plan.hpp"

#include <gtest/gtest.h>

namespace dssm::channel {
namespace {

using namespace std::chrono_literals;

std::vector<wire::SocketAddress> addresses(int count) {
  std::vector<wire::SocketAddress> made;
  for (int i = 1; i <= count; ++i) {
    const std::string text = "10.0.0." + std::to_string(i);
    made.push_back(wire::resolve_number(wire::Address::parse(text).value()).at(0));
  }
  return made;
}

std::string last_byte(const ConnectPlan& plan) {
  const std::string text = plan.address().str();
  return text.substr(text.rfind('.') + 1, 1);
}

// The order in which a round tries its addresses: "123".
std::string round(ConnectPlan& plan, int count) {
  plan.begin_round(addresses(count));
  std::string order = last_byte(plan);
  while (plan.next_address()) order += last_byte(plan);
  return order;
}

TEST(ConnectPlan, TriesTheAddressesInTurn) {
  ConnectPlan plan;
  EXPECT_EQ(round(plan, 3), "123");
  plan.end_round(MonoTime(), false);
  EXPECT_EQ(round(plan, 3), "123");
}

TEST(ConnectPlan, BeginsAfterAnAddressThatIsToBeAvoidedOnce) {
  ConnectPlan plan;
  plan.begin_round(addresses(3));
  ASSERT_TRUE(plan.next_address());
  plan.end_round(MonoTime(), true);
  EXPECT_EQ(round(plan, 3), "312");
  plan.end_round(MonoTime(), false);
  EXPECT_EQ(round(plan, 3), "123");
}

TEST(ConnectPlan, PausesTwiceAsLongAfterEachFailureUpToALimit) {
  ConnectPlan plan;
  plan.begin_round(addresses(1));
  for (Duration pause = ConnectPlan::kFirstPause; pause < ConnectPlan::kMaxPause; pause *= 2) {
    EXPECT_EQ(plan.end_round(MonoTime(), false), pause);
  }
  EXPECT_EQ(plan.end_round(MonoTime(), false), ConnectPlan::kMaxPause);
  EXPECT_EQ(plan.end_round(MonoTime(), false), ConnectPlan::kMaxPause);
  plan.reset_pause();
  EXPECT_EQ(plan.end_round(MonoTime(), false), ConnectPlan::kFirstPause);
}

TEST(ConnectPlan, PausesShortlyOnlyAfterAConnectionThatWasUseful) {
  ConnectPlan plan;
  plan.begin_round(addresses(1));
  MonoTime now(100s);
  const auto connect_for = [&](Duration time) {
    plan.on_up(now);
    now += time;
    return plan.end_round(now, false);
  };
  EXPECT_EQ(connect_for(1ms), ConnectPlan::kFirstPause);
  EXPECT_EQ(connect_for(1ms), 2 * ConnectPlan::kFirstPause) << "it greets and then refuses";
  EXPECT_EQ(connect_for(ConnectPlan::kUsefulTime), ConnectPlan::kFirstPause);
  EXPECT_EQ(connect_for(1ms), 2 * ConnectPlan::kFirstPause);
  now += 1h;
  EXPECT_EQ(plan.end_round(now, false), 4 * ConnectPlan::kFirstPause) << "it was not up";
  plan.on_up(now);
  plan.reset_pause();
  EXPECT_EQ(plan.end_round(now, false), ConnectPlan::kFirstPause);
}

TEST(ConnectPlan, TriesOftenForAWhileAfterAConnectionThatWasUseful) {
  ConnectPlan plan;
  plan.begin_round(addresses(1));
  MonoTime now(100s);
  plan.on_connected(ConnectPlan::kFastConnect);
  plan.on_up(now);
  const MonoTime lost = now += 1h;
  plan.end_round(now, false);
  int long_rounds = 0;
  while (true) {
    plan.begin_round(addresses(1));
    const Duration timeout = plan.connect_timeout();
    EXPECT_TRUE(timeout == ConnectPlan::kRecentTimeout || timeout == ConnectPlan::kConnectTimeout);
    if (timeout == ConnectPlan::kConnectTimeout) ++long_rounds;
    now += timeout;
    const Duration pause = plan.end_round(now, false);
    if (now - lost >= ConnectPlan::kRecentTime) {
      EXPECT_EQ(pause, ConnectPlan::kMaxPause);
      break;
    }
    EXPECT_LE(pause, ConnectPlan::kRecentPause);
    now += pause;
  }
  // 32 rounds take 31 short timeouts, a long one and 32 pauses.
  EXPECT_NEAR(long_rounds, ConnectPlan::kRecentTime / 11400ms, 1);
  EXPECT_GE(long_rounds, 1);
  plan.begin_round(addresses(1));
  EXPECT_EQ(plan.connect_timeout(), ConnectPlan::kConnectTimeout);
}

TEST(ConnectPlan, TriesOftenOnlyWhereNobodyAnswers) {
  ConnectPlan plan;
  plan.begin_round(addresses(1));
  plan.on_connected(1ms);
  plan.on_connected(ConnectPlan::kFirstRepeat);  // a packet was lost: that says nothing
  plan.on_up(MonoTime(100s));
  plan.end_round(MonoTime(200s), false);
  plan.begin_round(addresses(1));
  EXPECT_EQ(plan.connect_timeout(), ConnectPlan::kRecentTimeout);
  EXPECT_EQ(plan.repeat_after(), ConnectPlan::kRepeat);
  for (int round = 0; round < 10; ++round) {  // refused each time: nobody listens there
    plan.begin_round(addresses(1));
    plan.end_round(MonoTime(200s), false);
  }
  EXPECT_EQ(plan.end_round(MonoTime(200s), false), ConnectPlan::kRecentPause);
  plan.on_no_answer();
  EXPECT_EQ(plan.end_round(MonoTime(200s), false), ConnectPlan::kFirstPause);
  plan.on_up(MonoTime(200s));
  plan.end_round(MonoTime(200s + 1ms), false);  // it greets and then refuses
  plan.begin_round(addresses(1));
  EXPECT_EQ(plan.connect_timeout(), ConnectPlan::kConnectTimeout);
  EXPECT_EQ(plan.repeat_after(), std::nullopt);
}

TEST(ConnectPlan, GivesASlowNetworkMoreTime) {
  ConnectPlan plan;
  plan.begin_round(addresses(1));
  plan.on_connected(ConnectPlan::kFastConnect + 1ms);
  plan.on_up(MonoTime(100s));
  plan.end_round(MonoTime(200s), false);
  plan.begin_round(addresses(1));
  EXPECT_EQ(plan.connect_timeout(), ConnectPlan::kConnectTimeout);
}

TEST(ConnectPlan, LetsTheAddressesShareTheTimeOfARound) {
  ConnectPlan plan(2s);
  plan.begin_round(addresses(4));
  EXPECT_EQ(plan.connect_timeout(), 500ms);
  ConnectPlan patient;
  patient.begin_round(addresses(4));
  EXPECT_EQ(patient.connect_timeout(), ConnectPlan::kConnectTimeout);
}

}  // namespace
}  // namespace dssm::channel
