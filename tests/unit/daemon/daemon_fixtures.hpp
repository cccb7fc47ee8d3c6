// SPDX-License-Identifier: Apache-2.0
//
// What the daemon's unit tests share: small values of the types that everything is made of.
#pragma once

#include <fcntl.h>

#include <dssm/stream.hpp>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/streams/memory_files.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {

inline TypeInfo odometry_type() {
  return {"Odometry", 24, 8, {{"x", Scalar::float64, 0, 1, 8}, {"y", Scalar::float64, 8, 1, 8}}};
}

inline constexpr History kHistory{16, std::chrono::milliseconds(10)};
inline constexpr Registry::Limits kLimits{
    .max_streams = 400, .max_memory_bytes = 64 << 20, .max_property_bytes = 1 << 20};

inline std::shared_ptr<const ClientIdentity> client(ClientNumber number) {
  const auto identity = std::make_shared<ClientIdentity>();
  identity->number = number;
  identity->pid = static_cast<std::int32_t>(1000 + number);
  identity->program = "test";
  return identity;
}

// The descriptors of an Open, as the memory files of an Offer.
inline OfferedFiles as_offer(std::vector<UniqueFd> descriptors) {
  OfferedFiles files;
  files.ring = std::move(descriptors.at(0));
  files.bell = std::move(descriptors.at(1));
  files.meta = std::move(descriptors.at(2));
  if (descriptors.size() > 3) files.doorbell = std::move(descriptors.at(3));
  return files;
}

inline UniqueFd copy_of(const UniqueFd& fd) {
  return UniqueFd(::fcntl(fd.get(), F_DUPFD_CLOEXEC, 0));
}

}  // namespace dssm::daemon
