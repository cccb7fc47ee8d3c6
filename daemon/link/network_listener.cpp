// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/network_listener.hpp"

#include <sys/socket.h>

#include <algorithm>
#include <set>
#include <utility>

#include "core/base/try.hpp"
#include "core/wire/tcp.hpp"

namespace dssm::daemon {
namespace {

// Whether connections to `wanted` arrive at `socket`.
bool listens_at(int socket, const wire::SocketAddress& wanted) {
  const Result<wire::SocketAddress> bound = wire::local_address(socket);
  if (!bound) return false;
  if (bound->str() == wanted.str()) return true;
  // A socket of IPv6 may take IPv4 along.
  return wire::takes_ipv4_too(socket) &&
         wanted.str() == "0.0.0.0" + bound->str().substr(bound->str().rfind(':'));
}

// Of the sockets that were kept, ends those at addresses that are not wanted any more: one at
// 127.0.0.1 would be in the way of one at 0.0.0.0. Closing them is not enough, because the service
// manager still has them.
void end_unwanted(const NetworkListener::Inherited& inherited,
                  const std::vector<wire::Address>& wanted) {
  for (const NamedDescriptor& one : inherited) {
    if (!NetworkListener::is_kept_name(one.name)) continue;
    const bool is_wanted =
        std::any_of(wanted.begin(), wanted.end(), [&](const wire::Address& address) {
          const auto numbers = wire::resolve_number(address);
          return std::any_of(
              numbers.begin(), numbers.end(),
              [&](const wire::SocketAddress& number) { return listens_at(one.fd.get(), number); });
        });
    if (!is_wanted) ::shutdown(one.fd.get(), SHUT_RDWR);
  }
}

}  // namespace

Result<NetworkListener> NetworkListener::open(
    const std::optional<std::vector<wire::Address>>& configured, Inherited& inherited,
    Logger& logger) {
  NetworkListener listener;
  const std::vector<wire::Address> defaults = {{"127.0.0.1", wire::kDefaultPort},
                                               {"::1", wire::kDefaultPort}};
  const std::vector<wire::Address>& wanted = configured ? *configured : defaults;
  end_unwanted(inherited, wanted);
  for (const wire::Address& address : wanted) {
    Result<void> added = listener.add(address, inherited);
    if (added) continue;
    if (configured) return std::move(added).error();
    logger.warning(added.error().message +
                   "; nobody asked for this address (key listen), going on without it");
  }
  return listener;
}

Result<void> NetworkListener::add(const wire::Address& address, Inherited& inherited) {
  for (const wire::SocketAddress& number : wire::resolve_number(address)) {
    const bool is_covered = std::any_of(sockets_.begin(), sockets_.end(), [&](const UniqueFd& fd) {
      return listens_at(fd.get(), number);
    });
    if (is_covered) continue;
    const auto found =
        std::find_if(inherited.begin(), inherited.end(),
                     [&](const NamedDescriptor& one) { return listens_at(one.fd.get(), number); });
    if (found != inherited.end()) {
      addresses_.push_back(wire::local_address(found->fd.get())->str());
      names_.push_back(std::move(found->name));
      sockets_.push_back(std::move(found->fd));
      inherited.erase(found);
      continue;
    }
    UniqueFd socket = DSSM_TRY(wire::listen_tcp(number));
    const wire::SocketAddress bound = DSSM_TRY(wire::local_address(socket.get()));
    addresses_.push_back(bound.str());
    names_.emplace_back();
    sockets_.push_back(std::move(socket));
  }
  return {};
}

void NetworkListener::keep_in(ServiceManager& manager) const {
  std::set<std::string> used(names_.begin(), names_.end());
  int number = 0;
  for (std::size_t i = 0; i < sockets_.size(); ++i) {
    if (!names_[i].empty()) continue;
    std::string name;
    do {
      name = "=" + std::to_string(number++);
    } while (!used.insert(name).second);
    manager.keep(name, {sockets_[i].get()});
  }
}

bool NetworkListener::has_kept() const {
  return std::any_of(names_.begin(), names_.end(), is_kept_name);
}

std::string NetworkListener::str() const {
  if (addresses_.empty()) return "no network";
  std::string text = "listening at ";
  for (const std::string& address : addresses_) {
    text.append(&address == &addresses_.front() ? "" : ", ").append(address);
  }
  return text;
}

}  // namespace dssm::daemon
