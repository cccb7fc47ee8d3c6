// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary text as a configuration file: accepted, or refused with a message.
#include <cstdlib>

#include "daemon/service/config.hpp"

extern "C" int LLVMFuzzerTestOneInput(const std::uint8_t* data, std::size_t size) {
  dssm::daemon::Config config;
  const std::string_view text(reinterpret_cast<const char*>(data), size);
  const dssm::Result<void> applied = dssm::daemon::apply_text_untrusted(config, text, "fuzz.conf");
  if (!applied && applied.error().message.find("fuzz.conf:") != 0) std::abort();
  return 0;
}
