// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/config.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/un.h>
#include <toml++/toml.h>
#include <unistd.h>

#include <algorithm>
#include <cstring>
#include <map>
#include <vector>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/base/unique_fd.hpp"
#include "core/wire/local_protocol.hpp"
#include "daemon/service/config_values.hpp"

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxFileBytes = 1U << 20;
constexpr std::uint64_t kMaxMemoryBytes = 1ULL << 50;
constexpr std::int64_t kMaxGraceNs = to_ns(std::chrono::seconds(60));
constexpr std::int64_t kMaxLingerNs = to_ns(std::chrono::hours(1));
constexpr std::uint16_t kChronydPort = 323;

// Puts a parsed value into its place.
template <class T, class U>
Result<void> take(T& place, Result<U> value) {
  place = DSSM_TRY(std::move(value));
  return {};
}

Result<void> set_runtime_dir(Config& config, std::string_view text) {
  const auto error = [&](const std::string& why) {
    return Error{Errc::invalid_argument, in_quotes(text) + " " + why};
  };
  if (!text.starts_with('/')) return error("does not begin with '/'");
  if (text.find('\0') != text.npos) return error("holds a zero byte");
  // "/dssmd.sock" and the end mark have to fit into a socket's address.
  if (text.size() + 12 > sizeof(sockaddr_un::sun_path)) {
    return error("is longer than the 96 bytes that leave space for a socket's name");
  }
  config.runtime_dir = text;
  return {};
}

// An empty text adds nothing, so that the flag can ask for an empty list.
Result<void> add_listen_address(Config& config, std::string_view text) {
  if (text.empty()) return {};
  wire::Address address = DSSM_TRY(wire::Address::parse(text, wire::kDefaultPort, true));
  if (wire::resolve_number(address).empty()) {
    return Error{Errc::invalid_argument,
                 in_quotes(text) +
                     " is a name; write the number of an address of this PC, such as "
                     "\"127.0.0.1:13776\", \"[::]:13776\" or \"0.0.0.0:13776\""};
  }
  config.listen->push_back(std::move(address));
  return {};
}

Result<void> add_peer(Config& config, std::string_view text) {
  if (text.empty()) return {};
  config.peers.push_back(DSSM_TRY(wire::Address::parse(text)));
  return {};
}

Result<void> set_chronyd(Config& config, std::string_view text) {
  wire::Address address = DSSM_TRY(wire::Address::parse(text, kChronydPort));
  if (wire::resolve_number(address).empty()) {
    return Error{Errc::invalid_argument,
                 in_quotes(text) + " is a name; write a number such as \"127.0.0.1:323\""};
  }
  config.chronyd = std::move(address);
  return {};
}

template <auto member>
Result<void> add_interface(Config& config, std::string_view text) {
  if (text.empty()) return {};
  (config.*member).push_back(DSSM_TRY(parse_interface(text)));
  return {};
}

// For lists of what differs for some streams. One of none, "", adds nothing.
template <auto member, auto parse>
Result<void> add_exception(Config& config, std::string_view text) {
  if (text.empty()) return {};
  (config.*member).exceptions.push_back(DSSM_TRY(parse(text)));
  return {};
}

// A name may resolve to any address, now or later; only "localhost" may not.
bool stays_on_this_pc(const wire::Address& address) {
  if (address.host == "localhost") return true;
  const std::vector<wire::SocketAddress> numbers = wire::resolve_number(address);
  return !numbers.empty() && numbers.front().is_loopback();
}

Result<void> check_secure(const Config& config) {
  if (config.insecure || !config.credentials.empty()) return {};
  std::string addresses;
  const auto note = [&](std::string_view what, const std::vector<wire::Address>& list) {
    for (const wire::Address& address : list) {
      if (stays_on_this_pc(address)) continue;
      addresses.append(addresses.empty() ? "" : ", ")
          .append(what)
          .append(" ")
          .append(in_quotes(address.str()));
    }
  };
  if (config.listen) note("listen", *config.listen);
  note("peer", config.peers);
  if (addresses.empty()) return {};
  return Error{
      Errc::invalid_argument,
      addresses +
          ": without credentials, traffic to other PCs is unencrypted, and any host that reaches "
          "this one can read and write all its streams; set credentials = \"FOLDER\" "
          "(docs/security.md), or insecure = true (--insecure) if you own that network, or use "
          "loopback addresses only"};
}

Result<void> take_name_of_machine(Config& config) {
  char name[256] = {};
  if (::gethostname(name, sizeof name - 1)) return os_error("ask for the machine's name");
  const std::string_view first_label(name, ::strcspn(name, "."));
  if (Result<void> checked = check_host_name(first_label); !checked) {
    return Error{Errc::invalid_argument,
                 "the machine's name cannot be the host's name: " + checked.error().message +
                     "; choose one with --name or the key 'name'"};
  }
  config.name = first_label;
  return {};
}

Result<void> load_credentials(Config& config) {
  if (config.credentials.empty()) return {};
  config.loaded_credentials = DSSM_TRY(wire::TlsCredentials::load(config.credentials));
  const wire::CertifiedPeer& own = config.loaded_credentials->own();
  const bool is_host = own.kind == wire::CertifiedPeer::Kind::host;
  if (is_host && own.name == config.name && own.host_id == wire::host_id_for(config.name)) {
    return {};
  }
  return Error{
      Errc::invalid_argument,
      fmt::format("credentials: the certificate in '{}' is of {}{}, and this is host '{}'; "
                  "issue one for it (`dssmctl pki request`, docs/security.md)",
                  config.credentials, own.str(),
                  is_host && own.name == config.name ? " on another machine" : "", config.name)};
}

template <auto member>
bool is_same(const Config& one, const Config& other) {
  return one.*member == other.*member;
}
template <auto member>
constexpr ConfigKey::Change kChangesAtOnce{true, &is_same<member>};
template <auto member>
constexpr ConfigKey::Change kChangesAtRestart{false, &is_same<member>};

// Setters for keys with one value.
template <auto member, auto parse>
Result<void> set_by(Config& config, std::string_view text) {
  return take(config.*member, parse(text));
}
template <auto member, std::uint64_t max>
Result<void> set_count(Config& config, std::string_view text) {
  return take(config.*member, parse_count(text, 1, max));
}
template <auto member, std::uint64_t min, std::uint64_t max>
Result<void> set_bytes(Config& config, std::string_view text) {
  return take(config.*member, parse_bytes(text, min, max));
}
template <auto member, std::int64_t max_ns>
Result<void> set_duration(Config& config, std::string_view text) {
  return take(config.*member, parse_duration(text, Duration::zero(), Duration(max_ns)));
}

constexpr ConfigKey kKeys[] = {
    {"name", "HOST",
     "this host's name in 'stream:id@HOST'; default: the machine's name up to the first dot",
     ValueForm::text, kChangesAtRestart<&Config::name>,
     [](Config& c, std::string_view text) -> Result<void> {
       DSSM_TRY(check_host_name(text));
       c.name = text;
       return {};
     }},
    {"runtime_dir", "DIR", "folder of the socket 'dssmd.sock'; default: /run/dssm", ValueForm::text,
     kChangesAtRestart<&Config::runtime_dir>, set_runtime_dir},
    {"socket_group", "GROUP", "group that owns the socket; default: dssmd's own", ValueForm::text,
     kChangesAtRestart<&Config::socket_group>, set_by<&Config::socket_group, parse_group>},
    {"socket_mode", "MODE", "permissions of the socket, octal; default: 0660", ValueForm::text,
     kChangesAtRestart<&Config::socket_mode>, set_by<&Config::socket_mode, parse_mode>},
    {"log_level", "LEVEL", "error, warning, notice, info or debug; default: info", ValueForm::text,
     kChangesAtOnce<&Config::log_level>, set_by<&Config::log_level, parse_log_level>},
    {"max_clients", "COUNT", "connections at once; default: 4096", ValueForm::integer,
     kChangesAtOnce<&Config::max_clients>, set_count<&Config::max_clients, kMaxClients>},
    {"max_clients_per_user", "COUNT",
     "connections of one user at once, but for root and dssmd's own user; default: half of "
     "max_clients",
     ValueForm::integer, kChangesAtOnce<&Config::max_clients_per_user>,
     set_count<&Config::max_clients_per_user, kMaxClients>},
    {"max_streams", "COUNT", "streams at once; default: 4096", ValueForm::integer,
     kChangesAtOnce<&Config::max_streams>, set_count<&Config::max_streams, kMaxStreams>},
    {"max_memory", "BYTES",
     "memory of all rings and properties, e.g. '4 GiB' or '25%'; default: half of the machine's",
     ValueForm::integer_or_text, kChangesAtOnce<&Config::max_memory_bytes>,
     set_bytes<&Config::max_memory_bytes, 64 << 10, kMaxMemoryBytes>},
    {"max_opens", "COUNT", "open streams of all clients together; default: 65536",
     ValueForm::integer, kChangesAtOnce<&Config::max_opens>,
     set_count<&Config::max_opens, kMaxOpens>},
    {"max_opens_per_client", "COUNT", "open streams of one client; default: 16384",
     ValueForm::integer, kChangesAtOnce<&Config::max_opens_per_client>,
     set_count<&Config::max_opens_per_client, kMaxOpens>},
    {"max_share", "PERCENT",
     "how much of max_streams and max_memory one user, other host or remote program may take, and "
     "of max_opens one user, but for root and dssmd's own user; default: 75%",
     ValueForm::text, kChangesAtOnce<&Config::max_share_percent>,
     set_by<&Config::max_share_percent, parse_percent>},
    {"max_property", "BYTES", "size of one stream's property; default: 1 MiB",
     ValueForm::integer_or_text, kChangesAtOnce<&Config::max_property_bytes>,
     set_bytes<&Config::max_property_bytes, 0, wire::kMaxPropertyBytes>},
    {"recovery_grace", "TIME",
     "how long after a crash or restart programs may give their streams back before new ones "
     "take their names; default: 500 ms",
     ValueForm::text, kChangesAtOnce<&Config::recovery_grace>,
     set_duration<&Config::recovery_grace, kMaxGraceNs>},
    {"listen", "ADDR:PORT",
     "where to listen for other hosts; may be repeated, '' for nowhere; default: 127.0.0.1:13776 "
     "and [::1]:13776",
     ValueForm::list, kChangesAtRestart<&Config::listen>, add_listen_address,
     [](Config& c) { c.listen.emplace(); }},
    {"peers", "HOST:PORT", "another host's dssmd to share streams with; may be repeated",
     ValueForm::list, kChangesAtOnce<&Config::peers>, add_peer, [](Config& c) { c.peers.clear(); },
     "peer"},
    {"credentials", "FOLDER",
     "encrypt connections with other PCs, and accept only those with certificates of the same "
     "authority; the files (ca.crt, own.crt, own.key, revoked.crl) are read again at a reload; '' "
     "for none; default: none",
     ValueForm::text, kChangesAtRestart<&Config::credentials>,
     [](Config& c, std::string_view text) -> Result<void> {
       c.credentials = text;
       return {};
     }},
    {"insecure", "", "allow connections with other PCs that are not encrypted", ValueForm::boolean,
     kChangesAtRestart<&Config::insecure>, set_by<&Config::insecure, parse_boolean>},
    {"rights", "WHO VERBS STREAMS",
     "who may do what with which streams, e.g. 'group:drivers read,write lidar*' or 'host:pc2 all "
     "*'; may be repeated; what no line allows is refused; default: every program and host may do "
     "everything",
     ValueForm::list, kChangesAtOnce<&Config::rights>,
     [](Config& c, std::string_view text) -> Result<void> {
       c.rights.push_back(DSSM_TRY(parse_right(text)));
       return {};
     },
     [](Config& c) { c.rights.clear(); }, "right"},
    {"mdns", "",
     "find other hosts, and announce this one and its streams, by mDNS; default: true "
     "(--mdns=false: do not)",
     ValueForm::boolean, kChangesAtRestart<&Config::mdns>, set_by<&Config::mdns, parse_boolean>},
    {"interfaces", "NAME",
     "network interface to use for mDNS, or a pattern such as 'eth*'; may be repeated; default: "
     "all",
     ValueForm::list, kChangesAtRestart<&Config::interfaces>, add_interface<&Config::interfaces>,
     [](Config& c) { c.interfaces.clear(); }, "interface"},
    {"avoid_interfaces", "NAME",
     "network interface not to use for mDNS, or a pattern; may be repeated, '' for none; default: "
     "those of containers, virtual machines and tunnels",
     ValueForm::list, kChangesAtRestart<&Config::avoid_interfaces>,
     add_interface<&Config::avoid_interfaces>, [](Config& c) { c.avoid_interfaces.clear(); },
     "avoid-interface"},
    {"max_connections", "COUNT", "connections of other hosts at once; default: 256",
     ValueForm::integer, kChangesAtOnce<&Config::max_connections>,
     set_count<&Config::max_connections, kMaxConnections>},
    {"max_connections_per_host", "COUNT", "connections from one address at once; default: 128",
     ValueForm::integer, kChangesAtOnce<&Config::max_connections_per_host>,
     set_count<&Config::max_connections_per_host, kMaxConnections>},
    {"max_peer_memory", "BYTES",
     "memory that the connections from one address may take of dssmd; default: 96 MiB",
     ValueForm::integer_or_text, kChangesAtOnce<&Config::max_peer_memory_bytes>,
     set_bytes<&Config::max_peer_memory_bytes, 1 << 20, kMaxMemoryBytes>},
    {"mirror_linger", "TIME",
     "how long the copy of another host's stream is kept after its last reader; default: 5 s",
     ValueForm::text, kChangesAtOnce<&Config::mirror_linger>,
     set_duration<&Config::mirror_linger, kMaxLingerNs>},
    {"mirror_history", "WHEN",
     "when the copy of another host's stream gets what was written before: when_read, or at_once; "
     "default: when_read",
     ValueForm::text, kChangesAtOnce<&Config::mirrors>,
     [](Config& c, std::string_view text) {
       return take(c.mirrors.general.history_at_once, parse_mirror_history(text));
     }},
    {"mirror_streams", "STREAM=WHAT",
     "for some streams another time, the highest rate, and how much history is kept here, e.g. "
     "'map=at_once' or 'camera*=10 Hz, 2 s'; may be repeated, the first that matches counts",
     ValueForm::list, kChangesAtOnce<&Config::mirrors>,
     add_exception<&Config::mirrors, parse_mirror_exception>,
     [](Config& c) { c.mirrors.exceptions.clear(); }, "mirror-stream"},
    {"stream_priorities", "STREAM=PRIORITY",
     "how samples of some streams are sent to other hosts: with high, normal or low priority, and "
     "how much of the network their history takes at most, e.g. 'encoder*=high' or "
     "'camera*=low 30%'; may be repeated, the first that matches counts; default: high for samples "
     "below 16 KiB, else normal",
     ValueForm::list, kChangesAtOnce<&Config::sending>,
     add_exception<&Config::sending, parse_sending_exception>,
     [](Config& c) { c.sending.exceptions.clear(); }, "stream-priority"},
    {"clock_policy", "POLICY",
     "what to do with streams of hosts whose clocks may be too far from this one's: enforce (not "
     "open them, and answer reads by time with an error), mark (flag their samples) or off; "
     "default: enforce",
     ValueForm::text, kChangesAtOnce<&Config::clocks>,
     [](Config& c, std::string_view text) {
       return take(c.clocks.general.policy, parse_clock_policy(text));
     }},
    {"clock_limit", "TIME", "how far two hosts' clocks may be apart; default: 1500 us",
     ValueForm::text, kChangesAtOnce<&Config::clocks>,
     [](Config& c, std::string_view text) {
       return take(c.clocks.general.limit, parse_clock_limit(text));
     }},
    {"clock_streams", "STREAM=POLICY",
     "another policy, and limit, for some streams, e.g. 'gps=off' or 'camera*=mark 5 ms'; may be "
     "repeated, the first that matches counts",
     ValueForm::list, kChangesAtOnce<&Config::clocks>,
     add_exception<&Config::clocks, parse_clock_exception>,
     [](Config& c) { c.clocks.exceptions.clear(); }, "clock-stream"},
    {"max_drift", "PPM", "highest drift of this PC's free-running clock; default: 50 ppm",
     ValueForm::text, kChangesAtOnce<&Config::max_drift>, set_by<&Config::max_drift, parse_drift>},
    {"chronyd", "ADDR:PORT",
     "address of this PC's chronyd (cmdport in chrony.conf); default: 127.0.0.1:323",
     ValueForm::text, kChangesAtRestart<&Config::chronyd>, set_chronyd},
};

std::string place(const std::string& path, const toml::source_region& source) {
  return fmt::format("{}:{}: ", path, source.begin.line);
}

const char* words_for(ValueForm form) noexcept {
  switch (form) {
    case ValueForm::text:
      return "a text in quotes";
    case ValueForm::integer:
      return "a whole number";
    case ValueForm::integer_or_text:
      return "a whole number or a text in quotes";
    case ValueForm::boolean:
      return "true or false";
    case ValueForm::list:
      return "a list of texts in quotes";
  }
  return "";
}

// The value as its flag takes it.
//   fails  invalid_argument: another type
Result<std::string> text_of(const toml::node& node, ValueForm form) {
  const bool takes_text = form == ValueForm::text || form == ValueForm::integer_or_text;
  const bool takes_integer = form == ValueForm::integer || form == ValueForm::integer_or_text;
  if (takes_text && node.is_string()) return node.as_string()->get();
  if (takes_integer && node.is_integer()) return std::to_string(node.as_integer()->get());
  if (form == ValueForm::boolean && node.is_boolean()) {
    return std::string(node.as_boolean()->get() ? "true" : "false");
  }
  std::string type = "another type";
  if (node.is_string()) type = "a text";
  if (node.is_integer()) type = "a whole number";
  if (node.is_floating_point()) type = "a number with a point";
  if (node.is_boolean()) type = "true or false";
  if (node.is_array()) type = "a list";
  if (node.is_table()) type = "a table";
  return Error{Errc::invalid_argument, type + " instead of " + words_for(form)};
}

Result<void> set_list(Config& config, const ConfigKey& key, const toml::node& node) {
  if (!node.is_array()) return text_of(node, ValueForm::list).error();
  key.clear(config);
  for (const toml::node& element : *node.as_array()) {
    const std::string text = DSSM_TRY(text_of(element, ValueForm::text));
    DSSM_TRY(key.set(config, text));
  }
  return {};
}

Result<void> set_value(Config& config, const ConfigKey& key, const toml::node& node) {
  if (key.form == ValueForm::list) return set_list(config, key, node);
  const Result<std::string> text = text_of(node, key.form);
  return text ? key.set(config, *text) : text.error();
}

std::string unknown_key(std::string_view name) {
  std::string known;
  for (const ConfigKey& key : kKeys) known.append(known.empty() ? "" : ", ").append(key.name);
  return fmt::format("key '{}': unknown; the keys are {}", printable(name), known);
}

const ConfigKey* find_key(std::string_view name) {
  const auto key = std::find_if(std::begin(kKeys), std::end(kKeys),
                                [&](const ConfigKey& k) { return k.name == name; });
  return key == std::end(kKeys) ? nullptr : key;
}

struct Mistake {
  toml::source_index line;
  std::string text;
};

Result<toml::table> parse_toml(std::string_view text, const std::string& path) {
  // toml::parse() throws.
  try {
    return toml::parse(text, path);
  } catch (const toml::parse_error& error) {
    return Error{Errc::invalid_argument,
                 place(path, error.source()) + std::string(error.description()) +
                     "; texts are in quotes, as in name = \"pc1\", and lists in brackets"};
  }
}

}  // namespace

std::uint64_t Config::half_of_the_machines_memory() noexcept {
  const std::uint64_t half = memory_of_the_machine() / 2;
  return half > 0 ? half : 1ULL << 30;
}

std::vector<std::string> Config::interfaces_between_programs() {
  return {"docker*", "veth*", "br-*", "virbr*",     "lxc*", "lxdbr*",
          "tun*",    "tap*",  "wg*",  "tailscale*", "zt*",  "vmnet*"};
}

std::span<const ConfigKey> config_keys() noexcept { return kKeys; }

std::string ConfigKey::flag() const {
  std::string flag = "--" + std::string(flag_name.empty() ? name : flag_name);
  std::replace(flag.begin(), flag.end(), '_', '-');
  return flag;
}

Result<void> apply_text_untrusted(Config& config, std::string_view text, const std::string& path) {
  if (!is_utf8(text)) {
    return Error{Errc::invalid_argument, path + ": the file is not UTF-8 text"};
  }
  const toml::table table = DSSM_TRY(parse_toml(text, path));
  std::vector<Mistake> mistakes;
  for (const auto& [name, node] : table) {
    const toml::source_region where = name.source();
    const auto mistake = [&](const std::string& why) {
      mistakes.push_back({where.begin.line, place(path, where) + why});
    };
    const ConfigKey* key = find_key(name.str());
    if (!key) {
      mistake(unknown_key(name.str()));
      continue;
    }
    const Result<void> set = set_value(config, *key, node);
    if (!set) mistake(fmt::format("key {}: {}", in_quotes(key->name), set.error().message));
  }
  if (mistakes.empty()) return {};
  std::stable_sort(mistakes.begin(), mistakes.end(),
                   [](const Mistake& a, const Mistake& b) { return a.line < b.line; });
  std::string all;
  for (const Mistake& mistake : mistakes) all.append(all.empty() ? "" : "\n").append(mistake.text);
  return Error{Errc::invalid_argument, all};
}

Result<void> apply_file(Config& config, const std::string& path) {
  const std::string what = "read the configuration '" + path + "'";
  const UniqueFd fd(::open(path.c_str(), O_RDONLY | O_CLOEXEC));
  if (!fd) return os_error(what);
  std::string text;
  for (;;) {
    char buffer[16384];
    const ssize_t got = ::read(fd.get(), buffer, sizeof buffer);
    if (got < 0) return os_error(what);
    if (got == 0) break;
    text.append(buffer, static_cast<std::size_t>(got));
    if (text.size() > kMaxFileBytes) {
      return Error{Errc::invalid_argument, what + ": it is larger than 1 MiB"};
    }
  }
  return apply_text_untrusted(config, text, path);
}

Result<void> finish(Config& config) {
  if (config.max_clients_per_user == 0) config.max_clients_per_user = (config.max_clients + 1) / 2;
  DSSM_TRY(check_secure(config));
  if (config.name.empty()) DSSM_TRY(take_name_of_machine(config));
  return load_credentials(config);
}

}  // namespace dssm::daemon
