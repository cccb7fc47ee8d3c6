// SPDX-License-Identifier: Apache-2.0
#include "core/wire/local_protocol.hpp"

#include <sys/socket.h>
#include <sys/un.h>

#include <cerrno>
#include <cstring>

namespace dssm::wire {

Result<IoResult> send_some(int socket, std::span<const std::byte> bytes, std::span<const int> fds) {
  alignas(cmsghdr) std::byte control[CMSG_SPACE(sizeof(int) * kMaxFdsPerMessage)] = {};
  iovec part{const_cast<std::byte*>(bytes.data()), bytes.size()};
  msghdr message{};
  message.msg_iov = &part;
  message.msg_iovlen = 1;
  if (!fds.empty()) {
    message.msg_control = control;
    message.msg_controllen = CMSG_SPACE(fds.size_bytes());
    cmsghdr* header = CMSG_FIRSTHDR(&message);
    header->cmsg_level = SOL_SOCKET;
    header->cmsg_type = SCM_RIGHTS;
    header->cmsg_len = CMSG_LEN(fds.size_bytes());
    std::memcpy(CMSG_DATA(header), fds.data(), fds.size_bytes());
  }
  for (;;) {
    const ssize_t sent = ::sendmsg(socket, &message, MSG_NOSIGNAL);
    if (sent >= 0) return IoResult{IoStatus::ok, static_cast<std::size_t>(sent)};
    if (errno == EINTR) continue;
    if (errno == EAGAIN) return IoResult{IoStatus::would_block, 0};
    if (errno == EPIPE || errno == ECONNRESET) return IoResult{IoStatus::end, 0};
    return os_error("send to the local socket");
  }
}

Result<IoResult> recv_some(int socket, std::span<std::byte> space, std::vector<UniqueFd>& fds,
                           int flags) {
  alignas(cmsghdr) std::byte control[CMSG_SPACE(sizeof(int) * kMaxFdsPerMessage)];
  iovec part{space.data(), space.size()};
  msghdr message{};
  message.msg_iov = &part;
  message.msg_iovlen = 1;
  message.msg_control = control;
  message.msg_controllen = sizeof control;
  ssize_t received = 0;
  do {
    received = ::recvmsg(socket, &message, flags | MSG_CMSG_CLOEXEC);
  } while (received < 0 && errno == EINTR);
  if (received < 0) {
    if (errno == EAGAIN) return IoResult{IoStatus::would_block, 0};
    if (errno == ECONNRESET) return IoResult{IoStatus::end, 0};
    return os_error("receive from the local socket");
  }
  for (cmsghdr* header = CMSG_FIRSTHDR(&message); header; header = CMSG_NXTHDR(&message, header)) {
    if (header->cmsg_level != SOL_SOCKET || header->cmsg_type != SCM_RIGHTS) continue;
    const std::size_t count = (header->cmsg_len - CMSG_LEN(0)) / sizeof(int);
    for (std::size_t i = 0; i < count; ++i) {
      int fd = -1;
      std::memcpy(&fd, CMSG_DATA(header) + i * sizeof(int), sizeof fd);
      fds.emplace_back(fd);
    }
  }
  if (message.msg_flags & MSG_CTRUNC) {
    return Error{Errc::protocol,
                 "more descriptors came with one message than are taken, or this "
                 "process may not open as many (ulimit -n)"};
  }
  if (received == 0) return IoResult{IoStatus::end, 0};
  return IoResult{IoStatus::ok, static_cast<std::size_t>(received)};
}

Result<UniqueFd> connect_unix(const std::string& path) {
  const std::string what = "connect to '" + path + "'";
  sockaddr_un address{};
  if (path.size() >= sizeof address.sun_path) {
    return Error{Errc::invalid_argument, what +
                                             ": the path is longer than the 107 bytes that a "
                                             "socket's address takes; choose a shorter folder"};
  }
  UniqueFd fd(::socket(AF_UNIX, SOCK_STREAM | SOCK_CLOEXEC, 0));
  if (!fd) return os_error("create a Unix socket");
  address.sun_family = AF_UNIX;
  std::memcpy(address.sun_path, path.data(), path.size());
  int failed = 0;
  do {
    failed = ::connect(fd.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address);
  } while (failed && errno == EINTR);
  if (!failed) return fd;
  if (errno == ENOENT || errno == ECONNREFUSED || errno == ENOTDIR) {
    return Error{Errc::no_daemon, what +
                                      ": nothing listens there; start dssmd (systemctl start "
                                      "dssmd) or set $DSSM_SOCKET to its socket"};
  }
  if (errno == EACCES) {
    return Error{Errc::no_permission, what +
                                          ": this user may not; join the socket's group (see `ls "
                                          "-l " +
                                          path + "`) and log in again"};
  }
  return os_error(what);
}

}  // namespace dssm::wire
