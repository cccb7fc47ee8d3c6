// SPDX-License-Identifier: Apache-2.0
//
// Programs at the Unix socket that do not read, in simulated time.
#include "daemon/local/server.hpp"

#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <cstring>
#include <filesystem>

#include "core/wire/frame.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/unit/daemon/local/fake_client.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

class ServerTest : public testing::Test, protected LocalDaemon {
 protected:
  ServerTest() : LocalDaemon(false, {100, 100}) {}
  ~ServerTest() override { std::filesystem::remove_all(dir); }

  // A program that has asked for a long property.
  UniqueFd connect() {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, path.c_str(), sizeof address.sun_path - 1);
    UniqueFd program(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
    EXPECT_EQ(::connect(program.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address),
              0);
    local::Request hello, get;
    hello.set_serial(1);
    hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
    get.set_serial(2);
    get.mutable_get_property()->mutable_id()->set_name("map");
    const std::string bytes = wire::encode_frame(hello) + wire::encode_frame(get);
    EXPECT_EQ(::send(program.get(), bytes.data(), bytes.size(), 0), std::ssize(bytes));
    run_turns(loop, 20);
    return program;
  }
  static ssize_t read(const UniqueFd& program, std::size_t bytes) {
    std::vector<char> space(bytes);
    return ::recv(program.get(), space.data(), space.size(), MSG_DONTWAIT);
  }
  // Whether the connection has ended; takes all that was sent.
  static bool is_closed(const UniqueFd& program) {
    ssize_t got = 0;
    while ((got = read(program, 1 << 16)) > 0) {
    }
    return got == 0;
  }
  void pass(Duration time) {
    bool is_over = false;
    EventSource end = EventSource::timer(loop, [&] { is_over = true; });
    end.enable_in(time);
    run_until(loop, [&] { return is_over; });
  }

  const std::filesystem::path dir = test::make_temp_dir();
  const std::string path = dir / "dssmd.sock";
  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  Listener listener = Listener::open(path, std::nullopt, 0600).value();
  Server server{loop, listener, "pc1", {10, 10}, service, logger};
};

TEST_F(ServerTest, DisconnectsAProgramThatDoesNotRead) {
  registry.create({"map", 0, ""}, odometry_type(), kHistory, 1).value();
  ASSERT_TRUE(registry.set_property({"map", 0, ""}, std::string(1 << 20, 'p')));
  const UniqueFd silent = connect(), slow = connect(), quick = connect();
  ASSERT_FALSE(is_closed(quick));
  run_turns(loop, 20);
  ASSERT_FALSE(is_closed(quick));
  for (int i = 0; i < 9; ++i) {
    pass(kLocalOutputTimeout / 4);
    EXPECT_GT(read(slow, 100'000), 0);
    EXPECT_FALSE(is_closed(quick)) << "nothing waits for it";
  }
  EXPECT_TRUE(is_closed(silent));
  EXPECT_TRUE(logger.contains("a program has read nothing for 10 s of the "));
  pass(Duration(1));
  EXPECT_FALSE(is_closed(slow));
}

}  // namespace
}  // namespace dssm::daemon
