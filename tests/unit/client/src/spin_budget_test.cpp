// SPDX-License-Identifier: Apache-2.0
#include "client/src/spin_budget.hpp"

#include <gtest/gtest.h>

namespace dssm::detail {
namespace {

constexpr std::size_t kEnough =
    2 * static_cast<std::size_t>(SpinBudget::kLongest.count());  // bytes

// Has nothing for a while, or for ever.
class FakeTransport final : public wire::Transport {
 public:
  int looks = 0, sleeps = 0;
  int looks_in_vain = 0;  // before something is there

  Result<wire::IoResult> send(std::span<const iovec>) override { return wire::IoResult{}; }
  Result<wire::IoResult> receive(std::span<const iovec>) override {
    if (++looks <= looks_in_vain) return wire::IoResult{wire::IoStatus::would_block, 0};
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

TEST(SpinBudget, HasToBeEarned) {
  SpinBudget spin_budget;
  FakeTransport transport;
  spin_budget.on_received(kEnough - 2);
  EXPECT_FALSE(spin_budget.is_earned());
  EXPECT_EQ(receive(spin_budget, transport), wire::IoStatus::would_block);
  EXPECT_EQ(transport.looks, 0);
  EXPECT_EQ(transport.sleeps, 1);
  spin_budget.on_received(2);
  EXPECT_TRUE(spin_budget.is_earned());
}

TEST(SpinBudget, TakesWhatComesSoonWithoutSleeping) {
  SpinBudget spin_budget;
  FakeTransport transport;
  transport.looks_in_vain = 3;
  spin_budget.on_received(kEnough);
  // On a stalled machine its time may be over sooner.
  while (receive(spin_budget, transport) != wire::IoStatus::ok) {
    ASSERT_GE(transport.looks, transport.sleeps) << "it looks before it sleeps";
    spin_budget.on_received(64 * kEnough);
  }
  EXPECT_EQ(transport.looks, 4);
}

TEST(SpinBudget, IsShort) {
  SpinBudget spin_budget;
  FakeTransport transport;
  transport.looks_in_vain = kAlways;
  spin_budget.on_received(kEnough);
  const MonoTime begin = MonoClock::now();
  EXPECT_EQ(receive(spin_budget, transport), wire::IoStatus::would_block);
  EXPECT_GE(MonoClock::now() - begin, SpinBudget::kLongest);
  EXPECT_GT(transport.looks, 0);
  EXPECT_EQ(transport.sleeps, 1);
}

TEST(SpinBudget, GetsDearerWithEachInVain) {
  SpinBudget spin_budget;
  FakeTransport transport;
  transport.looks_in_vain = kAlways;
  for (std::size_t price : {1, 2, 4, 8, 16, 32, 64, 64}) {
    spin_budget.on_received(price * kEnough - 2);
    EXPECT_FALSE(spin_budget.is_earned()) << price;
    spin_budget.on_received(2);
    ASSERT_TRUE(spin_budget.is_earned()) << price;
    receive(spin_budget, transport);
    EXPECT_FALSE(spin_budget.is_earned()) << "nothing is left";
  }
  transport.looks_in_vain = 0;
  spin_budget.on_received(64 * kEnough);
  EXPECT_EQ(receive(spin_budget, transport), wire::IoStatus::ok);
  transport.looks_in_vain = kAlways;
  receive(spin_budget, transport);  // in vain, which costs all of it
  spin_budget.on_received(2 * kEnough);
  EXPECT_TRUE(spin_budget.is_earned()) << "one that was not in vain makes them cheap again";
}

TEST(SpinBudget, CannotBeEarnedForLong) {
  SpinBudget spin_budget;
  FakeTransport transport;
  spin_budget.on_received(1U << 30);
  Duration held{0};
  // A count, because time may go by between the rounds, too, which earns and costs nothing.
  for (int rounds = 0; spin_budget.is_earned() && rounds < kMany; ++rounds) {
    const MonoTime begin = MonoClock::now();
    receive(spin_budget, transport);
    held += MonoClock::now() - begin;
    ASSERT_EQ(transport.sleeps, 0);
  }
  EXPECT_FALSE(spin_budget.is_earned()) << "each is paid for";
  EXPECT_GE(held, (SpinBudget::kDearest - 1) * SpinBudget::kLongest);
}

}  // namespace
}  // namespace dssm::detail
