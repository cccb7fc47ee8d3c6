// SPDX-License-Identifier: Apache-2.0
//
// How much history is sent over simulated networks: little less than they carry, without a queue,
// and without what other streams need.
#include "daemon/link/history_pace.hpp"

#include <gtest/gtest.h>

#include <algorithm>

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

constexpr Duration kTick = 1ms;
constexpr double kBufferBytes = 256 << 10;  // of a connection, in the kernel

double per_tick(double bytes_per_s) {
  return bytes_per_s * std::chrono::duration<double>(kTick).count();
}

// A network of some rate with a queue before it, and one connection that always has history.
class Network final : public wire::Transport {
 public:
  Network(HistoryPace& pace, double rate) : bytes_per_s(rate), pace_(pace) {}

  // Some time passes. Returns the bytes of history that were sent each second of it.
  double run(Duration how_long) {
    double history = 0;
    for (const MonoTime end = now + how_long; now < end; now += kTick) history += tick();
    return history / std::chrono::duration<double>(how_long).count();
  }

  double carried_bytes_per_s() const { return pace_.carried_bytes_per_s(now); }

  MonoTime now{1000s};
  double bytes_per_s;
  double live_bytes_per_s = 0;          // of other connections
  double most_per_tick = kBufferBytes;  // of TCP that is not up to speed yet
  double queued_bytes = 0;
  bool is_receivers = false;  // what limits
  bool is_full = true;        // else it is this PC
  Duration round_trip = 100us, queue_time{};
  bool knows = true;
  bool has_history = true;
  mutable int asked = 0;  // how often the pace looked

  std::optional<wire::Progress> progress() const noexcept override {
    ++asked;
    if (!knows) return std::nullopt;
    constexpr std::uint32_t kPacketBytes = 1000;
    return wire::Progress{static_cast<std::uint32_t>(delivered_bytes_ / kPacketBytes),
                          kPacketBytes,
                          static_cast<std::uint64_t>(queued_bytes),
                          0,
                          0,
                          round_trip,
                          round_trip + queue_time,
                          sending_,
                          is_receivers ? sending_ : Duration()};
  }

 private:
  double tick() {
    const double live = per_tick(live_bytes_per_s);
    pace_.on_sent(static_cast<std::size_t>(live));
    const std::size_t allowed =
        has_history ? pace_.allowance(now, {this, sent_bytes_, *this}) : HistoryPace::kUnlimited;
    const double room = std::min(std::max(0.0, kBufferBytes - queued_bytes), most_per_tick);
    const double most = has_history ? std::min(room, static_cast<double>(allowed)) : 0;
    const double history = std::floor(most);
    EXPECT_TRUE(allowed > 0 || pace_.due() > now);
    sent_bytes_ += static_cast<std::uint64_t>(history);
    pace_.on_sent(static_cast<std::size_t>(history));
    pace_.on_history(static_cast<std::size_t>(history));
    if (is_full && has_history && history < static_cast<double>(allowed)) {
      pace_.on_full(this);
    }
    queued_bytes += history;
    const double carried = std::min(queued_bytes, std::max(0.0, per_tick(bytes_per_s) - live));
    queued_bytes -= carried;
    delivered_bytes_ += carried;
    if (queued_bytes + carried > 0) sending_ += kTick;
    return history;
  }

  Result<wire::IoResult> send(std::span<const iovec>) override { return wire::IoResult{}; }
  Result<wire::IoResult> receive(std::span<const iovec>) override { return wire::IoResult{}; }
  int fd() const noexcept override { return -1; }

  HistoryPace& pace_;
  std::uint64_t sent_bytes_ = 0;
  double delivered_bytes_ = 0;
  Duration sending_{};
};

class EachRate : public testing::TestWithParam<double> {};
INSTANTIATE_TEST_SUITE_P(, EachRate, testing::Values(1e6, 10e6, 110e6));

TEST_P(EachRate, IsAlmostFilledAndHasNoQueue) {
  HistoryPace pace;
  Network network(pace, GetParam());
  network.run(2s);
  EXPECT_LT(network.queued_bytes, HistoryPace::kMinPieceBytes + 3 * per_tick(GetParam()));
  const double history = network.run(2s);
  EXPECT_GE(history, 0.95 * HistoryPace::kShare * GetParam());
  EXPECT_LE(history, HistoryPace::kShare * GetParam() * 1.01);
}

TEST_P(EachRate, LeavesWhatLiveSamplesTake) {
  HistoryPace pace;
  Network network(pace, GetParam());
  network.run(2s);
  network.live_bytes_per_s = GetParam() / 2;
  EXPECT_NEAR(network.run(2s), (HistoryPace::kShare - 0.5) * GetParam(), 0.02 * GetParam());
  network.live_bytes_per_s = 0.9 * GetParam();
  EXPECT_NEAR(network.run(2s), HistoryPace::kLeastShare * GetParam(), 0.02 * GetParam())
      << "those who read one sample after the other do not wait for ever";
}

TEST_P(EachRate, IsKnownWhileItIsValid) {
  HistoryPace pace;
  EXPECT_EQ(pace.carried_bytes_per_s(MonoTime()), 0);
  Network network(pace, GetParam());
  network.run(2s);
  EXPECT_NEAR(pace.carried_bytes_per_s(network.now), GetParam(), 0.1 * GetParam());
  EXPECT_EQ(pace.carried_bytes_per_s(network.now + HistoryPace::kMaxValid), 0);
}

TEST(HistoryPace, CountsLiveSamplesThatPassWhileItMeasures) {
  HistoryPace pace;
  Network network(pace, 50e6);
  network.live_bytes_per_s = 20e6;
  network.run(1s);
  EXPECT_NEAR(network.run(2s), HistoryPace::kShare * 50e6 - 20e6, 2e6);
}

TEST(HistoryPace, WaitsUntilTcpIsUpToSpeed) {
  HistoryPace pace;
  Network network(pace, 100e6);
  network.round_trip = 20ms;
  for (double most = 1000; most < 1e6; most *= 2) {
    network.most_per_tick = most;
    network.run(network.round_trip);
  }
  network.run(1s);
  EXPECT_GE(network.run(1s), 0.9 * HistoryPace::kShare * 100e6);
}

// It is measured, and history is sent as fast as it goes.
void expect_left_alone(Network& network) {
  network.run(1s);
  const int asked = network.asked;
  EXPECT_EQ(network.carried_bytes_per_s(), 0) << "of the network nothing is known";
  EXPECT_GE(network.run(1s), 0.99 * network.bytes_per_s) << "no other stream waits for it";
  EXPECT_EQ(network.asked, asked) << "it is measured";
}

TEST(HistoryPace, LeavesFastNetworksAlone) {
  HistoryPace pace;
  Network network(pace, 1.25 * HistoryPace::kFastBytesPerS);
  network.most_per_tick = per_tick(network.bytes_per_s);
  expect_left_alone(network);
}

TEST(HistoryPace, LeavesSlowReceiversAlone) {
  HistoryPace pace;
  Network network(pace, 20e6);
  network.is_receivers = true;
  expect_left_alone(network);
}

TEST(HistoryPace, LeavesSlowSendersAlone) {
  HistoryPace pace;
  Network network(pace, 20e6);
  network.is_full = false;
  expect_left_alone(network);
}

TEST(HistoryPace, TakesAFullNetworkForTheLimitAlsoWhereTheReceiverIsSlow) {
  HistoryPace pace;
  Network network(pace, 20e6);
  network.is_receivers = true;
  network.queue_time = 2 * HistoryPace::kQueued;
  network.run(1s);
  EXPECT_NEAR(network.run(1s), HistoryPace::kShare * 20e6, 1e6);
}

TEST(HistoryPace, IsNoneWhereNothingIsKnown) {
  HistoryPace pace;
  Network network(pace, 20e6);
  network.knows = false;
  network.run(1s);
  EXPECT_EQ(network.asked, 1);
  EXPECT_GE(network.run(1s), 0.99 * network.bytes_per_s);
}

TEST(HistoryPace, FollowsANetworkThatBecomesSlowerOrFaster) {
  HistoryPace pace;
  Network network(pace, 40e6);
  network.run(1s);
  network.bytes_per_s = 10e6;
  network.run(2 * HistoryPace::kPeriod);
  EXPECT_NEAR(network.run(1s), HistoryPace::kShare * 10e6, 1e6);
  network.bytes_per_s = 40e6;
  network.run(HistoryPace::kMinValid);
  EXPECT_NEAR(network.run(1s), HistoryPace::kShare * 40e6, 2e6);
}

TEST(HistoryPace, ForgivesAPause) {
  HistoryPace pace;
  Network network(pace, 40e6);
  network.run(1s);
  network.bytes_per_s = 0;
  network.run(HistoryPace::kPeriod / 5);
  network.bytes_per_s = 40e6;
  network.run(HistoryPace::kPeriod);
  EXPECT_LT(network.queued_bytes, 4 * per_tick(40e6));
  EXPECT_NEAR(network.run(1s), HistoryPace::kShare * 40e6, 1e6);
}

// Two connections share a network that needs longer for a window than they wait for each other.
TEST(HistoryPace, IsMeasuredByOneConnectionAtATime) {
  HistoryPace pace;
  Network first(pace, 0.5e6), second(pace, 0.5e6);
  double history = 0;
  for (int tick = 0; tick < 10'000; ++tick) {
    const double sent = first.run(kTick) + second.run(kTick);
    if (tick >= 8000) history += sent * std::chrono::duration<double>(kTick).count() / 2;
  }
  EXPECT_NEAR(history, HistoryPace::kShare * 1e6, 0.1e6);
}

TEST(HistoryPace, IsMeasuredByAnotherConnectionWhenTheFirstOneHasNoMore) {
  HistoryPace pace;
  Network first(pace, 10e6), second(pace, 10e6);
  first.run(5ms);
  second.now = first.now;
  second.run(HistoryPace::kMaxWindow + 500ms);
  EXPECT_NEAR(second.run(1s), HistoryPace::kShare * 10e6, 1e6);
}

TEST(HistoryPace, IsMeasuredByAnotherConnectionWhenTheFirstOneEnds) {
  HistoryPace pace;
  Network first(pace, 10e6), second(pace, 10e6);
  first.run(5ms);
  pace.forget(&first);
  second.now = first.now;
  second.run(500ms);
  EXPECT_NEAR(second.run(1s), HistoryPace::kShare * 10e6, 1e6);
}

// The time without history is no time in which the network carried little.
TEST(HistoryPace, CountsOnlyTheTimeInWhichThereIsHistory) {
  for (const Duration pause : {Duration(500ms), Duration(30s)}) {
    for (const Duration first : {Duration(3ms), Duration(12ms), Duration(25ms), Duration(40ms)}) {
      HistoryPace pace;
      Network network(pace, 10e6);
      network.run(first);
      network.has_history = false;
      network.run(pause);
      network.has_history = true;
      network.run(1s);
      EXPECT_NEAR(network.run(1s), HistoryPace::kShare * 10e6, 1e6) << first / 1ms;
    }
  }
}

TEST(HistoryPace, CountsHistoryOnceThatIsQueued) {
  HistoryPace pace;
  Network network(pace, 10e6);
  network.run(2s);
  network.has_history = false;
  pace.on_history(2'000'000);  // waits to be sent
  network.run(100ms);
  pace.on_sent(2'000'000);
  network.has_history = true;
  EXPECT_NEAR(network.run(1s) + 2e6, HistoryPace::kShare * 11e6, 1e6);
}

TEST(HistoryPace, CountsHistoryNoMoreThatWillNotBeSent) {
  HistoryPace pace;
  Network network(pace, 10e6);
  network.run(2s);
  pace.on_history(20'000'000);
  EXPECT_EQ(network.run(100ms), 0);
  pace.on_history_dropped(20'000'000);
  EXPECT_NEAR(network.run(1s), HistoryPace::kShare * 10e6, 1e6);
}

class EachShare : public testing::TestWithParam<double> {};
INSTANTIATE_TEST_SUITE_P(, EachShare, testing::Values(0.01, 0.3, 0.99));

TEST_P(EachShare, IsWhatHistoryTakes) {
  HistoryShare share;
  share.set(GetParam());
  MonoTime now{1000s};
  EXPECT_EQ(share.allowance(now, 0), HistoryPace::kUnlimited);
  share.on_history(100'000'000);
  EXPECT_EQ(share.allowance(now, 0), HistoryPace::kUnlimited) << "and that does not count";
  double sent = 0;
  for (const MonoTime end = now + 10s; now < end;) {
    const std::size_t allowed = share.allowance(now, 10e6);
    sent += static_cast<double>(allowed);
    share.on_history(allowed);
    EXPECT_TRUE(allowed > 0 || share.due() > now);
    now = std::max(share.due(), now + 100us);
  }
  EXPECT_NEAR(sent, GetParam() * 100e6, 0.01 * GetParam() * 100e6 + 30e3);
}

TEST(HistoryShare, LimitsNothingWhileTheNetworkIsNotKnown) {
  HistoryShare share;
  share.set(0.01);
  EXPECT_EQ(share.allowance(MonoTime(1000s), 0), HistoryPace::kUnlimited);
  share.set(1);
  EXPECT_EQ(share.allowance(MonoTime(1000s), 1e6), HistoryPace::kUnlimited);
}

}  // namespace
}  // namespace dssm::daemon
