// SPDX-License-Identifier: Apache-2.0
//
// What one user's programs may take of dssmd, with a real user: nobody.
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/stat.h>
#include <unistd.h>

#include <fstream>
#include <optional>

#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {
namespace {

class UserLimits : public testing::Test {
 protected:
  void SetUp() override {
    if (::geteuid() != 0) GTEST_SKIP() << "only root can become another user";
    configure("max_clients_per_user = 2");
    daemon_.emplace(
        std::vector<std::string>{"--config", path_, "--socket-mode", "0666", "--listen", ""});
    ASSERT_EQ(::chmod(daemon_->runtime_dir().c_str(), 0755), 0);
  }
  void TearDown() override {
    daemon_.reset();
    remove_tree(dir_);
  }

  void configure(const std::string& line) { std::ofstream(path_) << line << "\n"; }

  // Connects as nobody: what counts is the user at that moment.
  RawClient client_of_nobody(bool greet = true) {
    EXPECT_EQ(::seteuid(kNobody), 0);
    RawClient client(daemon_->socket_path(), greet);
    EXPECT_EQ(::seteuid(0), 0);
    return client;
  }
  RawClient client_of_root() { return RawClient(daemon_->socket_path()); }

  // The failure that it gets at once; empty: it gets an answer.
  std::string refusal() {
    RawClient client = client_of_nobody(false);
    local::Request hello;
    hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
    client.send(hello);
    return client.receive().response.failure().message();
  }

  // As GetDaemon shows it.
  local::LimitUse limit(const std::string& name) {
    local::Request request;
    request.mutable_get_daemon();
    const local::Response response = client_of_root().ask(request).response;
    for (const local::LimitUse& one : response.daemon().limits()) {
      if (one.name() == name) return one;
    }
    ADD_FAILURE() << "no limit is called " << name;
    return {};
  }

  std::string dir_ = make_temp_dir();
  std::string path_ = dir_ + "/dssmd.conf";
  std::optional<DaemonProcess> daemon_;
};

TEST_F(UserLimits, OnClientsAreNamedToOneUserAndDoNotConcernRoot) {
  RawClient one = client_of_nobody();
  {
    RawClient two = client_of_nobody();
    const std::string refused = refusal();
    EXPECT_NE(refused.find("max_clients_per_user = 2 programs of user 65534"), std::string::npos)
        << refused;
    std::vector<RawClient> others;
    for (int i = 0; i < 4; ++i) others.push_back(client_of_root());
    EXPECT_TRUE(others.back().ask(list_request()).response.has_stream_list());
    EXPECT_TRUE(eventually([&] { return limit("max_clients_per_user").used() == 2; }));
    // Two, four, and the one that asks.
    EXPECT_TRUE(eventually([&] { return limit("max_clients").used() == 7; }));
  }
  EXPECT_TRUE(eventually([&] { return refusal().empty(); })) << "a place of one that has ended";
}

TEST_F(UserLimits, OnClientsChangeAtAReload) {
  RawClient one = client_of_nobody(), two = client_of_nobody();
  EXPECT_NE(refusal(), "");
  configure("max_clients_per_user = 3");
  ASSERT_EQ(::kill(daemon_->pid(), SIGHUP), 0);
  EXPECT_TRUE(eventually([&] { return refusal().empty(); }));
}

// The share of each limit that one user may take.
TEST_F(UserLimits, LeaveStreamsMemoryAndOpensToOthers) {
  configure("max_streams = 4\nmax_opens = 8\nmax_memory = \"1 MiB\"\nmax_share = \"50%\"");
  ASSERT_EQ(::kill(daemon_->pid(), SIGHUP), 0);
  ASSERT_TRUE(eventually([&] { return limit("max_streams of one user or host").limit() == 2; }));
  const auto create = [](RawClient& client, const std::string& name, std::uint64_t payload_bytes) {
    local::Request request = create_request(name);
    request.mutable_create()->mutable_type()->set_payload_bytes(payload_bytes);
    request.mutable_create()->mutable_type()->clear_fields();
    return client.ask(request).response.failure().message();
  };
  RawClient nobody = client_of_nobody(), root = client_of_root();
  const auto contains = [](const std::string& text, const std::string& words) {
    return text.find(words) != std::string::npos;
  };
  EXPECT_TRUE(contains(create(nobody, "large", 50'000),
                       "are left of the 524288 that user 65534 may take of max_memory"));
  EXPECT_EQ(create(nobody, "a", 8), "");
  EXPECT_EQ(create(nobody, "b", 8), "");
  EXPECT_TRUE(contains(create(nobody, "c", 8), "user 65534 has 2 streams already"));
  for (int i = 0; i < 2; ++i) EXPECT_EQ(create(nobody, "a", 8), "") << "it exists";
  EXPECT_TRUE(contains(create(nobody, "a", 8), "programs of user 65534 have 4 streams open"));
  EXPECT_EQ(create(root, "c", 8), "");
  EXPECT_EQ(create(root, "large", 50'000), "");
}

TEST_F(UserLimits, OnLongRequestsLeaveMemoryForOthers) {
  if (kIsSanitized) GTEST_SKIP() << "the 10 s that a request may take are too short";
  configure("");
  ASSERT_EQ(::kill(daemon_->pid(), SIGHUP), 0);
  ASSERT_TRUE(eventually([&] { return limit("max_clients_per_user").limit() == 2048; }));
  ASSERT_TRUE(client_of_root().ask(create_request("map")).response.has_opened());
  // The longest request without its last byte takes 2 MiB: dssmd's buffer doubles.
  std::string unfinished("\x80\x80\x41", 3);
  static_assert(wire::kMaxLocalRequestBytes == 0x41U << 14);
  unfinished.resize(unfinished.size() + wire::kMaxLocalRequestBytes - 1, 'x');
  std::vector<RawClient> begun;
  for (int i = 0; i < 64; ++i) {
    begun.push_back(client_of_nobody());
    begun.back().send_bytes(unfinished);
  }
  EXPECT_TRUE(eventually([&] { return limit("long messages of one user").used() == 128U << 20; }));
  EXPECT_EQ(limit("long messages").used(), 128U << 20);
  RawClient next = client_of_nobody();
  next.send_bytes(unfinished);
  const Answer refused = next.receive();
  EXPECT_EQ(refused.response.failure().code(), "limit_exceeded");
  EXPECT_NE(refused.response.failure().message().find(
                "programs of user 65534 have begun, and answers that they have not received, take "
                "up to 134217728 bytes"),
            std::string::npos)
      << refused.response.failure().message();
  local::Request property;
  property.mutable_set_property()->mutable_id()->set_name("map");
  property.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
  EXPECT_TRUE(client_of_root().ask(property).response.has_done());
}

TEST_F(UserLimits, OnMemoryCountWhatIsNotReceived) {
  ASSERT_TRUE(client_of_root().ask(create_request("map")).response.has_opened());
  local::Request property;
  property.mutable_set_property()->mutable_id()->set_name("map");
  property.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
  ASSERT_TRUE(client_of_root().ask(property).response.has_done());
  property.mutable_get_property()->mutable_id()->set_name("map");
  {
    RawClient silent = client_of_nobody();
    silent.send(property);
    EXPECT_TRUE(eventually(
        [&] { return limit("long messages of one user").used() > wire::kMaxPropertyBytes / 2; }));
  }
  EXPECT_TRUE(eventually([&] { return limit("long messages of one user").used() == 0; }));
}

}  // namespace
}  // namespace dssm::test
