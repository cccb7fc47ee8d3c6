// SPDX-License-Identifier: Apache-2.0
//
// From the address of a dssmd as written by a person to addresses to connect to.
#pragma once

#include <dssm/result.hpp>
#include <string>
#include <vector>

#include "core/wire/address.hpp"

namespace dssm::detail {

// $DSSM_PORT, else wire::kDefaultPort.
//   fails  invalid_argument
Result<std::uint16_t> default_port();

// Parses `text`; empty: "127.0.0.1".
//   fails  invalid_argument
Result<wire::Address> parse_host(const std::string& text);

// The addresses of `address`, from the system's resolver, or, if that does not know it, from the
// catalog of this PC's dssmd. May take seconds.
//   fails  as wire::resolve()
Result<std::vector<wire::SocketAddress>> find_host(const wire::Address& address);

}  // namespace dssm::detail
