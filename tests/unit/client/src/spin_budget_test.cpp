// SPDX-License-Identifier: Apache-2.0
#include "client/src/spin_budget.hpp"

#include <gtest/gtest.h>

namespace dssm::detail {
namespace {

constexpr std::size_t kOneSpin =
    2 * static_cast<std::size_t>(SpinBudget::kMaxSpin.count());  // bytes

// Has nothing for a while, or for ever.
class FakeTransport final : public wire::Transport {
 public:
  int polls = 0, sleeps = 0;
  int empty_polls = 0;  // before something is there

  Result<wire::IoResult> send(std::span<const iovec>) override { return wire::IoResult{}; }
  Result<wire::IoResult> receive(std::span<const iovec>) override {
    if (++polls <= empty_polls) return wire::IoResult{wire::IoStatus::would_block, 0};
    return wire::IoResult{wire::IoStatus::ok, 1};
  }
  Result<wire::IoResult> receive_waiting(std::span<const iovec>) override {
    ++sleeps;
    return wire::IoResult{wire::IoStatus::would_block, 0};
  }
  int fd() const noexcept override { return -1; }
};

constexpr int kAlways = 1 << 30;
constexpr int kMany = 10'000'000;  // rounds that last longer by far than any credit

wire::IoStatus receive(SpinBudget& spin_budget, FakeTransport& transport) {
  return spin_budget.receive(transport, {}).value().status;
}

TEST(SpinBudget, SleepsUntilEnoughWasReceived) {
  SpinBudget spin_budget;
  FakeTransport transport;
  spin_budget.on_received(kOneSpin - 2);
  EXPECT_FALSE(spin_budget.may_spin());
  EXPECT_EQ(receive(spin_budget, transport), wire::IoStatus::would_block);
  EXPECT_EQ(transport.polls, 0);
  EXPECT_EQ(transport.sleeps, 1);
  spin_budget.on_received(2);
  EXPECT_TRUE(spin_budget.may_spin());
}

TEST(SpinBudget, ReceivesWithoutSleepingWhatArrivesSoon) {
  SpinBudget spin_budget;
  FakeTransport transport;
  transport.empty_polls = 3;
  spin_budget.on_received(kOneSpin);
  // On a stalled machine its time may be over sooner.
  while (receive(spin_budget, transport) != wire::IoStatus::ok) {
    ASSERT_GE(transport.polls, transport.sleeps) << "it polls before it sleeps";
    spin_budget.on_received(64 * kOneSpin);
  }
  EXPECT_EQ(transport.polls, 4);
}

TEST(SpinBudget, SleepsAfterMaxSpin) {
  SpinBudget spin_budget;
  FakeTransport transport;
  transport.empty_polls = kAlways;
  spin_budget.on_received(kOneSpin);
  const MonoTime begin = MonoClock::now();
  EXPECT_EQ(receive(spin_budget, transport), wire::IoStatus::would_block);
  EXPECT_GE(MonoClock::now() - begin, SpinBudget::kMaxSpin);
  EXPECT_GT(transport.polls, 0);
  EXPECT_EQ(transport.sleeps, 1);
}

TEST(SpinBudget, DoublesCostWithEachEmptySpin) {
  SpinBudget spin_budget;
  FakeTransport transport;
  transport.empty_polls = kAlways;
  for (std::size_t cost : {1, 2, 4, 8, 16, 32, 64, 64}) {
    spin_budget.on_received(cost * kOneSpin - 2);
    EXPECT_FALSE(spin_budget.may_spin()) << cost;
    spin_budget.on_received(2);
    ASSERT_TRUE(spin_budget.may_spin()) << cost;
    receive(spin_budget, transport);
    EXPECT_FALSE(spin_budget.may_spin()) << "nothing is left";
  }
  transport.empty_polls = 0;
  spin_budget.on_received(64 * kOneSpin);
  EXPECT_EQ(receive(spin_budget, transport), wire::IoStatus::ok);
  transport.empty_polls = kAlways;
  receive(spin_budget, transport);  // in vain, which costs all of it
  spin_budget.on_received(2 * kOneSpin);
  EXPECT_TRUE(spin_budget.may_spin()) << "one that was not in vain makes them cheap again";
}

TEST(SpinBudget, IsLimited) {
  SpinBudget spin_budget;
  FakeTransport transport;
  spin_budget.on_received(1U << 30);
  Duration held{0};
  // A count, because time may go by between the rounds, too, which earns and costs nothing.
  for (int rounds = 0; spin_budget.may_spin() && rounds < kMany; ++rounds) {
    const MonoTime begin = MonoClock::now();
    receive(spin_budget, transport);
    held += MonoClock::now() - begin;
    ASSERT_EQ(transport.sleeps, 0);
  }
  EXPECT_FALSE(spin_budget.may_spin()) << "each is paid for";
  EXPECT_GE(held, (SpinBudget::kMaxCostFactor - 1) * SpinBudget::kMaxSpin);
}

}  // namespace
}  // namespace dssm::detail
