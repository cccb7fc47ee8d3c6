// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/this_host.hpp"

#include <fmt/format.h>
#include <toml++/toml.h>
#include <unistd.h>

#include <array>
#include <cstring>
#include <optional>

#include "client/dssmctl/pki_files.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/wire/host_id.hpp"

namespace dssm::ctl {
namespace {

constexpr const char* kOtherWay = "; or give the name with --host";

Error config_error(const std::string& config, std::string_view reason) {
  return {Errc::not_found,
          fmt::format("find the name of this host in '{}': {}; fix the file (dssmd "
                      "--config {} --check-config){}",
                      config, reason, config, kOtherWay)};
}

// The value of the key `name`; none without the key or the file.
Result<std::optional<std::string>> configured_name(const std::string& config) {
  const Result<std::string> text = pki::read_text(config);
  if (!text && text.error().code == Errc::not_found) return std::optional<std::string>();
  if (!text) return Error{text.error().code, text.error().message + kOtherWay};
  try {  // toml::parse() throws
    const toml::table table = toml::parse(*text, config);
    const toml::node* name = table.get("name");
    if (!name) return std::optional<std::string>();
    if (!name->is_string()) return config_error(config, "key 'name' is not a text in quotes");
    return std::optional<std::string>(name->as_string()->get());
  } catch (const toml::parse_error& error) {
    return config_error(config, error.description());
  }
}

}  // namespace

Result<std::string> this_host_name(const std::string& config) {
  const std::optional<std::string> configured = DSSM_TRY(configured_name(config));
  if (configured) {
    if (const Result<void> checked = check_host_name(*configured); !checked) {
      return config_error(config, checked.error().message);
    }
    return *configured;
  }
  std::array<char, 256> name{};
  if (::gethostname(name.data(), name.size() - 1)) return os_error("ask for the machine's name");
  const std::string first_label(name.data(), std::strcspn(name.data(), "."));
  if (Result<void> checked = check_host_name(first_label); !checked) {
    return Error{Errc::not_found,
                 fmt::format("use the machine's name: {}{}", checked.error().message, kOtherWay)};
  }
  return first_label;
}

Result<std::string> this_host_id(const std::string& name) {
  if (!wire::has_lasting_host_id()) {
    return Error{Errc::not_found,
                 "find the id of this host: /etc/machine-id is missing or empty; create it with "
                 "systemd-machine-id-setup, then restart dssmd"};
  }
  return hex(wire::host_id_for(name));
}

}  // namespace dssm::ctl
