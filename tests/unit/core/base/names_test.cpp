// SPDX-License-Identifier: Apache-2.0
#include "core/base/names.hpp"

#include <gtest/gtest.h>

namespace dssm {
namespace {

using Names = std::vector<std::string>;

TEST(SimilarNames, FindsTypingErrorsBestFirst) {
  EXPECT_EQ(similar_names("lidr", {"odom", "lida", "lidar", "camera"}), (Names{"lida", "lidar"}));
  EXPECT_EQ(similar_names("ladir", {"lidar"}), Names{});  // two edits of five are too many
}

TEST(SimilarNames, CountsTwoSwappedNeighboursAsOneError) {
  EXPECT_EQ(similar_names("ehco", {"echo", "hz"}), Names{"echo"});
  EXPECT_EQ(similar_names("lidra", {"lidar"}), Names{"lidar"});
  EXPECT_EQ(similar_names("lidrax", {"lidar"}), Names{"lidar"});  // and one to delete
  EXPECT_EQ(similar_names("ilda", {"lidar"}), Names{});           // two errors of four
}

TEST(SimilarNames, FindsPartsOfNames) {
  EXPECT_EQ(similar_names("lidar", {"front_lidar", "imu"}), Names{"front_lidar"});
  EXPECT_EQ(similar_names("front_lidar", {"lidar", "imu"}), Names{"lidar"});
}

TEST(SimilarNames, FindsAnotherId) {
  EXPECT_EQ(similar_names("lidar:2", {"lidar:1", "imu"}), Names{"lidar:1"});
}

TEST(SimilarNames, NamesEachOnce) {
  EXPECT_EQ(similar_names("lidr", {"lidar", "lidar"}), Names{"lidar"});
}

TEST(SimilarNames, NamesThreeAtMost) {
  EXPECT_EQ(similar_names("cam", {"cam1", "cam2", "cam3", "cam4"}).size(), 3U);
}

TEST(SimilarNames, HasNoGuessForWhatIsNothingAlike) {
  EXPECT_EQ(similar_names("zzz", {"odom", "lidar"}), Names{});
  EXPECT_EQ(similar_names("x", {}), Names{});
  EXPECT_EQ(similar_names(std::string(100'000, 'x'), {"odom"}), Names{});
}

}  // namespace
}  // namespace dssm
