// SPDX-License-Identifier: Apache-2.0
//
// Each kind of request on both sockets passes the rule that decides who may do what: a rule that
// forbids everything refuses all of them. Kinds are found by trying all field numbers, so that a
// new one is tested without being listed here.
#include "daemon/streams/action.hpp"

#include <gtest/gtest.h>

#include "core/wire/varint.hpp"
#include "tests/unit/daemon/local/fake_client.hpp"
#include "tests/unit/daemon/serve/server_rig.hpp"

namespace dssm::daemon {
namespace {

// A message whose field `number` is an empty message; its body is not set if there is no such
// field.
template <class Message>
Message with_field(std::uint64_t number) {
  std::byte bytes[10];
  std::byte* end = wire::write_varint(bytes, number << 3 | 2);
  end = wire::write_varint(end, 0);
  Message message;
  EXPECT_TRUE(message.ParseFromArray(bytes, static_cast<int>(end - bytes)));
  return message;
}

constexpr std::uint64_t kMaxField = 200;

// Allows everything, or nothing.
class Rule final : public Rights {
 public:
  Result<void> check(const Identity& identity, Action action,
                     const StreamId& stream) const override {
    last_identity = identity;
    last_action = action;
    last_stream = stream;
    return forbids ? Result<void>(Error{Errc::no_permission, "forbidden"}) : Result<void>();
  }

  bool forbids = false;
  mutable Identity last_identity;
  mutable Action last_action = Action::greet;
  mutable StreamId last_stream;
};

class ActionTest : public testing::Test {
 protected:
  Rule rule;

  // The number of kinds of requests that are refused, without Hello; each is put by `ask`.
  int refused(const std::function<net::Frame(const net::Frame&)>& ask) {
    int kinds = 0;
    for (std::uint64_t field = 2; field < kMaxField; ++field) {
      net::Frame frame = with_field<net::Frame>(field);
      if (frame.body_case() == net::Frame::BODY_NOT_SET || frame.has_hello()) continue;
      frame.set_serial(field);
      const bool is_request = action_of(frame).has_value();
      EXPECT_EQ(ask(frame).failure().code(), is_request ? "no_permission" : "protocol") << field;
      kinds += is_request;
    }
    return kinds;
  }
};

TEST_F(ActionTest, RefusesEachRequestOfALocalProgram) {
  Registry registry{"pc1", kLimits};
  OpenTable opens{{100, 100}};
  PlaybackClockOwner clock;
  LogRecorder logger;
  LocalService service(registry, opens, clock, rule, logger);
  FakeClient client(service, 5);
  client.greet();
  EXPECT_EQ(rule.last_action, Action::greet);
  EXPECT_EQ(rule.last_identity.str(), "'test' (pid 5, uid 1000)");
  rule.forbids = true;
  int kinds = 0;
  for (std::uint64_t field = 2; field < kMaxField; ++field) {
    const local::Request request = with_field<local::Request>(field);
    if (request.body_case() == local::Request::BODY_NOT_SET || request.has_hello()) continue;
    ++kinds;
    EXPECT_EQ(client.ask(request).failure().code(), "no_permission") << field;
  }
  EXPECT_EQ(kinds, 23) << "the requests of local.proto besides Hello";
  EXPECT_EQ(client.ask(open_request("odometry", true)).failure().message(), "forbidden");
  EXPECT_EQ(rule.last_action, Action::open_for_writing);
  EXPECT_EQ(rule.last_stream.name, "odometry");

  FakeClient late(service, 6);
  local::Request hello;
  hello.set_serial(1);
  hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
  EXPECT_FALSE(late.put(hello)) << "the connection must end";
  EXPECT_EQ(late.next().failure().code(), "no_permission");
}

TEST(Account, IsOneForAllAddressesOfThisPc) {
  for (const char* address :
       {"127.0.0.1:40000", "127.9.9.9:1", "[::ffff:127.0.0.3]:1", "[::1]:40000"}) {
    EXPECT_EQ(account_of(address, nullptr), "'127.0.0.1'") << address;
  }
  EXPECT_EQ(account_of("[fd00::1]:40000", nullptr), "'[fd00::1]'");
  EXPECT_NE(account_of("10.0.0.2:40000", nullptr), account_of("10.0.0.3:40000", nullptr));
}

TEST_F(ActionTest, RefusesEachRequestOfAnotherHost) {
  ServerRig rig({16, 8, 32U << 20}, nullptr, &rule);
  rig.create("odometry");
  MemoryPeer control, channel, late;
  rig.connect(control);
  EXPECT_EQ(rule.last_action, Action::greet);
  EXPECT_EQ(rule.last_identity.host, "pc2");
  EXPECT_EQ(rule.last_identity.address, "10.0.0.2:40000");
  EXPECT_EQ(rule.last_identity.program, "test");
  EXPECT_FALSE(rule.last_identity.is_local());
  rig.connect(channel);
  rig.open(channel, "odometry");
  rule.forbids = true;
  constexpr int kKinds = 18;  // the requests of network.proto besides Hello
  EXPECT_EQ(refused([&](const net::Frame& frame) { return rig.ask(control, frame); }), kKinds);
  EXPECT_EQ(refused([&](const net::Frame& frame) { return rig.ask(channel, frame); }), kKinds);
  EXPECT_EQ(rule.last_stream.str(), "odometry:0@pc1") << "the stream of the channel";

  rig.connect(late, false);
  late.put(hello_frame(greeting_of("pc2", "test")));
  rig.turns();
  EXPECT_TRUE(late.closed);
  const std::vector<net::Frame> items = late.take();
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].failure().code(), "no_permission");
}

}  // namespace
}  // namespace dssm::daemon
