// SPDX-License-Identifier: Apache-2.0
//
// Programs that break the rules: each is told why where that is possible, loses its connection, and
// nobody else notices.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <unistd.h>

#include <random>

#include "core/wire/local_protocol.hpp"
#include "tests/process/daemon/raw_client.hpp"
#include "tests/support/descriptors.hpp"

namespace dssm::test {
namespace {

class BadClient : public testing::Test {
 protected:
  // Every test ends with a good client that is still served, and a dssmd without leftovers.
  void TearDown() override {
    EXPECT_TRUE(good_.ask(list_request()).response.has_stream_list());
    EXPECT_TRUE(eventually([&] { return open_descriptors(daemon_.pid()) == descriptors_; }))
        << "dssmd keeps descriptors of a client that is gone";
  }

  // Reads until the end; gives the last failure.
  static std::string final_failure(RawClient& client) {
    std::string words;
    for (;;) {
      const Answer answer = client.receive();
      if (answer.ended) return words;
      if (answer.response.has_failure()) {
        EXPECT_EQ(answer.response.failure().code(), "protocol");
        words = answer.response.failure().message();
      }
    }
  }

  DaemonProcess daemon_{{"--log-level", "error"}};
  RawClient good_{daemon_.socket_path()};
  int descriptors_ = idle_descriptors(daemon_.pid());
};

TEST_F(BadClient, ThatSendsGarbageGetsAnError) {
  RawClient http(daemon_.socket_path(), false);
  http.send_bytes("\x05HELLO");
  EXPECT_NE(final_failure(http).find("not a request of DSSM's local protocol"), std::string::npos);
  RawClient endless(daemon_.socket_path(), false);
  endless.send_bytes(std::string(64, '\xff'));
  EXPECT_NE(final_failure(endless).find("not a varint-delimited frame"), std::string::npos);
}

TEST_F(BadClient, ThatSendsRandomBytesCostsOnlyItself) {
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (int round = 0; round < 300; ++round) {
    RawClient client(daemon_.socket_path(), round % 2 == 0);
    std::string bytes(1 + random() % 5000, '\0');
    for (char& c : bytes) c = static_cast<char>(random());
    client.send_bytes(bytes);
    ::shutdown(client.fd(), SHUT_WR);
    while (!client.receive().ended) {
    }
  }
}

TEST_F(BadClient, OfALaterVersionIsRefusedNamingBothVersions) {
  RawClient client(daemon_.socket_path(), false);
  local::Request hello;
  hello.mutable_hello()->set_protocol_version(1000);
  client.send(hello);
  const std::string words = final_failure(client);
  EXPECT_NE(words.find("version 1000"), std::string::npos) << words;
  EXPECT_NE(words.find("version 1;"), std::string::npos) << words;
}

TEST_F(BadClient, ThatAnnouncesAnEndlessFrameIsRefusedBeforeItSendsOne) {
  RawClient client(daemon_.socket_path());
  client.send_bytes(std::string("\xff\xff\xff\xff\x0f", 5));  // 2^32 - 1 bytes
  EXPECT_NE(final_failure(client).find("4294967295 bytes"), std::string::npos);
}

TEST_F(BadClient, ThatRequestsBeforeHelloGetsAnErrorThatNamesHello) {
  RawClient client(daemon_.socket_path(), false);
  client.send(list_request());
  EXPECT_NE(final_failure(client).find("Hello"), std::string::npos);
}

TEST_F(BadClient, ThatSendsAnUnknownRequestIsAnsweredAndStaysConnected) {
  RawClient client(daemon_.socket_path());
  EXPECT_EQ(client.ask({}).response.failure().code(), "protocol");
  EXPECT_TRUE(client.ask(list_request()).response.has_stream_list());
  client.close();
}

TEST_F(BadClient, ThatSendsTooManyDescriptorsAtOnceIsRefused) {
  RawClient client(daemon_.socket_path());
  const int null = ::open("/dev/null", O_RDWR | O_CLOEXEC);
  ASSERT_TRUE(send_descriptors(client.fd(), "\1", std::vector<int>(200, null)));
  EXPECT_NE(final_failure(client).find("descriptors"), std::string::npos);
  ::close(null);
}

TEST_F(BadClient, ThatKeepsSendingUnrequestedDescriptorsIsRefused) {
  RawClient client(daemon_.socket_path());
  const UniqueFd event(::eventfd(0, EFD_CLOEXEC));
  const std::vector<int> some(16, event.get());
  for (int i = 0; i < 5; ++i) client.send(list_request(), some);
  EXPECT_NE(final_failure(client).find("more than 64 descriptors"), std::string::npos);
}

TEST_F(BadClient, ThatDoesNotReadCostsOneAnswer) {
  local::Request set, get;
  set.mutable_set_property()->mutable_id()->set_name("large");
  set.mutable_set_property()->set_property(std::string(wire::kMaxPropertyBytes, 'p'));
  get.mutable_get_property()->mutable_id()->set_name("large");
  {
    RawClient owner(daemon_.socket_path());
    ASSERT_TRUE(owner.ask(create_request("large")).response.has_opened());
    ASSERT_TRUE(owner.ask(set).response.has_done());
  }
  RawClient silent(daemon_.socket_path());
  for (int i = 0; i < 12; ++i) silent.send(get);
  const auto waiting_bytes = [&] {
    local::Request request;
    request.mutable_get_daemon();
    const local::Response answer = good_.ask(request).response;
    for (const local::LimitUse& one : answer.daemon().limits()) {
      if (one.name() == "long messages") return one.used();
    }
    return std::uint64_t{0};
  };
  EXPECT_TRUE(eventually([&] { return waiting_bytes() > wire::kMaxPropertyBytes / 2; }));
  EXPECT_LT(waiting_bytes(), wire::kMaxPropertyBytes + (1U << 10));
  for (int i = 0; i < 12; ++i) {
    EXPECT_EQ(silent.receive().response.property().property().size(), wire::kMaxPropertyBytes);
  }
  local::Request remove;
  remove.mutable_remove()->mutable_id()->set_name("large");
  EXPECT_TRUE(good_.ask(remove).response.has_done());
}

TEST_F(BadClient, ThatRequestsWithoutPauseDoesNotDelayOthers) {
  RawClient busy(daemon_.socket_path());
  std::string many;
  local::Request list = list_request();
  for (std::uint64_t serial = 100; serial < 20'100; ++serial) {
    list.set_serial(serial);
    many += wire::encode_frame(list);
  }
  ::fcntl(busy.fd(), F_SETFL, O_NONBLOCK);
  static_cast<void>(wire::send_some(busy.fd(), std::as_bytes(std::span(many)), {}));
  for (int i = 0; i < 20; ++i) {
    EXPECT_TRUE(good_.ask(list_request()).response.has_stream_list());
  }
  busy.close();
}

TEST_F(BadClient, ThatStopsInTheMiddleOfAFrameIsNotMissed) {
  {
    RawClient client(daemon_.socket_path());
    local::Request request = create_request("half");
    request.set_serial(5);
    const std::string frame = wire::encode_frame(request);
    for (std::size_t part = 1; part < frame.size(); ++part) {
      RawClient other(daemon_.socket_path());
      other.send_bytes(std::string_view(frame).substr(0, part));
    }
    client.send_bytes(std::string_view(frame).substr(0, frame.size() / 2));
  }
  EXPECT_EQ(good_.ask(list_request()).response.stream_list().streams_size(), 0);
}

// stderr is a pipe that nobody reads: neither dssmd's own lines nor a library's may wait for it.
TEST(BadClients, DoNotStopADssmdWhoseLogIsNotRead) {
  const std::string dir = make_temp_dir(), path = dir + "/dssmd.sock";
  int ends[2];
  ASSERT_EQ(::pipe2(ends, O_CLOEXEC), 0);
  const pid_t pid = ::fork();
  ASSERT_GE(pid, 0);
  if (pid == 0) {
    ::dup2(ends[1], 2);
    const std::string program = built("daemon/dssmd");
    ::execl(program.c_str(), "dssmd", "--runtime-dir", dir.c_str(), "--name", "pc1", nullptr);
    ::_exit(127);
  }
  ASSERT_TRUE(eventually([&] { return wire::connect_unix(path).has_value(); }));
  for (int i = 0; i < 1000; ++i) {  // some 150 bytes of log each, a pipe holds 64 KiB
    RawClient client(path, false);
    client.send_bytes("\x05\x1a\x03\x2a\x01\xff");  // a Hello whose program is not UTF-8
    while (!client.receive().ended) {
    }
  }
  RawClient good(path);
  EXPECT_TRUE(good.ask(list_request()).response.has_stream_list());
  ::kill(pid, SIGTERM);
  EXPECT_EQ(wait_for(pid), 0);
  ::close(ends[0]);
  ::close(ends[1]);
  remove_tree(dir);
}

TEST(Limits, OnClientsIsNamedToTheOneThatIsTooMany) {
  DaemonProcess daemon({"--max-clients", "2", "--log-level", "error"});
  RawClient one(daemon.socket_path()), two(daemon.socket_path());
  {
    RawClient three(daemon.socket_path(), false);
    const Answer refused = three.receive();
    EXPECT_EQ(refused.response.failure().code(), "limit_exceeded");
    EXPECT_NE(refused.response.failure().message().find("max_clients = 2"), std::string::npos);
    EXPECT_TRUE(three.receive().ended);
  }
  two.close();
  EXPECT_TRUE(eventually(
      [&] { return one.ask(list_clients_request()).response.client_list().clients_size() == 1; }));
  RawClient again(daemon.socket_path());
  EXPECT_TRUE(again.ask(list_request()).response.has_stream_list());
}

TEST(Limits, OnStreamsMemoryOpensAndPropertiesNameTheirKeys) {
  DaemonProcess daemon({"--max-streams", "2", "--max-memory", "1 MiB", "--max-opens", "3",
                        "--max-opens-per-client", "2", "--max-property", "10"});
  RawClient client(daemon.socket_path()), other(daemon.socket_path());
  const auto refusal = [](RawClient& by, local::Request request) {
    const local::Response response = by.ask(std::move(request)).response;
    EXPECT_EQ(response.failure().code(), "limit_exceeded");
    return response.failure().message();
  };
  EXPECT_NE(refusal(client, create_request("x", 100'000)).find("max_memory = 1048576"),
            std::string::npos);
  EXPECT_TRUE(client.ask(create_request("a")).response.opened().created());
  local::Request property;
  property.mutable_set_property()->mutable_id()->set_name("a");
  property.mutable_set_property()->set_property("eleven byte");
  EXPECT_NE(refusal(client, property).find("max_property = 10"), std::string::npos);
  EXPECT_TRUE(client.ask(create_request("b")).response.opened().created());
  EXPECT_NE(refusal(client, open_request("a")).find("max_opens_per_client = 2"), std::string::npos);
  EXPECT_NE(refusal(other, create_request("c")).find("max_streams = 2"), std::string::npos);
  EXPECT_TRUE(other.ask(open_request("a")).response.has_opened());
  EXPECT_NE(refusal(other, open_request("a")).find("max_opens = 3"), std::string::npos);
}

TEST(Limits, OnDescriptorsRefuseProgramsWithoutASpinningDssmd) {
#if defined(__SANITIZE_ADDRESS__) || defined(__SANITIZE_THREAD__)
  GTEST_SKIP() << "the sanitizers' own checks need descriptors, too";
#endif
  // A dssmd with few descriptors, through the shell that sets its limit.
  const std::string dir = make_temp_dir();
  const pid_t pid = start({"/bin/sh", "-c",
                           "ulimit -n 24; exec " + built("daemon/dssmd") +
                               " --name pc1 --listen '' --mdns=false --chronyd 127.0.0.1:1" +
                               " --log-level error --runtime-dir " + dir});
  const std::string path = dir + "/dssmd.sock";
  ASSERT_TRUE(eventually([&] { return wire::connect_unix(path).has_value(); }));
  {
    std::vector<RawClient> clients;
    bool refused = false;
    for (int i = 0; i < 40 && !refused; ++i) {
      clients.emplace_back(path, false);
      local::Request hello;
      hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
      clients.back().send(hello);
      const Answer answer = clients.back().receive();
      refused = answer.ended || answer.response.has_failure();
      if (answer.response.has_failure()) {
        EXPECT_NE(answer.response.failure().message().find("LimitNOFILE"), std::string::npos);
      }
    }
    EXPECT_TRUE(refused);
    // Those who are in are served on, and a stream that needs descriptors is refused with a reason.
    EXPECT_TRUE(clients.front().ask(list_request()).response.has_stream_list());
    EXPECT_TRUE(clients.front().ask(create_request("a")).response.has_failure());
  }
  ::kill(pid, SIGTERM);
  EXPECT_EQ(wait_for(pid), 0);
  remove_tree(dir);
}

}  // namespace
}  // namespace dssm::test
