// SPDX-License-Identifier: Apache-2.0
//
// dssmctl rights.
#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

TEST(CtlRights, AreEverybodysWithoutConfiguration) {
  const DaemonProcess daemon;
  const Finished shown = run({dssmctl_path(), "rights", "lidar"}, {daemon.environment()});
  EXPECT_EQ(shown.exit_status, 0) << shown.err;
  EXPECT_EQ(shown.out,
            "every program and host may do everything: dssmd's key 'rights' has no lines\n");
}

TEST(CtlRights, ShowTheLinesThatConcernAStream) {
  const DaemonProcess daemon({"--right", "group:0 create,property l*", "--right", "host:pc2 all *",
                              "--right", "everyone read camera"});
  const Finished shown = run({dssmctl_path(), "rights", "lidar"}, {daemon.environment()});
  EXPECT_EQ(shown.exit_status, 0) << shown.err;
  EXPECT_EQ(shown.out,
            "WHO       MAY                    LINE\n"
            "group:0   write,create,property  group:0 create,property l*\n"
            "host:pc2  all                    host:pc2 all *\n"
            "you may: all\n");
  const Finished document =
      run({dssmctl_path(), "rights", "camera", "--json"}, {daemon.environment()});
  const Json json = Json::parse(document.out);
  EXPECT_EQ(json["stream"], "camera:0");
  EXPECT_EQ(json["restricted"], true);
  EXPECT_EQ(json["own_verbs"], Json::parse(R"(["all"])"));
  ASSERT_EQ(json["rights"].size(), 2u);
  EXPECT_EQ(json["rights"][1]["who"], "everyone");
  EXPECT_EQ(json["rights"][1]["verbs"], Json::parse(R"(["read"])"));
  EXPECT_EQ(json["rights"][1]["line"], "everyone read camera");
}

}  // namespace
}  // namespace dssm::test
