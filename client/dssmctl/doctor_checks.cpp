// SPDX-License-Identifier: Apache-2.0
//
// One function per check. Texts of other hosts are used as they came; doctor.cpp escapes them when
// it prints.
#include <fmt/format.h>

#include <algorithm>
#include <map>
#include <set>
#include <string_view>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/doctor.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

using Status = Finding::Status;
using Findings = std::vector<Finding>;

constexpr std::uint64_t kMebibyte = 1U << 20;
// With less, systemd refuses to reload its units, and so does a restart after an upgrade.
constexpr std::uint64_t kMinRunBytes = 16 * kMebibyte;
constexpr std::uint64_t kDescriptorsPerStream = 4;  // of dssmd
// What dssmd has open beside its streams: its own, and a few programs and hosts. A guess.
constexpr std::uint64_t kOtherDescriptors = 200;
constexpr Duration kRenewBefore = std::chrono::hours(24 * 30);
constexpr const char* kUsualConfigFile = "/etc/dssm/dssmd.conf";
constexpr std::string_view kUsualPort = "13776";
constexpr const char* kNotEncrypted =
    "every PC in that network can then read and write all streams; with credentials "
    "(docs/security.md) only those of the vehicle";
constexpr const char* kDefaultGroup = "dssm";

// Starts one of Debian's own services, in a container too.
std::string start_command(const Facts& facts, const std::string& service) {
  return facts.systemd ? fmt::format("sudo systemctl enable --now {}", service)
                       : fmt::format("sudo service {} start", service);
}

struct Setting {
  std::string_view key;
  std::string value;  // as in TOML
  std::string flag;
};

// Gives the keys of a host's configuration file these values, and restarts its dssmd.
std::string configure(const std::string& file, const std::vector<Setting>& settings) {
  std::string insertions, deletions;
  for (const Setting& one : settings) {
    insertions += fmt::format(" -e '1i {} = {}'", one.key, one.value);
    deletions += fmt::format(" -e '/^{} *=/d'", one.key);
  }
  return fmt::format(
      "sudo sed -i{}{} {file} && dssmd --config {file} --check-config && sudo systemctl restart "
      "dssmd",
      insertions, deletions, fmt::arg("file", file));
}

// The same on this PC, where dssmd may be started without a file. `note`: a comment for the user.
std::string configure_here(const Facts& facts, const std::vector<Setting>& settings,
                           const std::string& note) {
  if (!facts.daemon.config_file.empty()) {
    return configure(facts.daemon.config_file, settings) + (note.empty() ? "" : "  # " + note);
  }
  std::string flags;
  for (const Setting& one : settings) flags += one.flag.empty() ? "" : " " + one.flag;
  return fmt::format("kill {} && dssmd{} &  # with the other flags that it had{}", facts.daemon.pid,
                     flags, note.empty() ? "" : "; " + note);
}

const char* config_file(const Facts& facts) {
  return facts.daemon.config_file.empty() ? kUsualConfigFile : facts.daemon.config_file.c_str();
}

// Gives a host another name than `name`.
std::string rename_command(const std::string& name) {
  return configure(kUsualConfigFile, {{"name", fmt::format("\"{}-2\"", name), ""}});
}

// --- dssmd

Finding no_permission(const Facts& facts) {
  const SocketFacts& socket = facts.socket;
  const std::string group = socket.group.empty() ? kDefaultGroup : socket.group;
  const auto found = [&](const std::string& cause, const std::string& command) {
    return Finding{"daemon", Status::fail, facts.failed->message, cause, command};
  };
  if (socket.process_in_group) {
    return found(
        fmt::format("the socket or its folder shuts out even its group '{}'", group),
        fmt::format("ls -l {}  # see the key socket_mode in {}", socket.path, kUsualConfigFile));
  }
  if (socket.user_in_group) {
    return found(fmt::format("user '{}' joined the group '{}', but not before this login",
                             facts.user, group),
                 fmt::format("newgrp {}  # or log in again", group));
  }
  // Its members may change files of the system: it is not a group to join for this.
  if (group == "root") {
    return found(
        "root started dssmd without --socket-group, so only root may use it",
        fmt::format("sudo groupadd --force --system {0}; sudo usermod -aG {0} {1}  # then log "
                    "in again, and start dssmd with --socket-group {0}",
                    kDefaultGroup, facts.user));
  }
  return found(fmt::format("user '{}' is not in the socket's group '{}'", facts.user, group),
               fmt::format("sudo usermod -aG {} {}  # then log in again", group, facts.user));
}

Finding no_daemon(const Facts& facts) {
  const SocketFacts& socket = facts.socket;
  const auto found = [&](const std::string& cause, const std::string& command) {
    return Finding{"daemon", Status::fail, facts.failed->message, cause, command};
  };
  if (socket.kind == SocketFacts::Kind::something_else) {
    return found(fmt::format("'{}' is there, but is not a socket", socket.path),
                 fmt::format("ls -l {}  # then correct --socket or $DSSM_SOCKET", socket.path));
  }
  if (socket.chosen) {
    return found(
        "no dssmd runs for the socket that --socket or $DSSM_SOCKET names",
        "unset DSSM_SOCKET  # for the usual one, and leave out --socket; or start that dssmd");
  }
  if (facts.service == "failed") {
    return found("dssmd could not start or crashed",
                 "journalctl -u dssmd -n 50  # shows the reason; then: systemctl restart dssmd");
  }
  if (facts.service == "active") {
    return found("dssmd runs, but listens elsewhere (key runtime_dir)",
                 fmt::format("grep runtime_dir {}  # then set $DSSM_SOCKET", kUsualConfigFile));
  }
  return found("dssmd is not running",
               facts.systemd ? "sudo systemctl enable --now dssmd"
                             : "dssmd  # in a terminal of its own: no systemd runs here");
}

Finding unanswered(const Facts& facts) {
  switch (facts.failed->code) {
    case Errc::no_permission:
      return no_permission(facts);
    case Errc::no_daemon:
      return no_daemon(facts);
    case Errc::protocol:
      return {"daemon", Status::fail, facts.failed->message,
              "dssmd and dssmctl are of different versions, or something else listens there",
              "sudo systemctl restart dssmd  # after an upgrade of DSSM"};
    case Errc::invalid_argument:
      return {"daemon", Status::fail, facts.failed->message, "the socket's path cannot be right",
              "unset DSSM_SOCKET  # or correct --socket"};
    default:
      return {"daemon", Status::fail, facts.failed->message, "dssmd hangs, or just ended",
              "journalctl -u dssmd -n 50  # then: sudo systemctl restart dssmd"};
  }
}

Finding check_daemon(const Facts& facts) {
  if (facts.failed) return unanswered(facts);
  return {"daemon", Status::ok,
          fmt::format("dssmd (pid {}) answers at '{}' as host '{}'", facts.daemon.pid,
                      facts.socket.path, facts.daemon.host)};
}

Finding check_version(const Facts& facts) {
  if (facts.daemon.version != facts.version) {
    return {"version", Status::warn,
            fmt::format("dssmd is {}, dssmctl is {}", facts.daemon.version, facts.version),
            "dssmd was not restarted after an upgrade, or comes from elsewhere",
            "sudo systemctl restart dssmd"};
  }
  std::vector<std::string> others;
  for (const HostInfo& host : facts.hosts) {
    if (host.state != HostState::up || host.version == facts.version) continue;
    others.push_back(fmt::format("{} has {}", host.name, host.version));
  }
  if (others.empty()) {
    return {
        "version", Status::ok,
        fmt::format("dssmd and dssmctl are both {} and speak the same protocol", facts.version)};
  }
  return {"version", Status::warn,
          fmt::format("this PC has {}, {}", facts.version, fmt::join(others, ", ")),
          "not all hosts were upgraded",
          "dssmctl hosts  # then install the same version of DSSM on each"};
}

// --- this PC

Finding check_memory(const Facts& facts) {
  const DaemonInfo& daemon = facts.daemon;
  const MemoryFacts& machine = facts.memory;
  Finding finding{
      "memory", Status::ok,
      fmt::format("rings take {} of the {} that are allowed", bytes_text(daemon.memory_bytes),
                  bytes_text(daemon.memory_limit_bytes))};
  const std::uint64_t left =
      daemon.memory_limit_bytes - std::min(daemon.memory_limit_bytes, daemon.memory_bytes);
  if (left < daemon.memory_limit_bytes / 10) {
    finding.warn("streams with long histories; soon no further one can be created",
                 fmt::format("dssmctl ls --sort memory  # rm what is not needed, or raise "
                             "max_memory in {}",
                             config_file(facts)));
  } else if (machine.total_bytes > 0 && machine.available_bytes < left &&
             machine.available_bytes < machine.total_bytes / 20) {
    finding.text +=
        fmt::format(", but this PC has only {} left", bytes_text(machine.available_bytes));
    finding.warn("other programs took the memory",
                 "ps -eo rss,comm --sort=-rss | head  # end what is not needed");
  }
  return finding;
}

void check_descriptors(const Facts& facts, Findings& findings) {
  const std::uint64_t limit = facts.descriptors.soft_limit;
  if (limit == 0) return;  // dssmd is in another container: not known here
  const std::uint64_t taken = facts.daemon.streams * kDescriptorsPerStream;
  Finding finding{"descriptors", Status::ok,
                  fmt::format("dssmd may open {} files; its streams take about {}", limit, taken)};
  if (taken + kOtherDescriptors > limit - limit / 5) {
    finding.warn("the limit on open files is too low for many more streams",
                 "sudo mkdir -p /etc/systemd/system/dssmd.service.d && printf "
                 "'[Service]\\nLimitNOFILE=1048576\\n' | sudo tee "
                 "/etc/systemd/system/dssmd.service.d/files.conf && sudo systemctl daemon-reload "
                 "&& sudo systemctl restart dssmd");
  }
  findings.push_back(std::move(finding));
}

void check_disks(const Facts& facts, Findings& findings) {
  for (const DiskFacts& disk : facts.disks) {
    Finding finding{
        "disk " + disk.path, Status::ok,
        fmt::format("{} of {} free", bytes_text(disk.free_bytes), bytes_text(disk.total_bytes))};
    // dssmd itself needs some pages of /run, whose size is a part of the memory's.
    const bool is_short = disk.path == "/run" ? disk.free_bytes < kMinRunBytes
                                              : disk.free_bytes < disk.total_bytes / 20 ||
                                                    disk.free_bytes < 100 * kMebibyte;
    if (is_short) {
      finding.warn("logs and recordings fill disks", disk.path == "/run"
                                                         ? "du -xh -d 2 /run | sort -h | tail"
                                                         : "sudo journalctl --vacuum-size=200M");
    }
    findings.push_back(std::move(finding));
  }
}

std::string restart_chrony(const Facts& facts) {
  return facts.systemd ? "sudo systemctl restart chrony" : "sudo service chrony restart";
}

// By chronyc alone, while dssmd does not answer.
Finding check_chronyd(const Facts& facts) {
  const auto with_detail = [&](const char* text) {
    return facts.clock.detail.empty() ? text : fmt::format("{} ({})", text, facts.clock.detail);
  };
  switch (facts.clock.state) {
    case ClockFacts::State::no_answer:
      return {"clock", Status::warn, with_detail("chronyd does not answer"),
              "chronyd is not running", restart_chrony(facts)};
    case ClockFacts::State::unsynchronized:
      return {"clock", Status::warn, with_detail("chronyd does not know the time"),
              "it was just started, or no source answers", "chronyc sources"};
    case ClockFacts::State::synchronized:
      return {"clock", Status::ok, with_detail("chronyd keeps this clock")};
    case ClockFacts::State::no_chrony:
      break;
  }
  return {"clock", Status::warn, "chrony is not installed",
          "nothing keeps this clock and the others together; when they are too far apart, reads "
          "by time of the others' streams are refused",
          "sudo apt install chrony"};
}

struct Advice {
  std::string cause, command;
};

// What helps a clock that is not good. `where`: "", or "on pc2: ".
Advice clock_advice(const Facts& facts, const ClockSnapshot& clock, bool serves,
                    const std::string& where) {
  const Duration offset = std::chrono::abs(clock.offset);
  switch (clock.reason) {
    case ClockReason::no_chronyd:
    case ClockReason::silent:
      return {where + (where.empty() ? "" : "chrony is not installed, or ") +
                  "chronyd is not running, hangs, or its cmdport is closed",
              restart_chrony(facts)};
    case ClockReason::unsynchronized:
      if (serves) {
        return {where +
                    "chronyd lost the set-up of a PC that serves its clock ('local stratum'), "
                    "as after a crash",
                restart_chrony(facts)};
      }
      return {where + "chronyd was just started, or no source answers",
              "chronyc sources  # then correct 'server' lines in /etc/chrony"};
    case ClockReason::stepped:
      return {where + "a program set the clock, or chronyd did",
              "dssmctl clock --wait 60  # chronyd has to measure it some times again"};
    case ClockReason::too_far:
      if (2 * offset > clock.bound) {
        return {fmt::format("{}the clock is {} off, which chronyd slews away", where,
                            duration_text(offset)),
                "sudo chronyc makestep  # or wait"};
      }
      return {where + "chronyd has no near source, or has not heard it for long",
              "chronyc sources  # and chronyc ntpdata: which source, how far, since when"};
    case ClockReason::none:
      break;
  }
  return {where + "dssmd or chronyd was just started", "dssmctl clock --wait 60"};
}

bool follows(const HostInfo& host, const HostInfo& other) {
  return host.state == HostState::up && !other.name.empty() && host.clock_reference == other.name;
}

// Those whose clocks follow that host's.
std::vector<std::string> followers(const Facts& facts, const HostInfo& of) {
  std::vector<std::string> names;
  for (const HostInfo& host : facts.hosts) {
    if (follows(host, of)) names.push_back(host.name);
  }
  return names;
}

std::string good_clock_text(const Facts& facts, const HostInfo& self) {
  const ClockSnapshot& clock = *self.clock;
  if (clock.basis == ClockBasis::own) {
    const std::vector<std::string> names = followers(facts, self);
    return names.empty() ? "this PC is the fleet's reference; no other PC's clock follows it now"
                         : "this PC is the fleet's reference; other PCs' clocks follow it: " +
                               list_text(names);
  }
  return fmt::format("at most {} from {}; chronyd follows '{}'", bound_text(clock.bound),
                     clock.basis == ClockBasis::reference ? "the fleet's reference" : "UTC",
                     self.clock_reference);
}

// The samples of other PCs, while this PC's clock is not good: dssmd also measures the clocks of
// two PCs against each other, and that may be enough.
std::string effect_on_reads(const Facts& facts) {
  const std::string& policy = facts.daemon.clock_policy;
  const bool refuses = policy == dssm::name_of(ClockPolicy::enforce);
  if (!refuses && policy != dssm::name_of(ClockPolicy::mark)) return "";
  std::vector<std::string> good, bad;
  for (const HostInfo& host : facts.hosts) {
    if (host.state == HostState::up) (host.clock_reason.empty() ? good : bad).push_back(host.name);
  }
  if (bad.empty() && !good.empty()) {
    return fmt::format(
        "; the times of the samples of {} are good here, for as long as what is "
        "measured between the PCs proves it",
        list_text(good));
  }
  const std::string until = bad.empty() ? "; unless what is measured between two PCs is enough, "
                                        : "; until it is good, ";
  const std::string whose = bad.empty() ? "other PCs" : list_text(bad);
  if (!refuses) return until + "the times of the samples of " + whose + " are marked as bad";
  return fmt::format(
      "{}streams of {} are not opened here; with clock_policy = \"mark\" in {} they are, and their "
      "times are marked as bad",
      until, whose,
      facts.daemon.config_file.empty() ? "a file for `dssmd --config`" : facts.daemon.config_file);
}

// As dssmd uses it. It is an error when reads by time fail for it: a PC without others has none.
Finding check_clock(const Facts& facts) {
  if (facts.failed || facts.hosts.empty() || !facts.hosts.front().clock) {
    return check_chronyd(facts);
  }
  const HostInfo& self = facts.hosts.front();
  const ClockSnapshot& clock = *self.clock;
  if (is_good(clock)) {
    Finding finding{"clock", Status::ok, good_clock_text(facts, self)};
    if (clock.status == ClockStatus::holdover) {
      finding.text += fmt::format("; chronyd has not measured for {}", duration_text(clock.age));
      finding.warn("the PC that it follows is off, or its packets do not arrive",
                   "chronyc sources");
    }
    return finding;
  }
  Finding finding{"clock", Status::ok, status_text(clock)};
  if (clock.bound != kUnknownClockError) {
    finding.text += fmt::format("; it may be {} off", bound_text(clock.bound));
  }
  if (facts.clock.state == ClockFacts::State::synchronized && !facts.clock.detail.empty()) {
    finding.text += fmt::format("; chronyc reports that chronyd follows {}", facts.clock.detail);
  }
  const bool serves = facts.clock.serves || !followers(facts, self).empty();
  Advice advice = clock_advice(facts, clock, serves, "");
  if (facts.clock.state == ClockFacts::State::no_chrony &&
      clock.reason == ClockReason::no_chronyd) {
    advice = {"chrony is not installed", "sudo apt install chrony"};
  }
  finding.text += effect_on_reads(facts);
  const bool refused = std::any_of(facts.hosts.begin(), facts.hosts.end(),
                                   [](const HostInfo& host) { return host.clock_refused; });
  if (refused) {
    finding.fail(std::move(advice.cause), std::move(advice.command));
  } else {
    finding.warn(std::move(advice.cause), std::move(advice.command));
  }
  return finding;
}

// --- the others

// Of an address as dssmd writes it: "127.0.0.1:13776", "[::1]:13776", "localhost:13776".
bool on_loopback(const std::string& address) {
  return address.starts_with("127.") || address.starts_with("[::1]") ||
         address.starts_with("[::ffff:127.") || address.starts_with("localhost:");
}

bool is_other_pc(const HostInfo& host) {
  if (host.state == HostState::self) return false;
  // Found but closed: its announcement comes from outside, or it would have an address.
  return host.addresses.empty() ||
         !std::all_of(host.addresses.begin(), host.addresses.end(), on_loopback);
}

std::string name_of(const HostInfo& host) {
  if (!host.name.empty()) return host.name;
  return host.addresses.empty() ? "without a name" : host.addresses.front();
}

// "10.0.0.2" of "10.0.0.2:13776", "fe80::1%eth0" of "[fe80::1%eth0]:13776".
std::string without_port(const std::string& address) {
  if (address.starts_with('[')) return address.substr(1, address.find(']') - 1);
  return address.substr(0, address.find(':'));
}

// "13776" of "10.0.0.2:13776".
std::string port_of(const std::string& address) {
  const std::size_t colon = address.rfind(':');
  const bool has_port = colon != std::string::npos && address.find(']', colon) == std::string::npos;
  return has_port ? address.substr(colon + 1) : std::string(kUsualPort);
}

// Lets others in, without encryption unless there are credentials.
std::vector<Setting> listen_settings(const std::string& port, bool has_credentials) {
  std::vector<Setting> settings{
      {"listen", fmt::format("[\"0.0.0.0:{}\"]", port), fmt::format("--listen 0.0.0.0:{}", port)}};
  if (!has_credentials) settings.push_back({"insecure", "true", "--insecure"});
  return settings;
}

void check_listening(const Facts& facts, Findings& findings) {
  if (facts.hosts.empty()) return;
  const std::vector<std::string>& own = facts.hosts.front().addresses;
  const bool closed = std::all_of(own.begin(), own.end(), on_loopback);
  const bool others = std::any_of(facts.hosts.begin(), facts.hosts.end(), is_other_pc);
  const bool has_credentials = facts.daemon.credentials.has_value();
  const std::string port = own.empty() ? std::string(kUsualPort) : port_of(own.front());
  Finding finding{"listening", Status::ok,
                  own.empty() ? "nowhere for other hosts" : "at " + list_text(own)};
  if (closed && !own.empty()) finding.text += ", for programs of this PC only";
  if (closed && others) {
    finding.warn("other PCs cannot reach this one: it listens for programs of this PC only",
                 configure_here(facts, listen_settings(port, has_credentials),
                                has_credentials ? "" : kNotEncrypted));
  }
  findings.push_back(std::move(finding));
}

// Nothing when no other PC can connect.
void check_encryption(const Facts& facts, Findings& findings) {
  const bool insecure = !facts.hosts.empty() && facts.hosts.front().insecure;
  if (!facts.daemon.credentials) {
    if (!insecure) return;
    findings.push_back({"encryption", Status::warn, "nothing is encrypted (insecure = true)",
                        "every host that reaches this one can read and write its streams",
                        "dssmctl pki --help  # makes credentials, see docs/security.md"});
    return;
  }
  const CredentialsInfo& own = *facts.daemon.credentials;
  Finding finding{"encryption", Status::ok,
                  fmt::format("with the certificate of {}, {}", own.name, validity_text(own))};
  const std::string renew = fmt::format(
      "dssmctl pki renew {}  # at the authority, then pki install here", facts.daemon.host);
  if (!own.problem.empty()) {
    finding.status = Status::fail;
    finding.cause = own.problem;
    finding.command = renew;
  } else if (own.valid_until - WallClock::now() < kRenewBefore) {
    finding.warn("it ends soon", renew);
  } else if (insecure) {
    finding.warn(
        "connections that are not encrypted are taken, too",
        configure_here(facts, {{"insecure", "false", ""}},
                       "without --insecure or insecure = true, when all have credentials"));
  }
  findings.push_back(std::move(finding));
}

Finding mdns_waiting(const Facts& facts) {
  const std::string& error = facts.daemon.mdns.error;
  Finding finding{"mdns", Status::warn, "waits for Avahi" + (error.empty() ? "" : ": " + error)};
  if (!facts.avahi_installed) {
    finding.warn("avahi-daemon is not installed; only configured peers are found",
                 "sudo apt install avahi-daemon");
  } else if (!facts.avahi_running) {
    finding.warn("avahi-daemon is not running; only configured peers are found",
                 start_command(facts, "avahi-daemon"));
  } else {
    finding.warn("avahi-daemon runs, but dssmd does not reach it over D-Bus",
                 "systemctl status dbus avahi-daemon  # then restart what failed");
  }
  return finding;
}

Finding check_mdns(const Facts& facts) {
  const MdnsInfo& mdns = facts.daemon.mdns;
  if (mdns.phase == MdnsPhase::off) {
    return {"mdns", Status::ok, "off: only configured peers are found"};
  }
  if (mdns.phase == MdnsPhase::waiting) return mdns_waiting(facts);

  const bool others_up = std::any_of(
      facts.hosts.begin(), facts.hosts.end(),
      [](const HostInfo& host) { return host.state == HostState::up && is_other_pc(host); });
  Finding finding{"mdns", Status::ok,
                  fmt::format("{}, {} announced, {} other hosts heard", mdns.avahi_version,
                              mdns.announced, mdns.hosts_heard)};
  if (!mdns.error.empty()) finding.text += ": " + mdns.error;
  if (mdns.withheld > 0) {
    finding.text += fmt::format("; {} not announced", mdns.withheld);
    finding.warn("beyond Avahi's limits, or refused by it; these streams open by NAME@HOST still",
                 "grep objects-per /etc/avahi/avahi-daemon.conf  # raise the limits there");
  } else if (!mdns.own_host_seen) {
    finding.text += "; this host's own announcement is not visible";
    finding.warn("avahi-daemon was just started, or does not publish or use any interface",
                 "avahi-browse -rt _dssm._tcp  # see /etc/avahi/avahi-daemon.conf");
  } else if (mdns.hosts_heard == 0 && others_up) {
    finding.warn("the network or a firewall drops multicast: others are up, none is heard",
                 "sudo ufw allow 5353/udp  # on each host; or list all hosts in peers");
  } else if (!mdns.error.empty()) {
    finding.warn("Avahi refused something", "journalctl -u avahi-daemon -n 50");
  }
  return finding;
}

Finding host_down(const HostInfo& host) {
  const std::string where =
      host.addresses.empty() ? host.name : without_port(host.addresses.front());
  const auto found = [&](const std::string& cause, const std::string& command) {
    return Finding{"host " + name_of(host), Status::fail, "down: " + host.error, cause, command};
  };
  switch (host.reason) {
    case HostReason::connection_refused:
      return found("no dssmd runs there, or it listens at another address or port",
                   "systemctl status dssmd  # there; and check its key listen");
    case HostReason::no_greeting:
      return found("the dssmd there hangs, or another program has its port",
                   "ss -ltnp  # there; then: systemctl restart dssmd");
    case HostReason::name_not_found:
      return found(
          "its name is not known here",
          fmt::format("getent hosts {}  # then correct peers, or give an address there", where));
    default:
      return found(
          "it is off, the cable is out, or a firewall is in between",
          fmt::format("ping -c 3 {}  # it answers: open TCP port {} in its firewall", where,
                      host.addresses.empty() ? kUsualPort : port_of(host.addresses.front())));
  }
}

Finding host_refused(const HostInfo& host) {
  const auto found = [&](const std::string& cause, const std::string& command) {
    return Finding{"host " + name_of(host), Status::fail, "refused: " + host.error, cause, command};
  };
  switch (host.reason) {
    case HostReason::duplicate:
      return found("one PC's disk was copied to the other, or two dssmd of this PC have one name",
                   "sudo rm /etc/machine-id && sudo systemd-machine-id-setup && " +
                       rename_command(host.name) +
                       "  # on the copy; two dssmd of one PC need "
                       "different names only");
    case HostReason::namesake:
      return found("both hosts have the same name",
                   rename_command(host.name) + "  # on one of them");
    default:
      return found(
          "the two do not fit together: certificates, versions, names or limits",
          "dssmctl hosts  # shows the reason; a certificate or TLS: `dssmctl pki show` on both; "
          "a version: install the same version of DSSM on both");
  }
}

// Found by mDNS, but the keys of one of both PCs do not allow the connection.
Finding host_closed(const Facts& facts, const HostInfo& host) {
  Finding finding{"host " + name_of(host), Status::ok,
                  "found by mDNS, but not connected to: " + host.error};
  if (host.reason == HostReason::closed_here) {
    finding.warn("the key insecure of this PC does not let its dssmd connect to others",
                 configure_here(facts, {{"insecure", "true", "--insecure"}}, kNotEncrypted));
  } else {
    finding.warn(
        "its keys listen and insecure do not let others in",
        configure(kUsualConfigFile, listen_settings(std::string(kUsualPort), false)) + "  # there");
  }
  return finding;
}

// What is wrong with this host mostly concerns another one too, and is reported there.
void check_own_host(const Facts& facts, const HostInfo& self, Findings& findings) {
  if (self.reason == HostReason::none) return;
  const bool is_reported =
      std::any_of(facts.hosts.begin(), facts.hosts.end(), [&](const HostInfo& other) {
        return other.state != HostState::self && other.reason == self.reason;
      });
  if (is_reported) return;
  findings.push_back({"host " + name_of(self), Status::fail, self.error,
                      "another host has this one's name, and is refused for that",
                      "dssmctl hosts  # shows where; see 'host names'"});
}

// `also_up`: the same host is up at another address.
Finding host_finding(const Facts& facts, const HostInfo& host, bool also_up) {
  const std::string name = "host " + name_of(host);
  const std::string addresses = list_text(host.addresses);
  if (host.state == HostState::up) {
    const std::string warning = host.error.empty() ? "" : ": " + host.error;
    return {name, Status::ok, fmt::format("up at {}{}", addresses, warning)};
  }
  if (host.state == HostState::refused) return host_refused(host);
  if (also_up) {
    return {name, Status::ok,
            fmt::format("also at {}, which is not used: {}", addresses,
                        host.error.empty() ? dssm::name_of(host.state) : host.error)};
  }
  if (host.state == HostState::connecting) {
    return {name, Status::warn, "being connected to", "dssmd or the network has just come up",
            "dssmctl hosts"};
  }
  return host.state == HostState::closed ? host_closed(facts, host) : host_down(host);
}

void check_hosts(const Facts& facts, Findings& findings) {
  std::set<std::string> up;  // ids
  for (const HostInfo& host : facts.hosts) {
    if (is_up(host.state)) up.insert(host.id);
  }
  for (const HostInfo& host : facts.hosts) {
    if (host.state == HostState::self) {
      check_own_host(facts, host, findings);
    } else {
      findings.push_back(host_finding(facts, host, !host.id.empty() && up.contains(host.id)));
    }
  }
}

bool has_clock_to_check(const HostInfo& host) {
  if (host.state != HostState::up || (!host.clock && host.clock_reason.empty())) return false;
  return is_other_pc(host) || !host.clock_reason.empty();
}

// Why another PC's clock and this one's are too far apart although each of them seems good: one of
// them may differ from all others.
std::string disagreement_text(const Facts& facts) {
  std::vector<std::string> agree, disagree;
  for (const HostInfo& host : facts.hosts) {
    if (!has_clock_to_check(host)) continue;
    (host.clock_reason.empty() ? agree : disagree).push_back(name_of(host));
  }
  if (!agree.empty() && disagree.size() == 1) {
    return fmt::format("only the clock of {} disagrees with this PC's; these agree with it: {}",
                       disagree[0], list_text(agree));
  }
  if (agree.empty() && disagree.size() > 1) {
    return fmt::format("the clocks of all others ({}) disagree with this PC's",
                       list_text(disagree));
  }
  return "the two follow different clocks, or the network delays packets";
}

// Whether reads by time of the other PCs' samples succeed here, by what readers themselves use.
void check_fleet_clocks(const Facts& facts, Findings& findings) {
  for (const HostInfo& host : facts.hosts) {
    if (!has_clock_to_check(host)) continue;
    Finding finding{"clock of " + name_of(host), Status::ok,
                    fmt::format("at most {} from this one's", bound_text(host.clock_distance))};
    if (!host.clock_reason.empty()) {
      finding.text =
          fmt::format("reads of its samples by time are {}: {}",
                      host.clock_refused ? "refused" : "marked as bad", host.clock_reason);
      const std::optional<ClockSnapshot>& own = facts.hosts.front().clock;
      Advice advice{disagreement_text(facts),
                    "chronyc sources  # here and there: both have to follow one reference"};
      if (host.clock && !is_good(*host.clock)) {
        advice = clock_advice(facts, *host.clock, !followers(facts, host).empty(),
                              fmt::format("on {}: ", name_of(host)));
        const bool has_note = advice.command.find("  # ") != std::string::npos;
        advice.command += fmt::format("{} on {}", has_note ? ";" : "  #", name_of(host));
      } else if (own && !is_good(*own)) {
        advice = clock_advice(facts, *own,
                              facts.clock.serves || !followers(facts, facts.hosts.front()).empty(),
                              "on this PC: ");
      }
      finding.warn(std::move(advice.cause), std::move(advice.command));
      if (host.clock_refused) finding.status = Status::fail;
    }
    findings.push_back(std::move(finding));
  }
}

Finding check_host_names(const Facts& facts) {
  std::map<std::string, std::set<std::string>> ids;  // by name
  for (const HostInfo& host : facts.hosts) {
    if (host.name.empty() || host.id.empty()) continue;
    ids[host.name].insert(host.id);
    // A copied PC, or a second dssmd on this one, has the same id.
    if (host.reason == HostReason::duplicate) ids[host.name].insert("duplicate");
  }
  std::vector<std::string> shared;
  std::string first;
  for (const auto& [name, of_name] : ids) {
    if (of_name.size() == 1) continue;
    if (first.empty()) first = name;
    shared.push_back(fmt::format("'{}'", name));
  }
  if (shared.empty()) return {"host names", Status::ok, "each is there once"};
  return {"host names", Status::fail,
          fmt::format("several hosts are called {}", fmt::join(shared, ", ")),
          "PCs were installed from one image, or two dssmd run on one PC",
          rename_command(first) + "  # on all but one of them, with different names"};
}

}  // namespace

std::vector<Finding> findings_of(const Facts& facts) {
  Findings findings{check_daemon(facts)};
  if (!facts.failed) {
    findings.push_back(check_version(facts));
    findings.push_back(check_memory(facts));
    check_descriptors(facts, findings);
  }
  check_disks(facts, findings);
  findings.push_back(check_clock(facts));
  if (facts.failed) return findings;
  check_listening(facts, findings);
  check_encryption(facts, findings);
  findings.push_back(check_mdns(facts));
  check_hosts(facts, findings);
  check_fleet_clocks(facts, findings);
  findings.push_back(check_host_names(facts));
  check_streams(facts, findings);
  return findings;
}

}  // namespace dssm::ctl
