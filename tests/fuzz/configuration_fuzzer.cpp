// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary text as a configuration file: accepted, or refused with a message.
#include <cstdlib>

#include "daemon/service/config.hpp"
#include "tests/fuzz/fuzzer.hpp"

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) {
  daemon::Config config;
  const std::string_view text(reinterpret_cast<const char*>(input.data()), input.size());
  const Result<void> applied = daemon::apply_text_untrusted(config, text, "fuzz.conf");
  if (!applied && applied.error().message.find("fuzz.conf:") != 0) std::abort();
}
