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
  EXPECT_FALSE(table_.remove_some(1, false, 100));
  EXPECT_EQ(table_.entries().size(), 1u);
  EXPECT_EQ(table_.counts(*a).writers, 0u);
  EXPECT_EQ(table_.counts(*a).readers, 1u);
  EXPECT_FALSE(table_.remove_some(1, false, 100));
  EXPECT_EQ(table_.entries().size(), 1u);
}

TEST_F(OpenTableTest, CountsProgramsThatCrashedOnceForEachStreamThatTheyWroteOrRead) {
  const auto a = stream("a"), b = stream("b"), c = stream("c");
  table_.set_limits({.max_opens = 9, .max_opens_per_client = 9});
  table_.add({client(1), a, Role::writer, 0});
  table_.add({client(1), a, Role::writer, 0});
  table_.add({client(1), b, Role::reader, 0});
  table_.add({client(1), b, Role::reader, 0});
  const OpenNumber closed = table_.add({client(1), c, Role::writer, 0});
  const OpenNumber closed_too = table_.add({client(1), c, Role::reader, 0});
  table_.add({client(2), a, Role::writer, 0});
  table_.add({client(2), b, Role::reader, 0});
  ASSERT_TRUE(table_.remove(1, closed));
  ASSERT_TRUE(table_.remove(1, closed_too));
  EXPECT_FALSE(table_.remove_some(1, true, 100));
  EXPECT_EQ(a->info().crashed_writers, 1u);
  EXPECT_EQ(a->info().last_crashed_writer, client(1)->program + " (pid 1001)");
  EXPECT_EQ(a->info().crashed_readers, 0u);
  EXPECT_EQ(b->info().crashed_writers, 0u);
  EXPECT_EQ(b->info().crashed_readers, 1u);
  EXPECT_EQ(b->info().last_crashed_reader, client(1)->program + " (pid 1001)");
  EXPECT_EQ(c->info().crashed_writers, 0u);
  EXPECT_EQ(c->info().crashed_readers, 0u);
  EXPECT_FALSE(table_.remove_some(2, false, 100));
  EXPECT_EQ(a->info().crashed_writers, 1u);
  EXPECT_EQ(b->info().crashed_readers, 1u);
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

TEST_F(OpenTableTest, LeavesOpensToOtherUsers) {
  table_.set_limits({.max_opens = 4, .max_opens_per_client = 4, .max_share = {50}});
  const auto of_user = [](ClientNumber number, std::uint32_t uid) {
    ClientIdentity identity = *client(number);
    identity.uid = uid;
    return std::make_shared<const ClientIdentity>(identity);
  };
  const auto a = stream("a");
  table_.add({of_user(1, 4711), a, Role::reader, 0});
  const OpenNumber second = table_.add({of_user(2, 4711), a, Role::reader, 0});
  EXPECT_EQ(table_.check_quota(*of_user(2, 4711)).error().message,
            "programs of user 4711 have 2 streams open; close some or raise the key max_share: "
            "they may open 50% of max_opens = 4");
  EXPECT_TRUE(table_.check_quota(*of_user(3, 4712)));
  table_.add({client(4), a, Role::reader, 0});
  EXPECT_TRUE(table_.check_quota(*client(4))) << "root";
  LimitUses limits;
  table_.add_limits(limits);
  EXPECT_EQ(limits.at(1).name, "max_opens of one user");
  EXPECT_EQ(limits.at(1).used, 2U);
  EXPECT_EQ(limits.at(1).limit, 2U);
  EXPECT_TRUE(table_.remove(2, second));
  EXPECT_TRUE(table_.check_quota(*of_user(2, 4711)));
}

}  // namespace
}  // namespace dssm::daemon
