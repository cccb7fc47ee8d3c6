// SPDX-License-Identifier: Apache-2.0
//
// From what a person wrote as the address of a dssmd to addresses to connect to.
#pragma once

#include <dssm/result.hpp>
#include <string>
#include <vector>

#include "core/wire/address.hpp"

namespace dssm::detail {

// $DSSM_PORT, else wire::kDefaultPort.
//   fails  invalid_argument
Result<std::uint16_t> default_port();

// What `text` says, "127.0.0.1" when it is empty.
//   fails  invalid_argument
Result<wire::Address> parse_host(const std::string& text);

// The addresses behind `address`: by the system's resolver, and when that does not know it, by the
// catalog of this PC's dssmd. Looking up a name may take seconds.
//   fails  as wire::resolve()
Result<std::vector<wire::SocketAddress>> find_host(const wire::Address& address);

}  // namespace dssm::detail
