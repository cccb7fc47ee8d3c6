// SPDX-License-Identifier: Apache-2.0
//
// Sockets on the loopback interface, on ports that the kernel picks.
#include "core/wire/tcp.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <netinet/tcp.h>
#include <poll.h>
#include <sys/socket.h>

#include <cstring>
#include <dssm/time.hpp>
#include <thread>

#include "tests/support/signals.hpp"

namespace dssm::wire {
namespace {

SocketAddress number(const std::string& text) {
  return resolve_number(Address::parse(text, kDefaultPort, true).value()).at(0);
}

void await(int fd, short events) {
  pollfd poll_fd{fd, events, 0};
  ASSERT_EQ(::poll(&poll_fd, 1, -1), 1);
}

iovec part_of(const std::string& text) { return {const_cast<char*>(text.data()), text.size()}; }

// Two connected transports.
struct Pair {
  std::unique_ptr<Transport> client, server;
};

Pair connect_pair(const std::string& at = "127.0.0.1:0") {
  const UniqueFd listener = listen_tcp(number(at)).value();
  const SocketAddress address = local_address(listener.get()).value();
  UniqueFd client = start_connect(address).value();
  await(client.get(), POLLOUT);
  EXPECT_TRUE(finish_connect(client.get(), address));
  await(listener.get(), POLLIN);
  UniqueFd server(::accept4(listener.get(), nullptr, nullptr, SOCK_CLOEXEC | SOCK_NONBLOCK));
  EXPECT_TRUE(server);
  EXPECT_EQ(peer_address(client.get())->str(), address.str());
  EXPECT_EQ(peer_address(server.get())->str(), local_address(client.get())->str());
  return {make_transport(std::move(client), TransportEnd::connected),
          make_transport(std::move(server), TransportEnd::accepted)};
}

int option(int socket, int level, int name) {
  int value = -1;
  socklen_t length = sizeof value;
  EXPECT_EQ(::getsockopt(socket, level, name, &value, &length), 0);
  return value;
}

bool kernel_stamps_packets() {
  const UniqueFd socket(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  constexpr int kOn = 1;
  return ::setsockopt(socket.get(), SOL_SOCKET, SO_TIMESTAMPNS, &kOn, sizeof kOn) == 0;
}

class TcpTransport : public testing::TestWithParam<const char*> {};

TEST_P(TcpTransport, CarriesPartsInTheirOrder) {
  const Pair pair = connect_pair(GetParam());
  const std::string first = "first ", second = "second";
  const iovec parts[] = {part_of(first), part_of(second)};
  EXPECT_EQ(pair.client->send(parts)->bytes, 12u);
  std::string begin(7, '?'), rest(20, '?');
  const iovec spaces[] = {part_of(begin), part_of(rest)};
  await(pair.server->fd(), POLLIN);
  const IoResult received = pair.server->receive(spaces).value();
  EXPECT_EQ(received.status, IoStatus::ok);
  EXPECT_EQ(received.bytes, 12u);
  EXPECT_EQ(begin + rest.substr(0, 5), "first second");
}

TEST_P(TcpTransport, WaitsForBytesForAWhileAndThenNeverAgain) {
  const Pair pair = connect_pair(GetParam());
  std::string space(20, '?');
  const iovec spaces[] = {part_of(space)};
  const MonoTime begin = MonoClock::now();
  EXPECT_EQ(pair.server->receive_waiting(spaces)->status, IoStatus::would_block);
  // The kernel counts in ticks.
  EXPECT_GE(MonoClock::now() - begin, Transport::kReceiveWait - std::chrono::milliseconds(10));
  EXPECT_EQ(pair.server->receive(spaces)->status, IoStatus::would_block);
  const std::string text = "bytes";
  const iovec part[] = {part_of(text)};
  std::thread sending([&] { EXPECT_EQ(pair.client->send(part)->bytes, 5u); });
  IoResult received;
  do {
    received = pair.server->receive_waiting(spaces).value();
  } while (received.status == IoStatus::would_block);
  sending.join();
  EXPECT_EQ(received.bytes, 5u);
  EXPECT_EQ(space.substr(0, 5), "bytes");
}

TEST_P(TcpTransport, ReportsASignalThatEndsItsWait) {
  const Pair pair = connect_pair(GetParam());
  std::string space(20, '?');
  const iovec spaces[] = {part_of(space)};
  const test::Signals signals;
  IoStatus status{};
  do {  // the thread that sends signals may not get a turn within one wait
    status = pair.server->receive_waiting(spaces)->status;
  } while (status == IoStatus::would_block);
  EXPECT_EQ(status, IoStatus::interrupted);
}

TEST_P(TcpTransport, KnowsWhenBytesArrivedHoweverLateTheyAreReceived) {
  const Pair pair = connect_pair(GetParam());
  const std::string text = "bytes";
  const iovec part[] = {part_of(text)};
  std::string space(20, '?');
  const iovec spaces[] = {part_of(space)};
  const auto exchange = [&] {
    EXPECT_EQ(pair.client->send(part)->bytes, 5u);
    await(pair.server->fd(), POLLIN);
    const Time readable = WallClock::now();
    while (WallClock::now() < readable + std::chrono::milliseconds(2)) {
    }
    EXPECT_EQ(pair.server->receive(spaces)->bytes, 5u);
    return readable;
  };
  if (!kernel_stamps_packets()) GTEST_SKIP() << "no SO_TIMESTAMPNS here (qemu-user has none)";
  exchange();
  EXPECT_FALSE(pair.server->arrived());
  pair.server->stamp_arrivals();
  Time sent, readable;
  const MonoTime limit = MonoClock::now() + std::chrono::seconds(30);
  do {  // the kernel begins to stamp packets some moments after it was asked to
    sent = WallClock::now();
    readable = exchange();
  } while (!pair.server->arrived() && MonoClock::now() < limit);
  ASSERT_TRUE(pair.server->arrived());
  EXPECT_GE(*pair.server->arrived(), sent);
  EXPECT_LE(*pair.server->arrived(), readable);
}

TEST_P(TcpTransport, SetsThePriorityOfItsPackets) {
  const Pair pair = connect_pair(GetParam());
  const int socket = pair.client->fd();
  const bool is_ipv6 = GetParam()[0] == '[';
  const auto expect = [&](Priority priority, int dscp, int queue) {
    pair.client->set_priority(priority);
    EXPECT_EQ(
        is_ipv6 ? option(socket, IPPROTO_IPV6, IPV6_TCLASS) : option(socket, IPPROTO_IP, IP_TOS),
        dscp << 2);
    EXPECT_EQ(option(socket, SOL_SOCKET, SO_PRIORITY), queue);
  };
  expect(Priority::high, 32, 6);
  expect(Priority::low, 8, 2);
  expect(Priority::normal, 0, 0);
}

INSTANTIATE_TEST_SUITE_P(BothKinds, TcpTransport, testing::Values("127.0.0.1:0", "[::1]:0"));

TEST(Tcp, NeverWaits) {
  const Pair pair = connect_pair();
  std::string bytes(1 << 20, 'x');
  const iovec part[] = {part_of(bytes)};
  EXPECT_EQ(pair.server->receive(part)->status, IoStatus::would_block);
  for (;;) {  // until the kernel takes no more
    const IoResult sent = pair.client->send(part).value();
    if (sent.status == IoStatus::would_block) break;
    ASSERT_EQ(sent.status, IoStatus::ok);
    EXPECT_GT(sent.bytes, 0u);
  }
}

TEST(Tcp, ReportsThatThePeerClosed) {
  Pair pair = connect_pair();
  std::string bytes(10, 'x');
  const iovec part[] = {part_of(bytes)};
  EXPECT_EQ(pair.client->send(part)->status, IoStatus::ok);
  pair.client.reset();
  await(pair.server->fd(), POLLIN);
  EXPECT_EQ(pair.server->receive(part)->bytes, 10u);
  EXPECT_EQ(pair.server->receive(part)->status, IoStatus::end);
}

TEST(Tcp, SurvivesSendingToAPeerThatIsGone) {
  Pair pair = connect_pair();
  std::string bytes(10, 'x');
  const iovec part[] = {part_of(bytes)};
  EXPECT_EQ(pair.server->send(part)->status, IoStatus::ok);
  pair.client.reset();  // with bytes that it did not read: the kernel answers with a reset
  await(pair.server->fd(), POLLIN);
  IoResult sent;
  do {
    sent = pair.server->send(part).value();
  } while (sent.status == IoStatus::ok);
  EXPECT_EQ(sent.status, IoStatus::end);
  EXPECT_EQ(pair.server->send(part)->status, IoStatus::end);  // no SIGPIPE either
  EXPECT_EQ(pair.server->receive(part)->status, IoStatus::end);
}

TEST(Tcp, SetsTheOptionsOfChannels) {
  const Pair pair = connect_pair();
  for (const int fd : {pair.client->fd(), pair.server->fd()}) {
    EXPECT_EQ(option(fd, IPPROTO_TCP, TCP_NODELAY), 1);
    EXPECT_EQ(option(fd, SOL_SOCKET, SO_KEEPALIVE), 1);
    EXPECT_EQ(option(fd, IPPROTO_TCP, TCP_KEEPIDLE), 1);
    EXPECT_EQ(option(fd, IPPROTO_TCP, TCP_KEEPINTVL), 1);
    EXPECT_EQ(option(fd, IPPROTO_TCP, TCP_KEEPCNT), 2);
    EXPECT_TRUE(::fcntl(fd, F_GETFD) & FD_CLOEXEC);
    EXPECT_TRUE(::fcntl(fd, F_GETFL) & O_NONBLOCK);
  }
  EXPECT_EQ(option(pair.client->fd(), IPPROTO_TCP, TCP_USER_TIMEOUT), 3000);
  EXPECT_EQ(option(pair.server->fd(), IPPROTO_TCP, TCP_USER_TIMEOUT), 30'000);
}

TEST(ListenTcp, TakesBothKindsOfAnyAddressSideBySide) {
  const UniqueFd ipv4 = listen_tcp(number("0.0.0.0:0")).value();
  sockaddr_in bound{};
  const SocketAddress address = local_address(ipv4.get()).value();
  std::memcpy(&bound, &address.storage, sizeof bound);
  const auto ipv6 = listen_tcp(number("[::]:" + std::to_string(ntohs(bound.sin_port))));
  EXPECT_TRUE(ipv6) << ipv6.error().message;
  EXPECT_TRUE(::fcntl(ipv4.get(), F_GETFD) & FD_CLOEXEC);
  EXPECT_TRUE(::fcntl(ipv4.get(), F_GETFL) & O_NONBLOCK);
}

// The end that closes first leaves the port in TIME_WAIT for a minute.
TEST(ListenTcp, TakesItsPortBackAtOnce) {
  Pair pair = connect_pair();
  const SocketAddress address = local_address(pair.server->fd()).value();
  pair.server.reset();
  await(pair.client->fd(), POLLIN);
  pair.client.reset();
  const auto again = listen_tcp(address);
  EXPECT_TRUE(again) << again.error().message;
}

TEST(ListenTcp, ReportsThatAPortIsTakenOrAnAddressNotHere) {
  const UniqueFd listener = listen_tcp(number("127.0.0.1:0")).value();
  const SocketAddress address = local_address(listener.get()).value();
  const auto second = listen_tcp(address);
  ASSERT_FALSE(second);
  EXPECT_EQ(second.error().code, Errc::conflict);
  EXPECT_NE(second.error().message.find("listen at '" + address.str() + "'"), std::string::npos);
  EXPECT_NE(second.error().message.find("ss -ltnp"), std::string::npos);
  const auto elsewhere = listen_tcp(number("192.0.2.1:0"));  // for documentation only, RFC 5737
  ASSERT_FALSE(elsewhere);
  EXPECT_NE(elsewhere.error().message.find("no such address"), std::string::npos);
}

TEST(Connect, ReportsThatNoProcessListens) {
  SocketAddress address;
  {  // a port that was free a moment ago
    const UniqueFd listener = listen_tcp(number("127.0.0.1:0")).value();
    address = local_address(listener.get()).value();
  }
  const auto socket = start_connect(address);
  ASSERT_TRUE(socket);
  await(socket->get(), POLLOUT);
  const auto finished = finish_connect(socket->get(), address);
  ASSERT_FALSE(finished);
  EXPECT_EQ(finished.error().code, Errc::no_daemon);
  EXPECT_NE(finished.error().message.find(address.str()), std::string::npos);
  EXPECT_NE(finished.error().message.find("is dssmd running there"), std::string::npos);
}

// The kernel connects a socket to itself when it asks for its own port. Happens when dssmd of this
// PC is away and its port is among those for outgoing connections.
TEST(Connect, IsNotFooledByItself) {
  const UniqueFd socket(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  const SocketAddress any = number("127.0.0.1:0");
  ASSERT_EQ(::bind(socket.get(), any.get(), any.length), 0);
  const SocketAddress address = local_address(socket.get()).value();
  ASSERT_EQ(::connect(socket.get(), address.get(), address.length), 0);
  const auto finished = finish_connect(socket.get(), address);
  ASSERT_FALSE(finished);
  EXPECT_EQ(finished.error().code, Errc::no_daemon);
}

}  // namespace
}  // namespace dssm::wire
