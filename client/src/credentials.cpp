// SPDX-License-Identifier: Apache-2.0
#include "client/src/credentials.hpp"

#include <unistd.h>

#include <cerrno>
#include <cstdlib>

#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

std::string environment(const char* name) {
  const char* value = std::getenv(name);  // NOLINT(concurrency-mt-unsafe): as getaddrinfo
  return value ? value : "";
}

}  // namespace

void ClientCredentials::refresh() {
  if (!credentials) return;
  if (auto loaded = credentials->load_if_changed(); loaded && *loaded) credentials = *loaded;
}

Result<ClientCredentials> load_credentials(const std::string& folder) {
  const std::string chosen = folder.empty() ? environment("DSSM_CREDENTIALS") : folder;
  if (!chosen.empty()) {
    return ClientCredentials{DSSM_TRY(wire::TlsCredentials::load(chosen)), true};
  }
  std::string config = environment("XDG_CONFIG_HOME");
  if (config.empty()) config = environment("HOME") + "/.config";
  const std::string usual = config + "/dssm/credentials";
  if (::access(usual.c_str(), F_OK) != 0 && (errno == ENOENT || errno == ENOTDIR)) {
    return ClientCredentials{};
  }
  return ClientCredentials{DSSM_TRY(wire::TlsCredentials::load(usual)), false};
}

}  // namespace dssm::detail
