// SPDX-License-Identifier: Apache-2.0
//
// The protocol of sd_notify(3), written here because libsystemd's own function waits while the
// manager's queue is full, and dssmd never blocks.
#include "daemon/service/service_manager.hpp"

#include <fcntl.h>
#include <netinet/in.h>
#include <sys/socket.h>
#include <sys/un.h>
#include <systemd/sd-daemon.h>

#include <algorithm>
#include <cerrno>
#include <cstddef>
#include <cstdlib>
#include <cstring>
#include <utility>

#include "core/base/check.hpp"
#include "core/base/text.hpp"
#include "daemon/base/log.hpp"

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxDescriptorsPerMessage = 253;  // the kernel's SCM_MAX_FD

// Pause before a retry when the socket does not become writable: that too many descriptors are in
// flight has nothing to do with free space in its queue.
constexpr Duration kPause = std::chrono::milliseconds(10);

int socket_option(int socket, int option) noexcept {
  int value = -1;
  socklen_t length = sizeof value;
  return ::getsockopt(socket, SOL_SOCKET, option, &value, &length) ? -1 : value;
}

}  // namespace

// The protocol of sd_notify(3), written here because libsystemd's own function waits while the
// manager's queue is full, and dssmd never blocks.

std::vector<NamedDescriptor> take_handed_over() {
  char** names = nullptr;
  const int count = sd_listen_fds_with_names(1, &names);
  std::vector<NamedDescriptor> taken;
  for (int i = 0; i < count; ++i) {
    // Also without $LISTEN_FDNAMES there is a name: libsystemd's "unknown".
    taken.push_back({names[i], UniqueFd(SD_LISTEN_FDS_START + i)});
    std::free(names[i]);
  }
  std::free(names);
  return taken;
}

std::string ServiceManager::notify_socket() {
  const char* path = std::getenv("NOTIFY_SOCKET");  // NOLINT(concurrency-mt-unsafe): one thread
  return path ? path : "";
}

ServiceManager::ServiceManager(const EventLoop& loop, std::string notify_socket)
    : loop_(loop),
      path_(std::move(notify_socket)),
      try_again_(EventSource::timer(loop, [this] { send_waiting(); })) {
  const bool is_address = (path_.starts_with('/') || path_.starts_with('@')) && path_.size() > 1 &&
                          path_.size() < sizeof(sockaddr_un::sun_path);
  if (!is_address) path_.clear();
}

ServiceManager::~ServiceManager() { send_waiting(); }

void ServiceManager::ready(std::string_view status) {
  send({"READY=1\nSTATUS=" + printable(status), {}, {}});
}

void ServiceManager::reloading() {
  // The manager takes only a READY=1 of a later time for the end of this reload.
  const auto now =
      std::chrono::duration_cast<std::chrono::microseconds>(MonoClock::now().time_since_epoch());
  send({"RELOADING=1\nMONOTONIC_USEC=" + std::to_string(now.count()), {}, {}});
}

void ServiceManager::stopping() { send({"STOPPING=1", {}, {}}); }

void ServiceManager::status(std::string_view text) { send({"STATUS=" + printable(text), {}, {}}); }

void ServiceManager::alive() {
  if (waiting_.empty()) static_cast<void>(send_now({"WATCHDOG=1", {}, {}}));
}

// FDPOLL=0: the manager shall not poll them: otherwise any writer could make it drop an eventfd.
void ServiceManager::keep(const std::string& name, const std::vector<int>& fds) {
  DSSM_CHECK(!fds.empty() && fds.size() <= kMaxDescriptorsPerMessage);
  send({"FDSTORE=1\nFDPOLL=0\nFDNAME=" + name, fds, name});
}

void ServiceManager::forget(const std::string& name) {
  // A message that still waits would keep descriptors that are about to be closed.
  const auto unsent = std::find_if(waiting_.begin(), waiting_.end(),
                                   [&](const Message& message) { return message.keeps == name; });
  if (unsent != waiting_.end()) {
    waiting_.erase(unsent);
    return;
  }
  send({"FDSTOREREMOVE=1\nFDNAME=" + name, {}, {}});
}

void ServiceManager::send(Message message) {
  if (path_.empty()) return;
  if (waiting_.empty() && send_now(message) != Sent::not_now) return;
  waiting_.push_back(std::move(message));
}

ServiceManager::Sent ServiceManager::send_now(const Message& message) {
  if (path_.empty()) return Sent::no_manager;
  // A restarted manager has another socket at the same path.
  for (int attempt = 0; attempt < 2; ++attempt) {
    if (!connected_ && !connect()) return Sent::no_manager;
    const Sent sent = try_send(message);
    if (sent == Sent::not_now) {
      writable_.enable();
      try_again_.enable_in(kPause);
    }
    if (sent != Sent::no_manager) return sent;
    connected_ = false;
  }
  return Sent::no_manager;
}

bool ServiceManager::connect() {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  std::memcpy(address.sun_path, path_.data(), path_.size());
  if (path_.starts_with('@')) address.sun_path[0] = '\0';
  const auto length = static_cast<socklen_t>(offsetof(sockaddr_un, sun_path) + path_.size() +
                                             (path_.starts_with('@') ? 0 : 1));
  if (!socket_) {
    socket_.reset(::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
    if (!socket_) return false;
    writable_ = EventSource::writable(loop_, socket_.get(), [this] {
      writable_.disable();
      try_again_.enable_in(Duration::zero());
    });
  }
  connected_ = !::connect(socket_.get(), reinterpret_cast<const sockaddr*>(&address), length);
  return connected_;
}

ServiceManager::Sent ServiceManager::try_send(const Message& message) const {
  iovec text{const_cast<char*>(message.text.data()), message.text.size()};
  std::vector<char> control(CMSG_SPACE(message.fds.size() * sizeof(int)));
  msghdr header{};
  header.msg_iov = &text;
  header.msg_iovlen = 1;
  if (!message.fds.empty()) {
    header.msg_control = control.data();
    header.msg_controllen = control.size();
    cmsghdr* part = CMSG_FIRSTHDR(&header);
    part->cmsg_level = SOL_SOCKET;
    part->cmsg_type = SCM_RIGHTS;
    part->cmsg_len = CMSG_LEN(message.fds.size() * sizeof(int));
    std::memcpy(CMSG_DATA(part), message.fds.data(), message.fds.size() * sizeof(int));
  }
  for (;;) {
    if (::sendmsg(socket_.get(), &header, MSG_NOSIGNAL) >= 0) return Sent::taken;
    if (errno == EINTR) continue;
    // ETOOMANYREFS: too many descriptors are on their way; the manager takes them off it.
    const bool later = errno == EAGAIN || errno == ENOBUFS || errno == ETOOMANYREFS;
    return later ? Sent::not_now : Sent::no_manager;
  }
}

void ServiceManager::send_waiting() {
  while (!waiting_.empty() && send_now(waiting_.front()) != Sent::not_now) waiting_.pop_front();
}

Watchdog::Watchdog(const EventLoop& loop, ServiceManager& manager) {
  std::uint64_t interval_us = 0;
  if (!manager.is_there() || sd_watchdog_enabled(1, &interval_us) <= 0) return;
  pause_ = std::chrono::microseconds(interval_us / 2);
  timer_ = EventSource::timer(loop, [this, &manager] {
    manager.alive();
    timer_.enable_in(pause_);
  });
  timer_.enable_in(pause_);
}

// --- the status line

StatusLine::StatusLine(const EventLoop& loop, ServiceManager& manager,
                       std::function<std::string()> text)
    : manager_(manager),
      text_(std::move(text)),
      timer_(EventSource::timer(loop, [this] { update(); })) {}

std::string StatusLine::now() { return sent_ = text_(); }

void StatusLine::touch() {
  if (manager_.is_there() && !std::exchange(due_, true)) timer_.enable_in(kPause);
}

void StatusLine::update() {
  due_ = false;
  std::string text = text_();
  if (text == sent_) return;
  sent_ = std::move(text);
  manager_.status(sent_);
}

// --- descriptors of the manager

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
