// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/names.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

using Names = std::vector<std::string>;

Names opening(const std::vector<StreamId>& ids) {
  std::vector<StreamInfo> streams;
  for (const StreamId& id : ids) streams.emplace_back().id = id;
  return opening_names(streams, "pc1");
}

TEST(OpeningNames, AreShortWhereOneStreamHasTheName) {
  EXPECT_EQ(opening({{"odom", 0, "pc1"}, {"lidar", 0, "pc2"}, {"lidar", 1, "pc3"}}),
            (Names{"odom", "lidar", "lidar:1"}));
}

TEST(OpeningNames, AreShortForAnOwnStreamAndNameTheHostOfOthers) {
  EXPECT_EQ(opening({{"odom", 0, "pc1"}, {"odom", 0, "pc2"}, {"odom", 0, "pc3"}}),
            (Names{"odom", "odom@pc2", "odom@pc3"}));
}

TEST(OpeningNames, NameTheHostsWhenOnlyOthersHaveTheStream) {
  EXPECT_EQ(opening({{"cam", 2, "pc2"}, {"cam", 2, "pc3"}}), (Names{"cam:2@pc2", "cam:2@pc3"}));
}

bool fits(const std::string& pattern, const StreamId& id) {
  return StreamFilter({}, {pattern}).takes(id);
}

TEST(StreamFilter, FitsAPatternToTheNameOrTheNameWithItsId) {
  const StreamId camera{"camera_left", 3, "pc2"};
  for (const char* pattern : {"*", "camera*", "camera_left", "c?mera_[lr]*", "camera_left:3",
                              "camera*:*", "*:3", "camera_[[:alpha:]]*"}) {
    EXPECT_TRUE(fits(pattern, camera)) << pattern;
  }
  for (const char* pattern : {"camera", "*:4", "Camera*", "3", "*3", "camera_[[:digit:]]*"}) {
    EXPECT_FALSE(fits(pattern, camera)) << pattern;
  }
}

TEST(StreamFilter, ChecksTheHostOnlyWhereThePatternHasOne) {
  const StreamId lidar{"lidar", 0, "pc2"};
  for (const char* pattern : {"lidar@pc2", "*@pc2", "lidar:0@pc?", "*@*"}) {
    EXPECT_TRUE(fits(pattern, lidar)) << pattern;
  }
  for (const char* pattern : {"lidar@pc3", "*2", "lidar:1@pc2"}) {
    EXPECT_FALSE(fits(pattern, lidar)) << pattern;
  }
}

TEST(StreamFilter, TakesStreamsOfTheGivenHostsOnly) {
  const StreamFilter filter({"pc2", "pc3"}, {"c*", "l*"});
  EXPECT_TRUE(filter.takes({"lidar", 0, "pc2"}));
  EXPECT_TRUE(filter.takes({"lidar", 0, "pc3"}));
  EXPECT_FALSE(filter.takes({"lidar", 0, "pc1"}));
  EXPECT_FALSE(filter.takes({"odom", 0, "pc2"}));
  EXPECT_TRUE(StreamFilter({}, {}).takes({"odom", 0, "pc2"}));
  EXPECT_EQ(filter.patterns(), (std::vector<std::string>{"c*", "l*"}));
  EXPECT_EQ(StreamFilter({}, {}).patterns(), std::vector<std::string>{"*"});
}

TEST(PatternOf, FitsThatStreamOnly) {
  const StreamId stars{"c*[a]?\\", 3, "pc2"};
  const StreamFilter filter({}, {pattern_of(stars.str())});
  EXPECT_TRUE(filter.takes(stars));
  EXPECT_FALSE(filter.takes({"c*a?\\", 3, "pc2"}));
  EXPECT_FALSE(filter.takes({"cam[a]?\\", 3, "pc2"}));
  EXPECT_FALSE(filter.takes({stars.name, 4, "pc2"}));
  EXPECT_FALSE(filter.takes({stars.name, 3, "pc1"}));
}

TEST(Duplicates, AreStreamsOfOneNameAndIdOnSeveralHosts) {
  std::vector<StreamInfo> streams;
  for (const StreamId& id : std::vector<StreamId>{
           {"lidar", 0, "pc1"}, {"lidar", 1, "pc1"}, {"odom", 0, "pc2"}, {"lidar", 0, "pc3"}}) {
    streams.emplace_back().id = id;
  }
  const Duplicates duplicates(streams);
  EXPECT_TRUE(duplicates.has({"lidar", 0, "pc3"}));
  EXPECT_FALSE(duplicates.has({"lidar", 1, "pc1"}));
  EXPECT_FALSE(duplicates.has({"odom", 0, "pc2"}));
  ASSERT_EQ(duplicates.owners().size(), 1U);
  EXPECT_EQ(duplicates.owners().begin()->second, (std::vector<std::string>{"pc1", "pc3"}));
}

}  // namespace
}  // namespace dssm::ctl
