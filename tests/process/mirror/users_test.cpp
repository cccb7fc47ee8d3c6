// SPDX-License-Identifier: Apache-2.0
//
// Who reads and writes a stream from another host, as both hosts know it. pc1 does not know pc2 of
// itself (it has no peers): what it knows comes over the channels.
#include "tests/process/mirror/two_hosts.hpp"

namespace dssm::test {
namespace {

using Strings = std::vector<std::string>;

struct RemoteUsers : TwoHosts {
  // As another program of pc2.
  Session program_on_pc2(const std::string& name) {
    return Session::connect(
               {.socket_path = pc2.socket_path(), .program = name, .request_timeout = 60s})
        .value();
  }
  PConnectorOptions directly(const std::string& name) const {
    PConnectorOptions options;
    options.address = pc1.address();
    options.program = name;
    options.request_timeout = 60s;
    return options;
  }

  // "viewer on pc2 reads via mirror", without the test's own opens on pc1.
  static Strings users(Session& session) {
    Strings texts;
    const auto info = session.stream_info({"climate", 0, "pc1"});
    if (!info) return {info.error().message};
    for (const StreamUser& user : info->users) {
      if (user.via == StreamVia::local) continue;
      EXPECT_EQ(user.pid, ::getpid());
      EXPECT_EQ(user.uid,
                user.via == StreamVia::connection ? std::nullopt : std::optional(::getuid()));
      texts.push_back(text(user.program, user.host, user.role, user.via));
    }
    return texts;
  }
  // The same by list_nodes().
  static Strings nodes(Session& session) {
    Strings texts;
    for (const NodeInfo& node : session.list_nodes().value()) {
      if (!node.error.empty()) return {node.error};  // not in time
      EXPECT_EQ(node.pid, ::getpid());
      for (const NodeStream& use : node.streams) {
        EXPECT_EQ(use.stream, (StreamId{"climate", 0, "pc1"}));
        if (use.via != StreamVia::local) {
          texts.push_back(text(node.program, node.host, use.role, use.via));
        }
      }
    }
    return texts;
  }
  static std::string text(const std::string& program, const std::string& host, Role role,
                          StreamVia via) {
    return program + " on " + host + (role == Role::writer ? " writes via " : " reads via ") +
           std::string(name_of(via));
  }
  // Until both hosts show just these.
  void await_users(const Strings& expected) {
    for (Session* session : {&here, &there}) {
      await([&] { return users(*session) == expected; });
      await([&] { return nodes(*session) == expected; });
      const auto writes = static_cast<std::size_t>(std::ranges::count_if(
          expected, [](const auto& one) { return one.find(" writes ") != std::string::npos; }));
      const std::size_t reads = expected.size() - writes;
      await([&] {  // the owner may not answer in time
        const auto listed = session->list_streams().value();
        return listed.size() == 1 && listed[0].remote_writers == writes &&
               listed[0].remote_readers == reads &&
               listed[0].writers == writes + 1 &&  // and the test itself
               listed[0].readers == reads;
      });
    }
  }

  const Writer<Numbered> writer = here.create<Numbered>("climate", kLong).value();
  const std::string own_pc = [] {
    char name[256] = {};
    EXPECT_EQ(::gethostname(name, sizeof name - 1), 0);
    return std::string(name);
  }();
};

TEST_F(RemoteUsers, ReadersByAMirrorAreNamedOnBothHostsUntilTheyEnd) {
  await_users({});
  {
    Session viewer = program_on_pc2("viewer"), mapper = program_on_pc2("mapper");
    std::optional reader = open_filled<Numbered>(viewer, "climate@pc1");
    await_users({"viewer on pc2 reads via mirror"});
    {
      const auto second = mapper.open_reader<Numbered>("climate@pc1").value();
      await([&] { return users(here).size() == 2; });
      EXPECT_EQ(users(here).at(1), "mapper on pc2 reads via mirror");
    }
    await_users({"viewer on pc2 reads via mirror"});
    reader.reset();
    await_users({});
    EXPECT_EQ(channels("climate"), 1u) << "the mirror lingers, which is not a reader";
  }
}

TEST_F(RemoteUsers, AreKnownAgainAfterARestartOfTheOwnersDaemon) {
  Session viewer = program_on_pc2("viewer");
  const auto reader = open_filled<Numbered>(viewer, "climate@pc1");
  await_users({"viewer on pc2 reads via mirror"});
  pc1.kill_hard();
  pc1.start();
  await_users({"viewer on pc2 reads via mirror"});
}

TEST_F(RemoteUsers, WritersAreNamedOnBothHostsUntilTheyEnd) {
  Session driver = program_on_pc2("driver");
  {
    auto remote = driver.open_writer<Numbered>("climate@pc1").value();
    remote.write(numbered(0));
    await_users({"driver on pc2 writes via remote writer"});
  }
  await_users({});
}

TEST_F(RemoteUsers, ProgramsThatConnectThemselvesAreNamedOnBothHostsUntilTheyEnd) {
  {
    auto con = PConnector::open({"climate", 0, {}}, directly("planner")).value();
    await_users({"planner on " + own_pc + " reads via connection"});
    const Numbered sample = numbered(0);
    ASSERT_TRUE(con.write(std::as_bytes(std::span(&sample, 1))));
    await_users({"planner on " + own_pc + " writes via connection"});
  }
  await_users({});
}

}  // namespace
}  // namespace dssm::test
