// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/inherited.hpp"

#include <fcntl.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/un.h>

#include <cstddef>
#include <utility>

namespace dssm::daemon {
namespace {

int socket_option(int socket, int option) noexcept {
  int value = -1;
  socklen_t length = sizeof value;
  return ::getsockopt(socket, SOL_SOCKET, option, &value, &length) ? -1 : value;
}

}  // namespace

Inherited Inherited::sort(std::vector<NamedDescriptor> handed_over) {
  Inherited inherited;
  for (NamedDescriptor& one : handed_over) {
    const int fd = one.fd.get();
    const bool listens =
        socket_option(fd, SO_ACCEPTCONN) == 1 && socket_option(fd, SO_TYPE) == SOCK_STREAM;
    const int domain = listens ? socket_option(fd, SO_DOMAIN) : -1;
    const bool is_tcp =
        (domain == AF_INET || domain == AF_INET6) && socket_option(fd, SO_PROTOCOL) == IPPROTO_TCP;
    if (listens) ::fcntl(fd, F_SETFL, ::fcntl(fd, F_GETFL) | O_NONBLOCK);
    std::vector<NamedDescriptor>& place = domain == AF_UNIX ? inherited.local
                                          : is_tcp          ? inherited.network
                                                            : inherited.others;
    place.push_back(std::move(one));
  }
  return inherited;
}

UniqueFd Inherited::take_local(const std::string& path) {
  for (auto one = local.begin(); one != local.end(); ++one) {
    sockaddr_un address{};
    socklen_t length = sizeof address;
    if (::getsockname(one->fd.get(), reinterpret_cast<sockaddr*>(&address), &length)) continue;
    // The kernel gives the end mark along.
    if (length != offsetof(sockaddr_un, sun_path) + path.size() + 1) continue;
    if (path != address.sun_path) continue;
    UniqueFd fd = std::move(one->fd);
    local.erase(one);
    return fd;
  }
  return {};
}

}  // namespace dssm::daemon
