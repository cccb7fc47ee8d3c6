// SPDX-License-Identifier: Apache-2.0
//
// dssmd's configuration: one table of keys that serves the file, the flags, the help text and the
// checks alike. A key `max_streams` in the file is the flag --max-streams; both are parsed and
// checked in the same way. A key that is a list is a flag that may be repeated; where the flag is
// given, it replaces the file's list. docs/configuration.md explains each key to a person.
#pragma once

#include <sys/types.h>

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "core/clock/clock_bound.hpp"
#include "core/wire/address.hpp"
#include "core/wire/tls_credentials.hpp"
#include "daemon/base/log.hpp"
#include "daemon/service/config_values.hpp"
#include "daemon/service/right.hpp"

namespace dssm::daemon {

// The highest values that may be configured; chosen so that a list of all streams, clients or opens
// still fits into one frame of the local protocol (17 MiB) with the longest names.
inline constexpr std::uint64_t kMaxStreams = 32768;
inline constexpr std::uint64_t kMaxClients = 32768;
inline constexpr std::uint64_t kMaxOpens = 100'000;
inline constexpr std::uint64_t kMaxConnections = 32768;

struct Config {
  std::string file;  // that it was read from, besides flags; empty: none
  std::string name;  // of this host; empty until finish() puts the machine's name there
  std::string runtime_dir = "/run/dssm";
  std::optional<gid_t> socket_group;  // none: the group that dssmd runs in
  mode_t socket_mode = 0660;
  LogLevel log_level = LogLevel::info;
  std::uint64_t max_clients = 4096;
  std::uint64_t max_clients_per_user = 0;  // 0: finish() makes it half of max_clients
  std::uint64_t max_streams = 4096;
  std::uint64_t max_memory_bytes = half_of_the_machines_memory();
  std::uint64_t max_opens = 65536;
  std::uint64_t max_opens_per_client = 16384;
  std::uint64_t max_share_percent = 75;  // of max_streams, max_memory and max_opens
  std::uint64_t max_property_bytes = 1ULL << 20;
  Duration recovery_grace = std::chrono::milliseconds(500);

  // Other hosts. listen: none given: loopback as far as it is there; empty: no network.
  std::optional<std::vector<wire::Address>> listen;
  std::vector<wire::Address> peers;
  bool insecure = false;
  std::string credentials;  // folder; empty: none
  // Read from there by finish(); nullptr: none.
  std::shared_ptr<const wire::TlsCredentials> loaded_credentials;
  std::vector<Right> rights;  // none given: every program and host may do everything
  // Discovery by mDNS. Names of network interfaces, or patterns as in fnmatch(3): those in
  // `interfaces`, all when that is empty, without those in `avoid_interfaces`.
  bool mdns = true;
  std::vector<std::string> interfaces;
  std::vector<std::string> avoid_interfaces = interfaces_between_programs();
  std::uint64_t max_connections = 256;
  std::uint64_t max_connections_per_host = 128;
  std::uint64_t max_peer_memory_bytes = 96ULL << 20;
  Duration mirror_linger = std::chrono::seconds(5);
  MirrorDemands mirrors;
  SendingDemands sending;

  // Clocks.
  ClockPolicies clocks;
  clock::PartsPerBillion max_drift = 50'000;
  wire::Address chronyd{"127.0.0.1", 323};  // its cmdport

  static std::uint64_t half_of_the_machines_memory() noexcept;
  // Those of containers, virtual machines and tunnels: a host that is found there is found on a
  // cable too, or does not belong to this fleet.
  static std::vector<std::string> interfaces_between_programs();
};

// How a value is written in the file: in quotes, as a plain integer, as either, as true or false
// (its flag has no value), or as a list of texts in quotes.
enum class ValueForm : std::uint8_t { text, integer, integer_or_text, boolean, list };

struct ConfigKey {
  std::string_view name;   // "max_streams"
  std::string_view value;  // the name of the value in the help text: "COUNT"
  std::string_view help;
  ValueForm form;
  // A new value in the file counts from a reload (SIGHUP) on, or not before the next start.
  struct Change {
    bool at_once;
    bool (*is_same)(const Config& one, const Config& other);
  } change;
  // Takes over `text`, for lists one element; the failure states what is wrong with it, without
  // naming the key.
  Result<void> (*set)(Config& config, std::string_view text);
  // Lists only: makes it an empty one, before its elements are set.
  void (*clear)(Config& config) = nullptr;
  std::string_view flag_name = {};  // where the flag is not called as the key: "peer"

  std::string flag() const;  // "--max-streams"
};

// In the order in which help text and documentation list them.
std::span<const ConfigKey> config_keys() noexcept;

// Takes over all keys of the TOML file `path`. Fails with invalid_argument and one line per
// mistake, "FILE:LINE: key 'KEY': reason", after checking the whole file.
Result<void> apply_file(Config& config, const std::string& path);

// The same from text; `path` is for the messages.
Result<void> apply_text_untrusted(Config& config, std::string_view text, const std::string& path);

// Fills in what was not given and checks what concerns several keys.
Result<void> finish(Config& config);

}  // namespace dssm::daemon
