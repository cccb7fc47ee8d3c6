// SPDX-License-Identifier: Apache-2.0
//
// What systemd hands over, sorted by what it is, whatever it is called.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <netinet/in.h>
#include <sys/mman.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <cstring>

#include "daemon/service/service_manager.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::daemon {
namespace {

class InheritedTest : public testing::Test {
 protected:
  ~InheritedTest() override { test::remove_tree(dir); }

  static UniqueFd network(int family, int type) {
    UniqueFd fd(::socket(family, type | SOCK_CLOEXEC, 0));
    if (type == SOCK_STREAM) {
      EXPECT_EQ(::listen(fd.get(), 1), 0);
    }
    return fd;
  }
  UniqueFd local(const std::string& name, int type = SOCK_STREAM) {
    UniqueFd fd(::socket(AF_UNIX, type | SOCK_CLOEXEC, 0));
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, (dir + name).c_str(), sizeof address.sun_path - 1);
    EXPECT_EQ(::bind(fd.get(), reinterpret_cast<sockaddr*>(&address), sizeof address), 0);
    EXPECT_EQ(::listen(fd.get(), 1), 0);
    return fd;
  }
  static Inherited sort_one(UniqueFd fd) {
    std::vector<NamedDescriptor> handed_over;
    handed_over.push_back({"any", std::move(fd)});
    return Inherited::sort(std::move(handed_over));
  }
  std::string dir = test::make_temp_dir();
};

TEST_F(InheritedTest, DistinguishesListeningSocketsByTheirKind) {
  EXPECT_EQ(sort_one(local("/a")).local.size(), 1u);
  EXPECT_EQ(sort_one(network(AF_INET, SOCK_STREAM)).network.size(), 1u);
  EXPECT_EQ(sort_one(network(AF_INET6, SOCK_STREAM)).network.size(), 1u);
}

TEST_F(InheritedTest, LeavesAllElseToOthers) {
  EXPECT_EQ(sort_one(UniqueFd(::memfd_create("ring", MFD_CLOEXEC))).others.size(), 1u);
  EXPECT_EQ(sort_one(network(AF_INET, SOCK_DGRAM)).others.size(), 1u);
  EXPECT_EQ(sort_one(local("/packets", SOCK_SEQPACKET)).others.size(), 1u);
  UniqueFd does_not_listen(::socket(AF_INET, SOCK_STREAM | SOCK_CLOEXEC, 0));
  EXPECT_EQ(sort_one(std::move(does_not_listen)).others.size(), 1u);
}

TEST_F(InheritedTest, NeverWaitsInAnAccept) {
  const Inherited inherited = sort_one(local("/a"));
  EXPECT_TRUE(::fcntl(inherited.local.at(0).fd.get(), F_GETFL) & O_NONBLOCK);
}

TEST_F(InheritedTest, TakesTheSocketAtThePathAndNoOther) {
  std::vector<NamedDescriptor> handed_over;
  handed_over.push_back({"any", local("/abc")});
  handed_over.push_back({"any", local("/ab")});
  const int wanted = handed_over[1].fd.get();
  Inherited inherited = Inherited::sort(std::move(handed_over));
  EXPECT_FALSE(inherited.take_local(dir + "/a"));
  EXPECT_EQ(inherited.take_local(dir + "/ab").get(), wanted);
  EXPECT_FALSE(inherited.take_local(dir + "/ab")) << "it was taken";
  EXPECT_EQ(inherited.local.size(), 1u);
}

}  // namespace
}  // namespace dssm::daemon
