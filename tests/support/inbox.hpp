// SPDX-License-Identifier: Apache-2.0
//
// Receives dssmd's notifications to the service manager, in place of systemd's socket.
#pragma once

#include <gtest/gtest.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <cstring>
#include <string>

#include "core/base/unique_fd.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {

// A datagram socket; next() returns the received messages one by one.
class Inbox {
 public:
  Inbox() {
    const sockaddr_un at = address();
    EXPECT_EQ(::bind(fd_.get(), reinterpret_cast<const sockaddr*>(&at), sizeof at), 0);
  }
  Inbox(const Inbox&) = delete;
  Inbox& operator=(const Inbox&) = delete;
  ~Inbox() { remove_tree(dir_); }

  std::string path() const { return dir_ + "/socket"; }
  sockaddr_un address() const {
    sockaddr_un address{};
    address.sun_family = AF_UNIX;
    std::strncpy(address.sun_path, path().c_str(), sizeof address.sun_path - 1);
    return address;
  }
  std::string next() {  // empty: no message
    char text[8192];
    const ssize_t bytes = ::recv(fd_.get(), text, sizeof text, MSG_DONTWAIT);
    return bytes > 0 ? std::string(text, static_cast<std::size_t>(bytes)) : "";
  }

 private:
  std::string dir_ = make_temp_dir();
  UniqueFd fd_{::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC, 0)};
};

}  // namespace dssm::test
