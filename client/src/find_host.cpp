// SPDX-License-Identifier: Apache-2.0
#include "client/src/find_host.hpp"

#include <charconv>
#include <cstdlib>
#include <dssm/session.hpp>

#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

// The addresses under which this PC's dssmd knows the host named `address.host`.
std::vector<wire::SocketAddress> ask_catalog(const wire::Address& address) {
  std::vector<wire::SocketAddress> found;
  const auto usual = default_port();
  auto session = Session::connect();
  auto hosts = session ? session->list_hosts() : std::move(session).error();
  if (!hosts) return found;
  for (const HostInfo& host : *hosts) {
    if (host.name != address.host) continue;
    for (const std::string& text : host.addresses) {
      auto known = wire::Address::parse(text);
      if (!known || known->host == address.host) continue;  // that name was looked up already
      if (usual && address.port != *usual) known->port = address.port;  // the program named it
      auto resolved = wire::resolve(*known);
      if (resolved) found.insert(found.end(), resolved->begin(), resolved->end());
    }
  }
  return found;
}

}  // namespace

Result<std::uint16_t> default_port() {
  const char* text = std::getenv("DSSM_PORT");  // NOLINT(concurrency-mt-unsafe): as getaddrinfo
  if (!text || !*text) return wire::kDefaultPort;
  const std::string_view digits(text);
  std::uint16_t port = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), port);
  if (error != std::errc{} || end != digits.data() + digits.size() || port == 0) {
    return Error{Errc::invalid_argument, "$DSSM_PORT is '" + std::string(digits) +
                                             "', which is not a port: set it to 1 to 65535"};
  }
  return port;
}

Result<wire::Address> parse_host(const std::string& text) {
  const std::uint16_t port = DSSM_TRY(default_port());
  return wire::Address::parse(text.empty() ? "127.0.0.1" : text, port);
}

Result<std::vector<wire::SocketAddress>> find_host(const wire::Address& address) {
  auto resolved = wire::resolve(address);
  if (resolved) return resolved;
  std::vector<wire::SocketAddress> known = ask_catalog(address);
  if (!known.empty()) return known;
  Error error = std::move(resolved).error();
  error.message += "; and the dssmd of this PC, if one runs, does not know a host of that name";
  return error;
}

}  // namespace dssm::detail
