// SPDX-License-Identifier: Apache-2.0
#include "client/src/network_connection.hpp"

#include <gtest/gtest.h>
#include <poll.h>
#include <sys/socket.h>

#include <thread>

#include "core/wire/frame.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::detail {
namespace {

using namespace std::chrono_literals;

class NoUser final : public wire::FrameDelegate {
  Result<void> on_sample_begin(const wire::IncomingSample&, std::byte*&) override { return {}; }
  Result<void> on_sample_end(const wire::IncomingSample&, bool) override { return {}; }
  Result<void> on_frame(net::Frame&) override { return {}; }
};

// A link that has said who it is to a dssmd that has not answered yet.
struct NetworkConnectionTest : testing::Test {
  NetworkConnectionTest() {
    const wire::Address any = wire::Address::parse("127.0.0.1:0", 0, true).value();
    listener = wire::listen_tcp(wire::resolve_number(any).at(0)).value();
    const std::vector<wire::SocketAddress> addresses{wire::local_address(listener.get()).value()};
    EXPECT_TRUE(link.start(addresses));
    while (link.events(false) != POLLIN) {
      EXPECT_TRUE(link.advance());
      pollfd ready{link.fd(), link.events(false), 0};
      if (ready.events == POLLOUT) ::poll(&ready, 1, -1);
    }
    connection.reset(::accept(listener.get(), nullptr, nullptr));
  }

  void greet() {
    wire::Greeting self;
    self.host = "pc1";
    self.host_id = wire::host_id_for("pc1");
    self.instance_id = 1;
    net::Frame frame;
    wire::to_message(self, *frame.mutable_hello());
    const std::string bytes = wire::encode_frame(frame);
    ASSERT_EQ(::send(connection.get(), bytes.data(), bytes.size(), 0),
              static_cast<ssize_t>(bytes.size()));
  }

  NoUser delegate;
  NetworkConnection link{delegate, "test", 20ms, {}};
  UniqueFd listener, connection;
};

TEST_F(NetworkConnectionTest, TakesAGreetingThatCameWhileThisProgramWasStalled) {
  greet();
  std::this_thread::sleep_until(link.next_step());
  ASSERT_TRUE(link.advance());
  ASSERT_EQ(link.receive().value(), wire::IoStatus::ok);
  EXPECT_TRUE(link.is_up());
}

TEST_F(NetworkConnectionTest, GivesUpOneThatDoesNotGreet) {
  std::this_thread::sleep_until(link.next_step());
  const Result<void> advanced = link.advance();
  ASSERT_FALSE(advanced);
  EXPECT_EQ(advanced.error().code, Errc::unavailable);
  EXPECT_NE(advanced.error().message.find(link.address() + "' does not greet"), std::string::npos)
      << advanced.error().message;
  EXPECT_TRUE(link.is_down());
}

}  // namespace
}  // namespace dssm::detail
