// SPDX-License-Identifier: Apache-2.0
//
// Sockets that systemd passes to dssmd: programs and hosts that connect while no dssmd runs wait.
#include <arpa/inet.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <csignal>
#include <cstring>
#include <dssm/dssm.hpp>
#include <future>

#include "tests/process/fleet/fleet_tools.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/service_manager.hpp"
#include "tests/support/session.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// A listening socket of 127.0.0.1, or of [::], which also accepts IPv4, like systemd's.
struct ListeningSocket {
  UniqueFd fd;
  int port = 0;
};
ListeningSocket listen_here(int family = AF_INET) {
  ListeningSocket made{UniqueFd(::socket(family, SOCK_STREAM | SOCK_CLOEXEC, 0))};
  sockaddr_storage address{};
  socklen_t length = sizeof address;
  if (family == AF_INET) {
    auto* four = reinterpret_cast<sockaddr_in*>(&address);
    four->sin_family = AF_INET;
    four->sin_addr.s_addr = htonl(INADDR_LOOPBACK);
    length = sizeof *four;
  } else {
    auto* six = reinterpret_cast<sockaddr_in6*>(&address);
    six->sin6_family = AF_INET6;
    length = sizeof *six;
  }
  EXPECT_EQ(::bind(made.fd.get(), reinterpret_cast<sockaddr*>(&address), length), 0);
  EXPECT_EQ(::listen(made.fd.get(), 16), 0);
  EXPECT_EQ(::getsockname(made.fd.get(), reinterpret_cast<sockaddr*>(&address), &length), 0);
  made.port = ntohs(family == AF_INET ? reinterpret_cast<sockaddr_in*>(&address)->sin_port
                                      : reinterpret_cast<sockaddr_in6*>(&address)->sin6_port);
  return made;
}

bool exists(const std::string& path) {
  struct stat file {};
  return ::lstat(path.c_str(), &file) == 0;
}

// Waits until `pc2` is connected to pc1.
void await_pc1(const DaemonProcess& pc2) {
  Session session = connect(pc2);
  await_up(session, "pc1");
}

TEST(Sockets, LetProgramsWaitWhileNoDaemonRuns) {
  ServiceManager manager;
  ASSERT_EQ(manager.stop(), 0);
  EXPECT_TRUE(exists(manager.socket_path())) << "dssmd removed a socket that it does not own";
  auto created = std::async(std::launch::async, [&] {
    Session session = connect_to(manager.socket_path());
    return session.create<int>("early", kShort).has_value();
  });
  // Its connection is in the queue of the socket now or later; both must work.
  manager.start();
  EXPECT_TRUE(created.get());
  manager.kill_hard();
  EXPECT_TRUE(exists(manager.socket_path()));
}

TEST(Sockets, LetOtherHostsWaitWhileDaemonRestarts) {
  ServiceManager manager;
  Session session = connect_to(manager.socket_path());
  auto writer = session.create<int>("s", kShort).value();
  const std::string address = manager.address();
  const auto port = static_cast<std::uint16_t>(std::stoi(address.substr(address.rfind(':') + 1)));
  manager.kill_hard();
  // The kernel completes the connection while no program accepts it.
  UniqueFd early(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(port);
  to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  ASSERT_EQ(::connect(early.get(), reinterpret_cast<sockaddr*>(&to), sizeof to), 0);
  manager.start();
  // A client that sends nothing is closed without an error; a new socket would cause a reset.
  ASSERT_EQ(::shutdown(early.get(), SHUT_WR), 0);
  char bytes[4096];
  ssize_t got = 0;
  while ((got = ::recv(early.get(), bytes, sizeof bytes, 0)) > 0) continue;
  EXPECT_EQ(got, 0) << std::strerror(errno);
}

TEST(Sockets, UsesTheTcpSocketOfASocketUnit) {
  const ListeningSocket socket = listen_here();
  const std::string address = "127.0.0.1:" + std::to_string(socket.port);
  ServiceManager manager({.arguments = {"--listen", address}, .more_sockets = {socket.fd.get()}});
  EXPECT_EQ(manager.address(), address);
  EXPECT_EQ(manager.stored_descriptors(), 0u) << "the socket unit has it already";
  DaemonProcess pc2({"--peer", address}, "pc2");
  await_pc1(pc2);
}

// ListenStream=13776 creates an IPv6 socket that also accepts IPv4.
TEST(Sockets, UsesOneSocketForBothKindsOfAddresses) {
  const ListeningSocket socket = listen_here(AF_INET6);
  const std::string port = std::to_string(socket.port);
  ServiceManager manager(
      {.arguments = {"--listen", "0.0.0.0:" + port, "--listen", "[::]:" + port, "--insecure"},
       .more_sockets = {socket.fd.get()}});
  EXPECT_EQ(manager.address(), "[::]:" + port);
  for (const std::string host : {"127.0.0.1", "[::1]"}) {
    DaemonProcess pc2({"--peer", host + ":" + port}, "pc2");
    await_pc1(pc2);
  }
}

TEST(Sockets, ClosesSocketsThatTheConfigurationDoesNotName) {
  const ListeningSocket wanted = listen_here();
  const std::string address = "127.0.0.1:" + std::to_string(wanted.port);
  ListeningSocket other = listen_here();
  ServiceManager manager(
      {.arguments = {"--listen", address}, .more_sockets = {wanted.fd.get(), other.fd.get()}});
  manager.await_status("listening at " + address);
  // Closes the last descriptors of `other`; dssmd has closed its own.
  manager.forget_more_sockets();
  other.fd.reset();
  UniqueFd client(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  sockaddr_in to{};
  to.sin_family = AF_INET;
  to.sin_port = htons(static_cast<std::uint16_t>(other.port));
  to.sin_addr.s_addr = htonl(INADDR_LOOPBACK);
  EXPECT_EQ(::connect(client.get(), reinterpret_cast<sockaddr*>(&to), sizeof to), -1);
  EXPECT_EQ(errno, ECONNREFUSED);
}

// The service manager still holds the socket at 127.0.0.1, which conflicts with 0.0.0.0.
TEST(Sockets, ChangesTheAddressAndKeepsThePort) {
  ServiceManager manager;
  const std::string before = manager.address();
  const std::string port = before.substr(before.rfind(':'));
  for (const std::string& address : {"0.0.0.0" + port, before}) {
    manager.set_arguments({"--listen", address, "--insecure"});
    manager.restart();
    EXPECT_EQ(manager.address(), address);
  }
}

TEST(Sockets, GivesTheInheritedSocketTheConfiguredPermissions) {
  ServiceManager manager({.arguments = {"--listen", "", "--socket-mode", "0600"}});
  struct stat file {};
  ASSERT_EQ(::stat(manager.socket_path().c_str(), &file), 0);
  EXPECT_EQ(file.st_mode & 07777, 0600u);
}

TEST(Sockets, CreatesAndRemovesItsOwnWithoutASocketUnit) {
  ServiceManager manager({.arguments = {"--listen", ""}, .socket = false});
  EXPECT_TRUE(exists(manager.socket_path()));
  EXPECT_EQ(manager.stop(), 0);
  EXPECT_FALSE(exists(manager.socket_path()));
}

}  // namespace
}  // namespace dssm::test
