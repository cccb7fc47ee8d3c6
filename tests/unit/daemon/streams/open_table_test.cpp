// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/open_table.hpp"

#include <gtest/gtest.h>

#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

class OpenTableTest : public testing::Test {
 protected:
  std::shared_ptr<Stream> stream(const std::string& name) {
    return registry_.create({name, 0, ""}, odometry_type(), kHistory, 1)->stream;
  }
  Registry registry_{"pc1", kLimits};
  OpenTable table_{{.max_opens = 3, .max_opens_per_client = 2}};
};

TEST_F(OpenTableTest, CountsWritersAndReadersOfEachStream) {
  const auto a = stream("a"), b = stream("b");
  table_.add({client(1), a, Role::writer, 0});
  table_.add({client(2), a, Role::reader, 0});
  const OpenNumber last = table_.add({client(2), b, Role::reader, 0});
  EXPECT_EQ(table_.counts(*a).writers, 1u);
  EXPECT_EQ(table_.counts(*a).readers, 1u);
  EXPECT_EQ(table_.counts(*b).readers, 1u);
  EXPECT_TRUE(table_.remove(2, last));
  EXPECT_EQ(table_.counts(*b).readers, 0u);
  EXPECT_EQ(table_.users(*a).size(), 2u);
  EXPECT_EQ(table_.users(*a)[0].pid, 1001);
  EXPECT_EQ(table_.users(*a)[0].role, Role::writer);
}

TEST_F(OpenTableTest, LetsAClientCloseOnlyItsOwnHandlesAndOnlyOnce) {
  const OpenNumber number = table_.add({client(1), stream("a"), Role::reader, 0});
  EXPECT_FALSE(table_.remove(2, number));
  EXPECT_TRUE(table_.remove(1, number));
  EXPECT_FALSE(table_.remove(1, number));
}

TEST_F(OpenTableTest, ForgetsAllOfAClientThatLeft) {
  const auto a = stream("a");
  table_.add({client(1), a, Role::writer, 0});
  table_.add({client(1), a, Role::reader, 0});
  table_.add({client(2), a, Role::reader, 0});
  table_.remove_all(1);
  EXPECT_EQ(table_.entries().size(), 1u);
  EXPECT_EQ(table_.counts(*a).writers, 0u);
  EXPECT_EQ(table_.counts(*a).readers, 1u);
  table_.remove_all(1);
  EXPECT_EQ(table_.entries().size(), 1u);
}

TEST_F(OpenTableTest, NamesTheLimitThatIsReached) {
  const auto a = stream("a");
  table_.add({client(1), a, Role::reader, 0});
  table_.add({client(1), a, Role::reader, 0});
  EXPECT_NE(table_.check_quota(*client(1)).error().message.find("max_opens_per_client = 2"),
            std::string::npos);
  EXPECT_TRUE(table_.check_quota(*client(2)));
  table_.add({client(2), a, Role::reader, 0});
  EXPECT_NE(table_.check_quota(*client(2)).error().message.find("max_opens = 3"),
            std::string::npos);
}

}  // namespace
}  // namespace dssm::daemon
