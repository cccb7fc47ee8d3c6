// SPDX-License-Identifier: Apache-2.0
//
// Who may reach dssmd, and what dssmd knows about who does.
#include <fcntl.h>
#include <grp.h>
#include <gtest/gtest.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include "core/wire/local_protocol.hpp"
#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {
namespace {

struct stat socket_file(const DaemonProcess& daemon) {
  struct stat file {};
  EXPECT_EQ(::stat(daemon.socket_path().c_str(), &file), 0);
  return file;
}

// How an attempt to connect ends for user nobody with the groups given; 0: it connects.
int connect_as_nobody(const std::string& path, const std::vector<gid_t>& groups) {
  const pid_t child = ::fork();
  if (child == 0) {
    become_nobody(groups);
    const Result<UniqueFd> connected = wire::connect_unix(path);
    ::_exit(connected ? 0 : 1 + static_cast<int>(connected.error().code));
  }
  return wait_for(child);
}

TEST(Socket, HasTheModeOfTheConfiguration) {
  EXPECT_EQ(socket_file(DaemonProcess()).st_mode & 0777, 0660u);
  EXPECT_EQ(socket_file(DaemonProcess({"--socket-mode", "0600"})).st_mode & 0777, 0600u);
}

TEST(Socket, LetsOnlyMembersOfItsGroupIn) {
  if (::geteuid() != 0) GTEST_SKIP() << "only root can become somebody else";
  const group* const adm = ::getgrnam("adm");  // a group that every Debian has
  if (!adm) GTEST_SKIP() << "this system has no group 'adm'";
  const gid_t number = adm->gr_gid;
  DaemonProcess daemon({"--socket-group", "adm"});
  EXPECT_EQ(socket_file(daemon).st_gid, number);
  EXPECT_EQ(connect_as_nobody(daemon.socket_path(), {}), 1 + static_cast<int>(Errc::no_permission));
  EXPECT_EQ(connect_as_nobody(daemon.socket_path(), {number}), 0);
}

TEST(Socket, ListsItsClients) {
  DaemonProcess daemon;
  RawClient client(daemon.socket_path(), true, "mapper");
  const local::Response list = client.ask(list_clients_request()).response;
  ASSERT_EQ(list.client_list().clients_size(), 1);
  EXPECT_EQ(list.client_list().clients(0).pid(), ::getpid());
  EXPECT_EQ(list.client_list().clients(0).uid(), ::getuid());
  EXPECT_EQ(list.client_list().clients(0).program(), "mapper");
}

TEST(Socket, GivesReadersARingThatCannotBeMadeWritable) {
  if (::geteuid() != 0)
    GTEST_SKIP() << "only root can hand a descriptor to somebody else's process";
  DaemonProcess daemon;
  RawClient client(daemon.socket_path());
  client.ask(create_request("odometry"));
  const Answer opened = client.ask(open_request("odometry"));
  ASSERT_EQ(opened.descriptors.size(), 3u);
  const int ring = opened.descriptors[0].get(), meta = opened.descriptors[2].get();
  const pid_t child = ::fork();  // another user who got the descriptors
  if (child == 0) {
    become_nobody({});
    for (const int fd : {ring, meta}) {
      if (::mmap(nullptr, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, fd, 0) != MAP_FAILED) {
        ::_exit(1);
      }
      const std::string path = "/proc/self/fd/" + std::to_string(fd);
      if (::open(path.c_str(), O_RDWR | O_CLOEXEC) >= 0) ::_exit(2);
      if (::fchmod(fd, 0666) == 0) ::_exit(3);
      if (::ftruncate(fd, 0) == 0) ::_exit(4);
    }
    ::_exit(0);
  }
  EXPECT_EQ(wait_for(child), 0);
}

}  // namespace
}  // namespace dssm::test
