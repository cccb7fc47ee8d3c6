// SPDX-License-Identifier: Apache-2.0
#include "client/src/vigil.hpp"

#include <gtest/gtest.h>

namespace dssm::detail {
namespace {

constexpr std::size_t kEnough = 2 * static_cast<std::size_t>(Vigil::kLongest.count());  // bytes

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

wire::IoStatus receive(Vigil& vigil, FakeTransport& transport) {
  return vigil.receive(transport, {}).value().status;
}

TEST(Vigil, HasToBeEarned) {
  Vigil vigil;
  FakeTransport transport;
  vigil.on_received(kEnough - 2);
  EXPECT_FALSE(vigil.is_earned());
  EXPECT_EQ(receive(vigil, transport), wire::IoStatus::would_block);
  EXPECT_EQ(transport.looks, 0);
  EXPECT_EQ(transport.sleeps, 1);
  vigil.on_received(2);
  EXPECT_TRUE(vigil.is_earned());
}

TEST(Vigil, TakesWhatComesSoonWithoutSleeping) {
  Vigil vigil;
  FakeTransport transport;
  transport.looks_in_vain = 3;
  vigil.on_received(kEnough);
  // On a stalled machine its time may be over sooner.
  while (receive(vigil, transport) != wire::IoStatus::ok) {
    ASSERT_GE(transport.looks, transport.sleeps) << "it looks before it sleeps";
    vigil.on_received(64 * kEnough);
  }
  EXPECT_EQ(transport.looks, 4);
}

TEST(Vigil, IsShort) {
  Vigil vigil;
  FakeTransport transport;
  transport.looks_in_vain = kAlways;
  vigil.on_received(kEnough);
  const MonoTime begin = MonoClock::now();
  EXPECT_EQ(receive(vigil, transport), wire::IoStatus::would_block);
  EXPECT_GE(MonoClock::now() - begin, Vigil::kLongest);
  EXPECT_GT(transport.looks, 0);
  EXPECT_EQ(transport.sleeps, 1);
}

TEST(Vigil, GetsDearerWithEachInVain) {
  Vigil vigil;
  FakeTransport transport;
  transport.looks_in_vain = kAlways;
  for (std::size_t price : {1, 2, 4, 8, 16, 32, 64, 64}) {
    vigil.on_received(price * kEnough - 2);
    EXPECT_FALSE(vigil.is_earned()) << price;
    vigil.on_received(2);
    ASSERT_TRUE(vigil.is_earned()) << price;
    receive(vigil, transport);
    EXPECT_FALSE(vigil.is_earned()) << "nothing is left";
  }
  transport.looks_in_vain = 0;
  vigil.on_received(64 * kEnough);
  EXPECT_EQ(receive(vigil, transport), wire::IoStatus::ok);
  transport.looks_in_vain = kAlways;
  receive(vigil, transport);  // in vain, which costs all of it
  vigil.on_received(2 * kEnough);
  EXPECT_TRUE(vigil.is_earned()) << "one that was not in vain makes them cheap again";
}

TEST(Vigil, CannotBeEarnedForLong) {
  Vigil vigil;
  FakeTransport transport;
  vigil.on_received(1U << 30);
  Duration held{0};
  // A count, because time may go by between the rounds, too, which earns and costs nothing.
  for (int rounds = 0; vigil.is_earned() && rounds < kMany; ++rounds) {
    const MonoTime begin = MonoClock::now();
    receive(vigil, transport);
    held += MonoClock::now() - begin;
    ASSERT_EQ(transport.sleeps, 0);
  }
  EXPECT_FALSE(vigil.is_earned()) << "each is paid for";
  EXPECT_GE(held, (Vigil::kDearest - 1) * Vigil::kLongest);
}

}  // namespace
}  // namespace dssm::detail
