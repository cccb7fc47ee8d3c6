// SPDX-License-Identifier: Apache-2.0
//
// TCP as DSSM uses it. A connection ends in one of two ways: the peer closed it or its process died
// (`end`, part of normal work), or the network failed (an error that says so).
#include "core/wire/tcp.hpp"

#include <fcntl.h>
#include <ifaddrs.h>
#include <linux/tcp.h>  // glibc's tcp_info has no rates
#include <netinet/in.h>
#include <sys/time.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstring>
#include <string>

namespace dssm::wire {
namespace {

constexpr int kProbeAfterSeconds = 1, kProbeEverySeconds = 1, kProbes = 2;
// The connection ends when probes or data were not answered for so long (tcp.hpp says why two).
constexpr int kUnansweredMs = 3000, kUntakenMs = 30'000;
constexpr int kBacklog = 128;  // connections that wait for accept(); more get no answer yet
constexpr std::size_t kMaxParts = 16;

void set_option(int socket, int level, int option, int value) noexcept {
  // Fails only when `socket` is none of that level, or not a socket, and then every other call on
  // it fails too.
  static_cast<void>(::setsockopt(socket, level, option, &value, sizeof value));
}

Result<UniqueFd> tcp_socket(const SocketAddress& address) {
  UniqueFd fd(::socket(address.storage.ss_family, SOCK_STREAM | SOCK_NONBLOCK | SOCK_CLOEXEC, 0));
  if (!fd) return os_error("create a TCP socket for '" + address.str() + "'");
  return fd;
}

int user_timeout_ms(int socket) noexcept {
  int value = 0;
  socklen_t length = sizeof value;
  ::getsockopt(socket, IPPROTO_TCP, TCP_USER_TIMEOUT, &value, &length);
  return value;
}

// The failure of `what`, with a hint at what to check.
Error network_error(const std::string& what, int errno_value, int socket) {
  switch (errno_value) {
    case ETIMEDOUT:
      return Error{Errc::unavailable, what + ": no answer from the other PC for " +
                                          std::to_string(user_timeout_ms(socket) / 1000) +
                                          " s; is it on, does the network between both work, "
                                          "and does the program there still read?"};
    case EHOSTUNREACH:
    case ENETUNREACH:
    case EHOSTDOWN:
    case ENETDOWN:
      return Error{Errc::unavailable, os_error(what, errno_value).message +
                                          "; is the other PC on, and does this one have a route "
                                          "to it (`ip route get`)?"};
    default:
      return os_error(what, errno_value);
  }
}

[[gnu::hot]] Result<IoResult> io_result(ssize_t bytes, const char* what, int socket) {
  if (bytes > 0) return IoResult{IoStatus::ok, static_cast<std::size_t>(bytes)};
  if (bytes == 0) return IoResult{IoStatus::end, 0};
  if (errno == EAGAIN) return IoResult{IoStatus::would_block, 0};
  if (errno == EPIPE || errno == ECONNRESET) return IoResult{IoStatus::end, 0};
  return network_error(what, errno, socket);
}

class TcpTransport final : public Transport {
 public:
  explicit TcpTransport(UniqueFd socket) noexcept : socket_(std::move(socket)) {}

  [[gnu::hot]] Result<IoResult> send(std::span<const iovec> parts) override {
    const int flags = MSG_NOSIGNAL | MSG_DONTWAIT;
    const msghdr message = header(parts);
    ssize_t bytes = 0;
    do {  // send() is cheaper than sendmsg(), and often there is one part only
      bytes = parts.size() == 1 ? ::send(socket_.get(), parts[0].iov_base, parts[0].iov_len, flags)
                                : ::sendmsg(socket_.get(), &message, flags);
    } while (bytes < 0 && errno == EINTR);
    return io_result(bytes, "send to the other side", socket_.get());
  }

  [[gnu::hot]] Result<IoResult> receive(std::span<const iovec> spaces) override {
    if (stamps_) return receive_stamped(spaces);
    msghdr message = header(spaces);
    ssize_t bytes = 0;
    do {
      bytes = spaces.size() == 1
                  ? ::recv(socket_.get(), spaces[0].iov_base, spaces[0].iov_len, MSG_DONTWAIT)
                  : ::recvmsg(socket_.get(), &message, MSG_DONTWAIT);
    } while (bytes < 0 && errno == EINTR);
    return io_result(bytes, "receive from the other side", socket_.get());
  }

  Result<IoResult> receive_waiting(std::span<const iovec> spaces) override {
    if (!waits_) make_waitable();
    msghdr message = header(spaces);
    const ssize_t bytes = ::recvmsg(socket_.get(), &message, 0);
    if (bytes < 0 && errno == EINTR) return IoResult{IoStatus::interrupted, 0};
    return io_result(bytes, "receive from the other side", socket_.get());
  }

  // SO_TIMESTAMPNS: of TCP the kernel gives the time of the last packet that a call received from.
  void stamp_arrivals() noexcept override {
    constexpr int kOn = 1;
    stamps_ = ::setsockopt(socket_.get(), SOL_SOCKET, SO_TIMESTAMPNS, &kOn, sizeof kOn) == 0;
  }
  std::optional<Time> arrived() const noexcept override { return arrived_; }

  void limit_unsent(std::size_t bytes) noexcept override {
    const auto most = static_cast<int>(bytes);
    static_cast<void>(
        ::setsockopt(socket_.get(), IPPROTO_TCP, TCP_NOTSENT_LOWAT, &most, sizeof most));
  }

  void set_priority(Priority priority) noexcept override {
    const auto is = [&](Priority one) { return priority == one; };
    // IPTOS_CLASS_CS4 and CS1, TC_PRIO_INTERACTIVE and BULK. The first sets the second, too.
    const int dscp = is(Priority::high) ? 0x80 : is(Priority::low) ? 0x20 : 0;
    const int queue = is(Priority::high) ? 6 : is(Priority::low) ? 2 : 0;
    // IPV6_TCLASS fails for a socket of IPv4.
    set_option(socket_.get(), IPPROTO_IP, IP_TOS, dscp);
    set_option(socket_.get(), IPPROTO_IPV6, IPV6_TCLASS, dscp);
    set_option(socket_.get(), SOL_SOCKET, SO_PRIORITY, queue);
  }

  std::optional<Progress> progress() const noexcept override {
    using std::chrono::microseconds;
    const std::optional<tcp_info> info = state();
    if (!info || info->tcpi_delivered == 0) return std::nullopt;  // an old kernel does not count
    const std::uint64_t unacknowledged = std::uint64_t{info->tcpi_unacked} * info->tcpi_snd_mss;
    return Progress{info->tcpi_delivered,
                    info->tcpi_snd_mss,
                    info->tcpi_notsent_bytes + unacknowledged,
                    info->tcpi_notsent_bytes,
                    info->tcpi_delivery_rate,
                    microseconds(info->tcpi_min_rtt),
                    microseconds(info->tcpi_rtt),
                    microseconds(info->tcpi_busy_time),
                    microseconds(info->tcpi_rwnd_limited)};
  }

  int fd() const noexcept override { return socket_.get(); }

 private:
  std::optional<tcp_info> state() const noexcept {
    tcp_info info{};
    socklen_t length = sizeof info;
    if (::getsockopt(socket_.get(), IPPROTO_TCP, TCP_INFO, &info, &length) != 0) {
      return std::nullopt;
    }
    return info;
  }

  Result<IoResult> receive_stamped(std::span<const iovec> spaces) {
    alignas(cmsghdr) std::array<char, CMSG_SPACE(sizeof(timespec))> control{};
    msghdr message = header(spaces);
    ssize_t bytes = 0;
    do {
      message.msg_control = control.data();
      message.msg_controllen = control.size();
      bytes = ::recvmsg(socket_.get(), &message, MSG_DONTWAIT);
    } while (bytes < 0 && errno == EINTR);
    if (bytes > 0) arrived_ = stamp_of(message);
    return io_result(bytes, "receive from the other side", socket_.get());
  }

  static std::optional<Time> stamp_of(const msghdr& message) noexcept {
    const cmsghdr* header = CMSG_FIRSTHDR(&message);
    if (!header || header->cmsg_level != SOL_SOCKET || header->cmsg_type != SCM_TIMESTAMPNS) {
      return std::nullopt;
    }
    timespec stamp{};
    std::memcpy(&stamp, CMSG_DATA(header), sizeof stamp);
    return time_from_ns(stamp.tv_sec * std::int64_t{1'000'000'000} + stamp.tv_nsec);
  }

  // All other calls pass MSG_DONTWAIT, so that the socket's own mode may be blocking.
  void make_waitable() noexcept {
    waits_ = true;
    constexpr timeval kWait{0, std::chrono::microseconds(kReceiveWait).count()};
    static_cast<void>(::setsockopt(socket_.get(), SOL_SOCKET, SO_RCVTIMEO, &kWait, sizeof kWait));
    static_cast<void>(::fcntl(socket_.get(), F_SETFL, 0));  // without O_NONBLOCK
  }

  static msghdr header(std::span<const iovec> parts) noexcept {
    msghdr message{};
    message.msg_iov = const_cast<iovec*>(parts.data());  // the kernel only reads them
    message.msg_iovlen = std::min(parts.size(), kMaxParts);
    return message;
  }

  UniqueFd socket_;
  bool waits_ = false;  // receive_waiting() was prepared
  bool stamps_ = false;
  std::optional<Time> arrived_;
};

using NameOf = int (*)(int, sockaddr*, socklen_t*);

Result<SocketAddress> address_by(NameOf name_of, int socket, const char* what) {
  SocketAddress address;
  address.length = sizeof address.storage;
  if (name_of(socket, reinterpret_cast<sockaddr*>(&address.storage), &address.length)) {
    return os_error(what);
  }
  return address;
}

// When no process listens at a port of this PC that the kernel also picks for outgoing connections,
// a socket can be connected to itself.
bool is_connected_to_itself(int socket) {
  const Result<SocketAddress> local = local_address(socket), peer = peer_address(socket);
  return local && peer && local->length == peer->length &&
         std::memcmp(&local->storage, &peer->storage, local->length) == 0;
}

}  // namespace

Result<UniqueFd> listen_tcp(const SocketAddress& address) {
  const std::string what = "listen at '" + address.str() + "'";
  Result<UniqueFd> fd = tcp_socket(address);
  if (!fd) return std::move(fd).error().context(what);
  set_option(fd->get(), SOL_SOCKET, SO_REUSEADDR, 1);
  if (address.storage.ss_family == AF_INET6) set_option(fd->get(), IPPROTO_IPV6, IPV6_V6ONLY, 1);
  if (::bind(fd->get(), address.get(), address.length) || ::listen(fd->get(), kBacklog)) {
    if (errno == EADDRINUSE) {
      return Error{Errc::conflict, what +
                                       ": the port is taken by another process (`ss -ltnp` shows "
                                       "it); end that one or choose another port"};
    }
    if (errno == EADDRNOTAVAIL) {
      return Error{Errc::invalid_argument,
                   what + ": this PC has no such address (`ip address` lists them)"};
    }
    return os_error(what);
  }
  return fd;
}

Result<SocketAddress> local_address(int socket) {
  return address_by(&::getsockname, socket, "ask for a socket's own address");
}

Result<SocketAddress> peer_address(int socket) {
  Result<SocketAddress> peer =
      address_by(&::getpeername, socket, "ask for the other side's address");
  if (!peer || peer->storage.ss_family != AF_INET6) return peer;
  sockaddr_in6 six{};
  std::memcpy(&six, &peer->storage, sizeof six);
  if (!IN6_IS_ADDR_V4MAPPED(&six.sin6_addr)) return peer;
  sockaddr_in four{};
  four.sin_family = AF_INET;
  four.sin_port = six.sin6_port;
  std::memcpy(&four.sin_addr, six.sin6_addr.s6_addr + 12, sizeof four.sin_addr);
  peer->storage = {};
  std::memcpy(&peer->storage, &four, sizeof four);
  peer->length = sizeof four;
  return peer;
}

bool takes_ipv4_too(int socket) noexcept {
  const Result<SocketAddress> address = local_address(socket);
  if (!address || address->storage.ss_family != AF_INET6) return false;
  sockaddr_in6 six{};
  std::memcpy(&six, &address->storage, sizeof six);
  int only_6 = 1;
  socklen_t length = sizeof only_6;
  return IN6_IS_ADDR_UNSPECIFIED(&six.sin6_addr) &&
         ::getsockopt(socket, IPPROTO_IPV6, IPV6_V6ONLY, &only_6, &length) == 0 && !only_6;
}

std::string interface_without_carrier(const SocketAddress& address) {
  // To connect a socket of UDP only chooses the route, and with it this PC's address.
  const UniqueFd fd(::socket(address.storage.ss_family, SOCK_DGRAM | SOCK_CLOEXEC, 0));
  if (!fd || ::connect(fd.get(), address.get(), address.length)) return {};
  const Result<SocketAddress> local = local_address(fd.get());
  if (!local) return {};
  const std::optional<IpAddress> own = IpAddress::of(*local);
  ifaddrs* all = nullptr;
  // What this PC sends to itself takes no interface with a cable.
  if (!own || own == IpAddress::of(address) || ::getifaddrs(&all)) return {};
  std::string without;
  for (const ifaddrs* each = all; each; each = each->ifa_next) {
    if (!each->ifa_addr) continue;
    SocketAddress one;
    one.length = each->ifa_addr->sa_family == AF_INET    ? sizeof(sockaddr_in)
                 : each->ifa_addr->sa_family == AF_INET6 ? sizeof(sockaddr_in6)
                                                         : 0;
    std::memcpy(&one.storage, each->ifa_addr, one.length);
    if (one.length == 0 || IpAddress::of(one) != own) continue;
    constexpr unsigned kLowerUp = 1U << 16;  // IFF_LOWER_UP; linux/if.h conflicts with net/if.h
    if (each->ifa_flags & kLowerUp) {
      without.clear();
      break;
    }
    without = each->ifa_name;
  }
  ::freeifaddrs(all);
  return without;
}

Result<UniqueFd> start_connect(const SocketAddress& address) {
  Result<UniqueFd> fd = tcp_socket(address);
  if (!fd) return fd;
  set_channel_options(fd->get());
  set_option(fd->get(), IPPROTO_TCP, TCP_USER_TIMEOUT, kUnansweredMs);
  if (::connect(fd->get(), address.get(), address.length) && errno != EINPROGRESS &&
      errno != EINTR) {
    return network_error("connect to '" + address.str() + "'", errno, fd->get());
  }
  return fd;
}

Result<void> finish_connect(int socket, const SocketAddress& address) {
  const std::string what = "connect to '" + address.str() + "'";
  int why = 0;
  socklen_t length = sizeof why;
  if (::getsockopt(socket, SOL_SOCKET, SO_ERROR, &why, &length)) return os_error(what);
  if (why == 0 && is_connected_to_itself(socket)) why = ECONNREFUSED;
  if (why == 0) return {};
  if (why == ECONNREFUSED) {
    return Error{Errc::no_daemon, os_error(what, why).message +
                                      "; is dssmd running there, and does it listen on that "
                                      "address?"};
  }
  return network_error(what, why, socket);
}

void discard_output_at_close(int socket) noexcept {
  constexpr linger kAtOnce{1, 0};
  static_cast<void>(::setsockopt(socket, SOL_SOCKET, SO_LINGER, &kAtOnce, sizeof kAtOnce));
}

void set_channel_options(int socket) noexcept {
  set_option(socket, IPPROTO_TCP, TCP_NODELAY, 1);
  set_option(socket, SOL_SOCKET, SO_KEEPALIVE, 1);
  set_option(socket, IPPROTO_TCP, TCP_KEEPIDLE, kProbeAfterSeconds);
  set_option(socket, IPPROTO_TCP, TCP_KEEPINTVL, kProbeEverySeconds);
  set_option(socket, IPPROTO_TCP, TCP_KEEPCNT, kProbes);
  set_option(socket, IPPROTO_TCP, TCP_USER_TIMEOUT, kUntakenMs);
}

std::unique_ptr<Transport> make_transport(UniqueFd socket, TransportEnd end) {
  if (end == TransportEnd::accepted) set_channel_options(socket.get());
  return std::make_unique<TcpTransport>(std::move(socket));
}

}  // namespace dssm::wire
