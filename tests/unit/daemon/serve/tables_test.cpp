// SPDX-License-Identifier: Apache-2.0
//
// What dssmd remembers about peers: what they take, and how much it logs about them.
#include <gtest/gtest.h>

#include "daemon/base/log.hpp"
#include "tests/unit/daemon/serve/server_rig.hpp"

namespace dssm::daemon {
namespace {

TEST(RateLimitedLogger, PassesALimitedNumberOfLinesAndCountsTheOthers) {
  LogRecorder to;
  MonoTime now{std::chrono::seconds(100)};
  RateLimitedLogger logger(to, [&] { return now; });
  for (int i = 0; i < 2 * RateLimitedLogger::kLinesPerPeriod; ++i) logger.warning("again");
  EXPECT_EQ(to.warnings.size(), static_cast<std::size_t>(RateLimitedLogger::kLinesPerPeriod));
  logger.info("of another level");
  EXPECT_TRUE(to.contains("of another level"));
  now += RateLimitedLogger::kPeriod;
  logger.warning("later");
  EXPECT_EQ(to.warnings.back(), "later (" + std::to_string(RateLimitedLogger::kLinesPerPeriod) +
                                    " such lines before this one were left out)");
  logger.warning("and on");
  EXPECT_EQ(to.warnings.back(), "and on");
}

TEST(PeerTable, GivesEverythingBack) {
  PeerTable table({3, 2, 1U << 20});
  {
    const PeerPlace first = *table.admit("pc2");
    const PeerPlace second = *table.admit("pc2");
    EXPECT_FALSE(table.admit("pc2")) << "two of one peer";
    EXPECT_EQ(&first.budget(), &second.budget()) << "one peer, one account";
    EXPECT_EQ(first.budget().used(), 2 * PeerTable::kConnectionBytes);
    const PeerPlace other = *table.admit("pc3");
    EXPECT_NE(&first.budget(), &other.budget());
    EXPECT_FALSE(table.admit("pc4")) << "three in all";
  }
  const PeerPlace again = *table.admit("pc2"), third = *table.admit("pc3"),
                  fourth = *table.admit("pc4");
  EXPECT_EQ(again.budget().used(), PeerTable::kConnectionBytes);
}

TEST(PeerTable, DoesNotCountConfiguredPeers) {
  PeerTable table({1, 2, 1U << 20});
  {
    const PeerPlace kept = *table.admit("pc2", false, true);
    EXPECT_FALSE(table.is_full());
    const PeerPlace other = *table.admit("pc3");
    EXPECT_TRUE(table.is_full());
    EXPECT_FALSE(table.admit("pc4"));
    const PeerPlace second = *table.admit("pc2", false, true);
    EXPECT_TRUE(table.is_full_for("pc2", false));
    EXPECT_FALSE(table.admit("pc2", false, true)) << "two of one peer";
  }
  EXPECT_FALSE(table.is_full_for("pc2", false));
  const PeerPlace again = *table.admit("pc4");
  EXPECT_TRUE(table.is_full());
}

TEST(PeerTable, BoundsTheMemoryOfAllPeersButConfiguredOnes) {
  constexpr std::uint64_t kPeerBytes = 2 * PeerTable::kConnectionBytes;
  PeerTable table({100, 100, kPeerBytes});
  std::vector<PeerPlace> places;
  const auto admit = [&](const std::string& peer, bool is_configured = false) {
    Result<PeerPlace> place = table.admit(peer, false, is_configured);
    if (place) places.push_back(*std::move(place));
    return place ? std::string() : place.error().message;
  };
  for (std::uint64_t i = 0; i < 2 * PeerTable::kFullPeers; ++i) {
    EXPECT_FALSE(table.is_full());
    EXPECT_EQ(admit("peer " + std::to_string(i)), "");
  }
  EXPECT_TRUE(table.is_full());
  EXPECT_NE(admit("one more").find(std::to_string(PeerTable::kFullPeers * kPeerBytes)),
            std::string::npos);
  EXPECT_FALSE(places.front().budget().try_take(1)) << "has half of its own left";
  EXPECT_EQ(admit("pc2", true), "") << "a configured one";
  EXPECT_TRUE(places.back().budget().try_take(1));
  LimitUses limits;
  table.add_limits(limits);
  EXPECT_EQ(limits.back().used, PeerTable::kFullPeers * kPeerBytes);
  EXPECT_EQ(limits.back().limit, PeerTable::kFullPeers * kPeerBytes);
  EXPECT_EQ(admit("peer 0", true), "") << "its name in `peers` has been looked up";
  table.add_limits(limits);
  EXPECT_EQ(limits.back().used, PeerTable::kFullPeers * kPeerBytes - PeerTable::kConnectionBytes);
  places.pop_back();
  EXPECT_NE(admit("peer 0"), "") << "it is not in `peers` any more";
  EXPECT_TRUE(table.is_full());
  table.set_limits({100, 100, kPeerBytes, 80 * kPeerBytes});
  EXPECT_EQ(admit("one more"), "") << "an eighth of the machine's memory";
}

TEST(PeerTable, ShowsWhatThePeerWithTheMostUses) {
  PeerTable table({5, 4, 1U << 20});
  const PeerPlace one = *table.admit("pc2"), two = *table.admit("pc2"), other = *table.admit("pc3");
  LimitUses limits;
  table.add_limits(limits);
  ASSERT_EQ(limits.size(), 4U);
  EXPECT_EQ(limits[0].name, "max_connections");
  EXPECT_EQ(limits[0].used, 3U);
  EXPECT_EQ(limits[0].limit, 5U);
  EXPECT_EQ(limits[1].name, "max_connections_per_host");
  EXPECT_EQ(limits[1].used, 2U);
  EXPECT_EQ(limits[1].limit, 4U);
  EXPECT_EQ(limits[2].name, "max_peer_memory");
  EXPECT_EQ(limits[2].used, 2 * PeerTable::kConnectionBytes);
  EXPECT_EQ(limits[2].limit, 1U << 20);
}

}  // namespace
}  // namespace dssm::daemon
