// SPDX-License-Identifier: Apache-2.0
//
// The TCP sockets on which other hosts and remote programs reach this dssmd.
#pragma once

#include <dssm/result.hpp>
#include <optional>
#include <string>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/address.hpp"
#include "daemon/base/log.hpp"
#include "daemon/service/service_manager.hpp"

namespace dssm::daemon {

class NetworkListener {
 public:
  // Sockets that listen already: kept over a restart, or the service manager's.
  using Inherited = std::vector<NamedDescriptor>;

  // Listens at the configured addresses, which are numbers; an empty list: nowhere. Nothing
  // configured: at the default port of 127.0.0.1 and ::1, as far as this PC has them and no other
  // dssmd took the port before; what is missing is logged as a warning.
  //   inherited  those that are bound to a wanted address are used and removed from the list; of
  //              the others, those that keep_in() had kept stop listening
  //   fails      naming the configured address that cannot be had
  static Result<NetworkListener> open(const std::optional<std::vector<wire::Address>>& configured,
                                      Inherited& inherited, Logger& logger);

  // Has the service manager keep the sockets, so that a peer that connects while dssmd is restarted
  // waits and is not refused. Those that it handed over are its own anyhow.
  void keep_in(ServiceManager& manager) const;
  bool has_kept() const;  // one of the sockets was kept by it
  // Whether a name that came with a socket is one that keep_in() gave.
  static bool is_kept_name(const std::string& name) { return name.starts_with('='); }

  const std::vector<UniqueFd>& sockets() const noexcept { return sockets_; }

  // Where it listens, with the port that the system chose where 0 was asked for.
  const std::vector<std::string>& addresses() const noexcept { return addresses_; }
  std::string str() const;  // "listening at 127.0.0.1:13776, [::1]:13776", "no network"

 private:
  NetworkListener() = default;
  Result<void> add(const wire::Address& address, Inherited& inherited);

  std::vector<UniqueFd> sockets_;
  std::vector<std::string> names_;  // of each socket, as it was handed over; empty: made here
  std::vector<std::string> addresses_;
};

}  // namespace dssm::daemon
