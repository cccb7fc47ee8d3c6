// SPDX-License-Identifier: Apache-2.0
//
// Programs at the Unix socket that do not read, in simulated time.
#include "daemon/local/server.hpp"

#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/eventfd.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <cerrno>
#include <cstring>
#include <filesystem>
#include <thread>

#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/descriptors.hpp"
#include "tests/unit/daemon/local/fake_client.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

class ServerTest : public testing::Test, protected LocalDaemon {
 protected:
  ServerTest() : LocalDaemon(false, {100, 100}) {}
  ~ServerTest() override { std::filesystem::remove_all(dir); }

  UniqueFd connect() const {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, path.c_str(), sizeof address.sun_path - 1);
    UniqueFd program(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
    EXPECT_EQ(::connect(program.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address),
              0);
    return program;
  }
  // A program that has sent Hello and `request`.
  UniqueFd connect(local::Request request) {
    UniqueFd program = connect();
    local::Request hello;
    hello.set_serial(1);
    hello.mutable_hello()->set_protocol_version(wire::kLocalProtocolVersion);
    request.set_serial(2);
    const std::string bytes = wire::encode_frame(hello) + wire::encode_frame(request);
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
    return got == 0 || errno == ECONNRESET;  // the latter where the server has not read all
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
  static constexpr std::uint64_t kMaxClients = 10;
  Server server{loop, listener, "pc1", {kMaxClients, kMaxClients}, service, logger};
};

TEST_F(ServerTest, DisconnectsAProgramThatDoesNotRead) {
  registry.create({"map", 0, ""}, odometry_type(), kHistory, 1).value();
  ASSERT_TRUE(registry.set_property({"map", 0, ""}, std::string(1 << 20, 'p')));
  local::Request get;
  get.mutable_get_property()->mutable_id()->set_name("map");
  const UniqueFd silent = connect(get), slow = connect(get), quick = connect(get);
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

TEST_F(ServerTest, LogsOnlySomeOfManyProgramsThatAreRefused) {
  const std::string garbage(16, '\xff');
  for (int i = 0; i < 200; ++i) {
    const UniqueFd program = connect();
    EXPECT_EQ(::send(program.get(), garbage.data(), garbage.size(), 0), std::ssize(garbage));
    run_turns(loop, 10);
    EXPECT_TRUE(is_closed(program));
  }
  EXPECT_GE(logger.warnings.size(), 10u);
  EXPECT_LE(logger.warnings.size(), std::size_t{2 * RateLimitedLogger::kLinesPerPeriod});
}

TEST_F(ServerTest, AnswersNothingToAProgramThatHasEnded) {
  registry.create({"map", 0, ""}, odometry_type(), kHistory, 1).value();
  ASSERT_TRUE(registry.set_property({"map", 0, ""}, std::string(1 << 20, 'p')));
  local::Request get, look;
  get.set_serial(2);
  get.mutable_get_property()->mutable_id()->set_name("map");
  look.set_serial(3);
  look.mutable_get_daemon();
  int looks = 0;
  service.set_facts_source([&] {
    ++looks;
    return DaemonFacts();
  });
  UniqueFd program = connect(get);
  std::string more;
  for (int i = 0; i < 100; ++i) more += wire::encode_frame(look);
  EXPECT_EQ(::send(program.get(), more.data(), more.size(), 0), std::ssize(more));
  run_turns(loop, 20);
  EXPECT_EQ(looks, 0) << "its requests wait until it reads";
  program.reset();
  run_turns(loop, 50);
  EXPECT_EQ(service.clients(), 0u);
  EXPECT_EQ(looks, 0);
}

TEST_F(ServerTest, EndsTheManyOpensOfAProgramAndThenItsPlaceIsFree) {
  constexpr std::size_t kOpens = 2 * LocalService::kOpensPerTurn + 1;
  opens.set_limits({kOpens, kOpens});
  ASSERT_TRUE(registry.create({"a", 0, ""}, odometry_type(), kHistory, 1));
  local::Request open = open_request("a");
  UniqueFd program = connect(open);
  for (std::uint64_t serial = 3; opens.entries().size() < kOpens && serial < 2 * kOpens; ++serial) {
    // What it does not read would pause it.
    run_until(loop, [&] { return read(program, 1 << 16) > 0; });
    open.set_serial(serial);
    const std::string bytes = wire::encode_frame(open);
    EXPECT_EQ(::send(program.get(), bytes.data(), bytes.size(), 0), std::ssize(bytes));
    run_turns(loop, 2);
  }
  ASSERT_EQ(opens.entries().size(), kOpens);
  program.reset();
  run_turns(loop, 20);
  EXPECT_TRUE(opens.entries().empty());
  LimitUses uses;
  server.add_limits(uses);
  EXPECT_EQ(uses.front().used, 0u) << uses.front().name;
}

TEST_F(ServerTest, TellsManyStreamsAsFastAsAProgramReads) {
  constexpr int kStreams = 300;
  TypeInfo type = odometry_type();
  for (int i = 0; i < 200; ++i)
    type.fields.push_back({"f" + std::to_string(i), Scalar::float64, 0, 1, 8});
  for (int i = 0; i < kStreams; ++i) {
    ASSERT_TRUE(registry.create({"s", i, ""}, type, kHistory, 1));
  }
  local::Request watch;
  watch.mutable_watch();
  const UniqueFd program = connect(watch);
  wire::FrameBuffer received(wire::kMaxLocalFrameBytes);
  int events = 0;
  bool is_done = false;
  const auto take_frames = [&] {
    while (const auto frame = received.next().value()) {
      local::Response response;
      ASSERT_TRUE(response.ParseFromArray(frame->data(), static_cast<int>(frame->size())));
      EXPECT_FALSE(is_done);
      events += response.has_stream_event();
      is_done = response.serial() == 2;
    }
  };
  run_turns(loop, 100);
  while (!is_done) {
    const std::span<std::byte> space = received.space();
    const ssize_t got = ::recv(program.get(), space.data(), space.size(), MSG_DONTWAIT);
    ASSERT_GT(got, 0) << "after " << events << " events";
    received.commit(static_cast<std::size_t>(got));
    take_frames();
    run_turns(loop, 20);
  }
  EXPECT_EQ(events, kStreams);
}

// Programs that send descriptors whose close() waits.
class ServerWithDescriptorsTest : public ServerTest {
 protected:
  static constexpr int kLingerSeconds = 30;

  // A TCP socket that lingers, and has more to send than is read at its other end.
  UniqueFd lingering_socket() {
    const UniqueFd place(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    sockaddr_in address{};
    address.sin_family = AF_INET;
    address.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    socklen_t length = sizeof address;
    auto* generic = reinterpret_cast<sockaddr*>(&address);
    EXPECT_EQ(::bind(place.get(), generic, length), 0);
    EXPECT_EQ(::getsockname(place.get(), generic, &length), 0);
    EXPECT_EQ(::listen(place.get(), 1), 0);
    UniqueFd socket(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
    EXPECT_EQ(::connect(socket.get(), generic, length), 0);
    ends.emplace_back(::accept4(place.get(), nullptr, nullptr, SOCK_CLOEXEC));
    const std::string much(1 << 20, 'x');
    while (::send(socket.get(), much.data(), much.size(), MSG_DONTWAIT) > 0) {
    }
    const linger long_one{1, kLingerSeconds};
    EXPECT_EQ(::setsockopt(socket.get(), SOL_SOCKET, SO_LINGER, &long_one, sizeof long_one), 0);
    return socket;
  }

  static void send(const UniqueFd& program, const std::string& bytes,
                   const std::vector<int>& descriptors, int flags = 0) {
    EXPECT_TRUE(test::send_descriptors(program.get(), bytes, descriptors, flags));
  }
  // The same of one that only the server has afterwards.
  void send_lingering(const UniqueFd& program, const std::string& bytes, int flags = 0) {
    const UniqueFd socket = lingering_socket();
    send(program, bytes, {socket.get()}, flags);
  }

  void serve_without_waiting() {
    const MonoTime begin = MonoClock::now();
    run_turns(loop, 20);
    EXPECT_LT(MonoClock::now() - begin, std::chrono::seconds(kLingerSeconds / 2))
        << "the loop has waited in close()";
  }
  std::uint64_t clients() const {
    LimitUses uses;
    server.add_limits(uses);
    EXPECT_EQ(uses.front().name, "max_clients");
    return uses.front().used;
  }

  std::vector<UniqueFd> ends;  // the other ones: when one is closed, close() waits no longer
};

TEST_F(ServerWithDescriptorsTest, DoesNotWaitToCloseThoseThatItReceives) {
  UniqueFd program = connect(list_request());
  send_lingering(program, "\1");
  program.reset();
  serve_without_waiting();
  EXPECT_EQ(service.clients(), 0U);
  EXPECT_TRUE(logger.contains("descriptors came that are neither memory files nor doorbells"));
}

TEST_F(ServerWithDescriptorsTest, DoesNotWaitToCloseThoseThatItDoesNotReceive) {
  const UniqueFd program = connect(list_request()), event(::eventfd(0, EFD_CLOEXEC));
  send(program, std::string(16, '\xff'), {event.get()});  // ends the connection
  send_lingering(program, "\1");
  serve_without_waiting();
  EXPECT_EQ(service.clients(), 0U);
  EXPECT_TRUE(is_closed(program));
}

TEST_F(ServerWithDescriptorsTest, DoesNotWaitToCloseThoseThatAreTooMany) {
  const UniqueFd program = connect(list_request()), event(::eventfd(0, EFD_CLOEXEC));
  {
    const UniqueFd socket = lingering_socket();
    std::vector<int> many(wire::kMaxFdsPerMessage, event.get());
    many.push_back(socket.get());
    send(program, "\1", many);
  }
  serve_without_waiting();
  EXPECT_TRUE(is_closed(program));
}

TEST_F(ServerWithDescriptorsTest, DoesNotWaitToCloseThoseThatComeOutOfBand) {
  const UniqueFd other = connect(list_request()), program = connect(list_request());
  if (::send(other.get(), "\1", 1, MSG_OOB) < 0) GTEST_SKIP() << "not in this kernel";
  send_lingering(program, "\1", MSG_OOB);
  EXPECT_EQ(::send(program.get(), "\1", 1, 0), 1);
  serve_without_waiting();
}

TEST_F(ServerWithDescriptorsTest, DoesNotWaitToCloseThoseOfAProgramThatItRefuses) {
  std::vector<UniqueFd> programs;
  for (std::uint64_t i = 0; i < kMaxClients; ++i) programs.push_back(connect(list_request()));
  const UniqueFd refused = connect();
  send_lingering(refused, "\1");
  serve_without_waiting();
  EXPECT_TRUE(is_closed(refused));
  EXPECT_TRUE(logger.contains("programs are connected already"));
}

TEST_F(ServerWithDescriptorsTest, CountsAClientUntilItsDescriptorsAreClosed) {
  for (std::uint64_t i = 0; i < kMaxClients; ++i) {
    send_lingering(connect(list_request()), "\1");
    serve_without_waiting();
  }
  EXPECT_EQ(service.clients(), 0U);
  EXPECT_EQ(clients(), kMaxClients);
  std::vector<UniqueFd> refused;
  for (std::uint64_t i = 0; i < kMaxClients; ++i) {
    refused.push_back(connect());
    send_lingering(refused.back(), "\1");
    serve_without_waiting();
    EXPECT_TRUE(is_closed(refused.back()));
  }
  const UniqueFd waiting = connect(list_request());
  EXPECT_FALSE(is_closed(waiting)) << "it is not accepted while the server has so many to close";
  EXPECT_EQ(clients(), 2 * kMaxClients);

  ends.clear();
  while (clients() > 0) std::this_thread::yield();  // accepted any sooner, it would be refused
  run_until(loop, [&] { return service.clients() == 1; });
  EXPECT_EQ(clients(), 1U);
}

}  // namespace
}  // namespace dssm::daemon
