// SPDX-License-Identifier: Apache-2.0
//
// Descriptors that come as a program may send them, and no function of the project does.
#pragma once

#include <sys/socket.h>

#include <cstring>
#include <string>
#include <vector>

namespace dssm::test {

// Sends `bytes` with any number of descriptors.
//   returns  whether all bytes were sent
inline bool send_descriptors(int socket, std::string bytes, const std::vector<int>& descriptors,
                             int flags = 0) {
  const std::size_t length = descriptors.size() * sizeof(int);
  std::vector<char> control(CMSG_SPACE(length));
  iovec part{bytes.data(), bytes.size()};
  msghdr message{};
  message.msg_iov = &part;
  message.msg_iovlen = 1;
  message.msg_control = control.data();
  message.msg_controllen = control.size();
  cmsghdr* header = CMSG_FIRSTHDR(&message);
  header->cmsg_level = SOL_SOCKET;
  header->cmsg_type = SCM_RIGHTS;
  header->cmsg_len = CMSG_LEN(length);
  std::memcpy(CMSG_DATA(header), descriptors.data(), length);
  return ::sendmsg(socket, &message, MSG_NOSIGNAL | flags) == static_cast<ssize_t>(bytes.size());
}

}  // namespace dssm::test
