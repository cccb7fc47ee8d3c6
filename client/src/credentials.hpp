// SPDX-License-Identifier: Apache-2.0
//
// What a program proves itself with to the dssmd of other PCs.
#pragma once

#include <dssm/result.hpp>
#include <memory>
#include <string>

#include "core/wire/address.hpp"
#include "core/wire/tls_credentials.hpp"

namespace dssm::detail {

// A value.
struct ClientCredentials {
  std::shared_ptr<const wire::TlsCredentials> credentials;  // nullptr: none
  bool for_loopback = false;                                // also for connections to this PC

  // Reads the files again if they have changed. While one is wrong, nothing changes.
  void refresh();
  // For a connection to `address`; nullptr: it is not encrypted.
  std::shared_ptr<const wire::TlsCredentials> for_address(
      const wire::SocketAddress& address) const {
    return for_loopback || !address.is_loopback() ? credentials : nullptr;
  }
};

// Loads those in `folder`. When it is empty: those in $DSSM_CREDENTIALS, else those in
// ~/.config/dssm/credentials ($XDG_CONFIG_HOME), if that exists, for other PCs only.
//   fails  as TlsCredentials::load()
Result<ClientCredentials> load_credentials(const std::string& folder);

}  // namespace dssm::detail
