// SPDX-License-Identifier: Apache-2.0
//
// One function per check. Texts of other hosts are used as they came; doctor.cpp escapes them when
// it prints.
#include "client/dssmctl/doctor_checks.hpp"

#include <algorithm>
#include <map>
#include <set>
#include <string_view>

#include "client/dssmctl/duplicates.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

using Status = Finding::Status;
using Findings = std::vector<Finding>;

constexpr std::uint64_t kMebibyte = 1U << 20;
constexpr std::uint64_t kDescriptorsPerStream = 4;  // of dssmd
// What dssmd has open beside its streams: its own, and a few programs and hosts. A guess.
constexpr std::uint64_t kOtherDescriptors = 200;
constexpr std::size_t kMaxNamed = 5;  // of streams in one text
constexpr const char* kConfigFile = "/etc/dssm/dssmd.conf";
constexpr const char* kDefaultGroup = "dssm";

std::string in_quotes(const std::string& text) { return "'" + text + "'"; }

// Starts one of Debian's own services, in a container too.
std::string start_command(const Facts& facts, const std::string& service) {
  return facts.systemd ? "sudo systemctl enable --now " + service
                       : "sudo service " + service + " start";
}

// Gives a host another name; `where` says which.
std::string rename_command(const std::string& where) {
  return "echo 'name = \"pc2\"'  # another one on " + where + ", as a line in " +
         std::string(kConfigFile) + "; then: sudo systemctl restart dssmd";
}

// --- dssmd

Finding no_permission(const Facts& facts) {
  const SocketFacts& socket = facts.socket;
  Finding finding{"daemon", Status::fail, facts.failed->message, {}, {}};
  const std::string group = socket.group.empty() ? kDefaultGroup : socket.group;
  if (socket.process_in_group) {
    finding.cause = "the socket or its folder shuts out even its group " + in_quotes(group);
    finding.command = "ls -l " + socket.path + "  # see the key socket_mode in " + kConfigFile;
  } else if (socket.user_in_group) {
    finding.cause = "user " + in_quotes(facts.user) + " joined the group " + in_quotes(group) +
                    ", but not before this login";
    finding.command = "newgrp " + group + "  # or log in again";
  } else {
    finding.cause =
        "user " + in_quotes(facts.user) + " is not in the socket's group " + in_quotes(group);
    finding.command = "sudo usermod -aG " + group + " " + facts.user + "  # then log in again";
  }
  return finding;
}

Finding no_daemon(const Facts& facts) {
  const SocketFacts& socket = facts.socket;
  Finding finding{"daemon", Status::fail, facts.failed->message, {}, {}};
  if (socket.kind == SocketFacts::Kind::something_else) {
    finding.cause = in_quotes(socket.path) + " is there, but is not a socket";
    finding.command = "ls -l " + socket.path + "  # then correct --socket or $DSSM_SOCKET";
  } else if (socket.chosen) {
    finding.cause = "no dssmd runs for the socket that --socket or $DSSM_SOCKET names";
    finding.command = "unset DSSM_SOCKET  # for the usual one, or start that dssmd";
  } else if (facts.service == "failed") {
    finding.cause = "dssmd could not start or crashed";
    finding.command =
        "journalctl -u dssmd -n 50  # shows the reason; then: systemctl restart dssmd";
  } else if (facts.service == "active") {
    finding.cause = "dssmd runs, but listens elsewhere (key runtime_dir)";
    finding.command = "grep runtime_dir " + std::string(kConfigFile) + "  # then set $DSSM_SOCKET";
  } else {
    finding.cause = "dssmd is not running";
    finding.command = facts.systemd ? "sudo systemctl enable --now dssmd"
                                    : "dssmd  # in a terminal of its own: no systemd runs here";
  }
  return finding;
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

void check_daemon(const Facts& facts, Findings& findings) {
  if (facts.failed) return findings.push_back(unanswered(facts));
  findings.push_back({"daemon",
                      Status::ok,
                      "dssmd (pid " + std::to_string(facts.daemon.pid) + ") answers at " +
                          in_quotes(facts.socket.path) + " as host " + in_quotes(facts.daemon.host),
                      {},
                      {}});
}

void check_version(const Facts& facts, Findings& findings) {
  if (facts.daemon.version != facts.version) {
    findings.push_back({"version", Status::warn,
                        "dssmd is " + facts.daemon.version + ", dssmctl is " + facts.version,
                        "dssmd was not restarted after an upgrade, or comes from elsewhere",
                        "sudo systemctl restart dssmd"});
    return;
  }
  std::string others;
  for (const HostInfo& host : facts.hosts) {
    if (host.state != HostState::up || host.version == facts.version) continue;
    others += (others.empty() ? "" : ", ") + host.name + " has " + host.version;
  }
  if (!others.empty()) {
    findings.push_back({"version", Status::warn, "this PC has " + facts.version + ", " + others,
                        "not all hosts were upgraded",
                        "dssmctl hosts  # then install the same version of DSSM on each"});
    return;
  }
  findings.push_back(
      {"version",
       Status::ok,
       "dssmd and dssmctl are both " + facts.version + " and speak the same protocol",
       {},
       {}});
}

// --- this PC

void check_memory(const Facts& facts, Findings& findings) {
  const DaemonInfo& daemon = facts.daemon;
  Finding finding{"memory",
                  Status::ok,
                  "rings take " + bytes_text(daemon.memory_bytes) + " of the " +
                      bytes_text(daemon.memory_limit_bytes) + " that are allowed",
                  {},
                  {}};
  const std::uint64_t left =
      daemon.memory_limit_bytes - std::min(daemon.memory_limit_bytes, daemon.memory_bytes);
  const MemoryFacts& machine = facts.memory;
  if (left < daemon.memory_limit_bytes / 10) {
    finding.status = Status::warn;
    finding.cause = "streams with long histories; soon no further one can be created";
    finding.command = "dssmctl ls --sort memory  # rm what is not needed, or raise max_memory in " +
                      std::string(kConfigFile);
  } else if (machine.total_bytes > 0 && machine.available_bytes < left &&
             machine.available_bytes < machine.total_bytes / 20) {
    finding.status = Status::warn;
    finding.text += ", but this PC has only " + bytes_text(machine.available_bytes) + " left";
    finding.cause = "other programs took the memory";
    finding.command = "ps -eo rss,comm --sort=-rss | head  # end what is not needed";
  }
  findings.push_back(std::move(finding));
}

void check_descriptors(const Facts& facts, Findings& findings) {
  const std::uint64_t limit = facts.descriptors.soft_limit;
  if (limit == 0) return;  // dssmd is in another container: not known here
  const std::uint64_t wanted = facts.daemon.streams * kDescriptorsPerStream + kOtherDescriptors;
  Finding finding{"descriptors",
                  Status::ok,
                  "dssmd may open " + std::to_string(limit) + " files, its " +
                      std::to_string(facts.daemon.streams) + " streams take about " +
                      std::to_string(facts.daemon.streams * kDescriptorsPerStream),
                  {},
                  {}};
  if (wanted > limit - limit / 5) {
    finding.status = Status::warn;
    finding.cause = "the limit on open files is too low for many more streams";
    finding.command =
        "sudo systemctl edit dssmd  # [Service] LimitNOFILE=524288, then restart dssmd";
  }
  findings.push_back(std::move(finding));
}

void check_disks(const Facts& facts, Findings& findings) {
  for (const DiskFacts& disk : facts.disks) {
    Finding finding{"disk " + disk.path,
                    Status::ok,
                    bytes_text(disk.free_bytes) + " of " + bytes_text(disk.total_bytes) + " free",
                    {},
                    {}};
    if (disk.free_bytes < disk.total_bytes / 20 || disk.free_bytes < 100 * kMebibyte) {
      finding.status = Status::warn;
      finding.cause = "logs and recordings fill disks";
      finding.command = disk.path == "/run" ? "du -xh -d 2 /run | sort -h | tail"
                                            : "sudo journalctl --vacuum-size=200M";
    }
    findings.push_back(std::move(finding));
  }
}

void check_clock(const Facts& facts, Findings& findings) {
  const std::string said = facts.clock.detail.empty() ? "" : " (" + facts.clock.detail + ")";
  switch (facts.clock.state) {
    case ClockFacts::State::no_chrony:
      return findings.push_back({"clock", Status::warn, "chrony is not installed",
                                 "nothing bounds the difference between this clock and the others",
                                 "sudo apt install chrony"});
    case ClockFacts::State::no_answer:
      return findings.push_back({"clock", Status::warn, "chronyd does not answer" + said,
                                 "chronyd is not running", start_command(facts, "chrony")});
    case ClockFacts::State::unsynchronized:
      return findings.push_back(
          {"clock", Status::warn, "chronyd does not follow any other clock" + said,
           "it was just started, or no source answers",
           "chronyc sources  # then correct 'server' lines in /etc/chrony/chrony.conf"});
    case ClockFacts::State::synchronized:
      return findings.push_back(
          {"clock", Status::ok, "chronyd keeps this clock by another one" + said, {}, {}});
  }
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

void check_listening(const Facts& facts, Findings& findings) {
  if (facts.hosts.empty()) return;
  const std::vector<std::string>& own = facts.hosts.front().addresses;
  const bool closed = std::all_of(own.begin(), own.end(), on_loopback);
  const bool others = std::any_of(facts.hosts.begin(), facts.hosts.end(), is_other_pc);
  Finding finding{"listening",
                  Status::ok,
                  own.empty() ? "nowhere for other hosts" : "at " + list_text(own),
                  {},
                  {}};
  if (closed && !own.empty()) finding.text += ", for programs of this PC only";
  if (closed && others) {
    finding.status = Status::warn;
    finding.cause = "other PCs cannot reach this one: the keys listen and insecure do not let them";
    finding.command = "echo 'listen = [\"0.0.0.0:13776\"]' 'insecure = true'  # as two lines in " +
                      std::string(kConfigFile) + ", then: sudo systemctl restart dssmd";
  }
  findings.push_back(std::move(finding));
}

Finding mdns_waiting(const Facts& facts) {
  const MdnsInfo& mdns = facts.daemon.mdns;
  Finding finding{"mdns",
                  Status::warn,
                  "waits for Avahi" + (mdns.error.empty() ? "" : ": " + mdns.error),
                  {},
                  {}};
  if (!facts.avahi_installed) {
    finding.cause = "avahi-daemon is not installed; only configured peers are found";
    finding.command = "sudo apt install avahi-daemon";
  } else if (!facts.avahi_running) {
    finding.cause = "avahi-daemon is not running; only configured peers are found";
    finding.command = start_command(facts, "avahi-daemon");
  } else {
    finding.cause = "avahi-daemon runs, but dssmd does not reach it over D-Bus";
    finding.command = "systemctl status dbus avahi-daemon  # then restart what failed";
  }
  return finding;
}

void check_mdns(const Facts& facts, Findings& findings) {
  const MdnsInfo& mdns = facts.daemon.mdns;
  if (mdns.phase == MdnsPhase::off) {
    return findings.push_back({"mdns", Status::ok, "off: only configured peers are found", {}, {}});
  }
  if (mdns.phase == MdnsPhase::waiting) return findings.push_back(mdns_waiting(facts));

  const auto up_by_peers = std::count_if(
      facts.hosts.begin(), facts.hosts.end(),
      [](const HostInfo& host) { return host.state == HostState::up && is_other_pc(host); });
  Finding finding{"mdns",
                  Status::ok,
                  mdns.avahi_version + ", " + std::to_string(mdns.announced) + " announced, " +
                      std::to_string(mdns.hosts_heard) + " other hosts heard",
                  {},
                  {}};
  if (!mdns.error.empty()) finding.text += ": " + mdns.error;
  if (mdns.withheld > 0) {
    finding.status = Status::warn;
    finding.text += "; " + std::to_string(mdns.withheld) + " not announced";
    finding.cause =
        "beyond Avahi's limits, or refused by it; these streams open by NAME@HOST still";
    finding.command = "grep objects-per /etc/avahi/avahi-daemon.conf  # raise the limits there";
  } else if (!mdns.own_host_seen) {
    finding.status = Status::warn;
    finding.text += "; this host's own announcement is not visible";
    finding.cause = "avahi-daemon was just started, or does not publish or use any interface";
    finding.command = "avahi-browse -rt _dssm._tcp  # see /etc/avahi/avahi-daemon.conf";
  } else if (mdns.hosts_heard == 0 && up_by_peers > 0) {
    finding.status = Status::warn;
    finding.cause = "the network or a firewall drops multicast: others are up, none is heard";
    finding.command = "sudo ufw allow 5353/udp  # on each host; or list all hosts in peers";
  } else if (!mdns.error.empty()) {
    finding.status = Status::warn;
    finding.cause = "Avahi refused something";
    finding.command = "journalctl -u avahi-daemon -n 50";
  }
  findings.push_back(std::move(finding));
}

Finding host_down(const HostInfo& host) {
  Finding finding{"host " + name_of(host), Status::fail, "down: " + host.error, {}, {}};
  const std::string where =
      host.addresses.empty() ? host.name : without_port(host.addresses.front());
  switch (host.reason) {
    case HostReason::connection_refused:
      finding.cause = "no dssmd runs there, or it listens at another address or port";
      finding.command = "systemctl status dssmd  # there; and check its key listen";
      break;
    case HostReason::no_greeting:
      finding.cause = "the dssmd there hangs, or another program has its port";
      finding.command = "ss -ltnp  # there; then: systemctl restart dssmd";
      break;
    case HostReason::name_not_found:
      finding.cause = "its name is not known here";
      finding.command =
          "getent hosts " + where + "  # then correct peers, or give an address there";
      break;
    default:
      finding.cause = "it is off, the cable is out, or a firewall is in between";
      finding.command = "ping " + where + "  # it answers: open TCP port 13776 in its firewall";
  }
  return finding;
}

Finding host_refused(const HostInfo& host) {
  Finding finding{"host " + name_of(host), Status::fail, "refused: " + host.error, {}, {}};
  switch (host.reason) {
    case HostReason::duplicate:
      finding.cause =
          "one PC's disk was copied to the other, or two dssmd of this PC have one name";
      finding.command = rename_command("one of them") +
                        "; on a copied PC also: sudo rm /etc/machine-id && sudo "
                        "systemd-machine-id-setup";
      break;
    case HostReason::namesake:
      finding.cause = "both hosts have the same name";
      finding.command = rename_command("one of them");
      break;
    default:
      finding.cause = "the two do not fit together: versions, names or limits";
      finding.command =
          "dssmctl hosts  # shows the reason; install the same version of DSSM on both";
  }
  return finding;
}

// Found by mDNS, but the keys of one of both PCs do not allow the connection.
Finding host_closed(const HostInfo& host) {
  const bool here = host.reason == HostReason::closed_here;
  return {"host " + name_of(host), Status::warn,
          "found by mDNS, but not connected to: " + host.error,
          here ? "the key insecure of this PC does not let its dssmd connect to others"
               : "its keys listen and insecure do not let others in",
          "echo 'listen = [\"0.0.0.0:13776\"]' 'insecure = true'  # as two lines in " +
              std::string(here ? "" : "its ") + kConfigFile + ", then restart " +
              (here ? "this" : "its") + " dssmd"};
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
Finding host_finding(const HostInfo& host, bool also_up) {
  const std::string name = "host " + name_of(host);
  if (host.state == HostState::up) {
    const std::string warning = host.error.empty() ? "" : ": " + host.error;
    return {name, Status::ok, "up at " + list_text(host.addresses) + warning, {}, {}};
  }
  if (host.state == HostState::refused) return host_refused(host);
  if (also_up) {
    const std::string reason =
        host.error.empty() ? std::string(dssm::name_of(host.state)) : host.error;
    return {name,
            Status::ok,
            "also at " + list_text(host.addresses) + ", which is not used: " + reason,
            {},
            {}};
  }
  if (host.state == HostState::connecting) {
    return {name, Status::warn, "being connected to", "dssmd or the network has just come up",
            "dssmctl hosts"};
  }
  return host.state == HostState::closed ? host_closed(host) : host_down(host);
}

void check_hosts(const Facts& facts, Findings& findings) {
  std::set<std::string> up;  // ids
  for (const HostInfo& host : facts.hosts) {
    if (host.state == HostState::up || host.state == HostState::self) up.insert(host.id);
  }
  for (const HostInfo& host : facts.hosts) {
    if (host.state == HostState::self) {
      check_own_host(facts, host, findings);
    } else {
      findings.push_back(host_finding(host, !host.id.empty() && up.contains(host.id)));
    }
  }
}

// How far the clocks of the other PCs may be from this one's.
void check_fleet_clocks(const Facts& facts, Findings& findings) {
  for (const HostInfo& host : facts.hosts) {
    if (host.state != HostState::up || !is_other_pc(host) || !host.clock) continue;
    const ClockSnapshot& clock = *host.clock;
    Finding finding{"clock of " + name_of(host),
                    Status::ok,
                    "at most " + bound_text(host.clock_distance) + " from this one's",
                    {},
                    {}};
    if (host.clock_distance == kUnknownClockError) {
      finding.status = Status::warn;
      finding.text = "it is not known how far it is from this one's (" +
                     std::string(dssm::name_of(clock.status)) + " there)";
      finding.cause =
          "one of both is not synchronized, or they follow different references; reads of its "
          "samples by time are refused, unless clock_policy says otherwise";
      finding.command = "dssmctl clock  # then `chronyc sources` where it is not 'synchronized'";
    }
    findings.push_back(std::move(finding));
  }
}

void check_host_names(const Facts& facts, Findings& findings) {
  std::map<std::string, std::set<std::string>> ids;  // by name
  for (const HostInfo& host : facts.hosts) {
    if (host.name.empty() || host.id.empty()) continue;
    ids[host.name].insert(host.id);
    // A copied PC, or a second dssmd on this one, has the same id.
    if (host.reason == HostReason::duplicate) ids[host.name].insert("duplicate");
  }
  std::string doubled;
  for (const auto& [name, of_name] : ids) {
    if (of_name.size() > 1) doubled += (doubled.empty() ? "" : ", ") + in_quotes(name);
  }
  if (doubled.empty()) {
    return findings.push_back({"host names", Status::ok, "each is there once", {}, {}});
  }
  findings.push_back({"host names", Status::fail, "several hosts are called " + doubled,
                      "PCs were installed from one image, or two dssmd run on one PC",
                      rename_command("each")});
}

void check_stream_names(const Facts& facts, Findings& findings) {
  const Duplicates duplicates(facts.streams);
  if (duplicates.owners().empty()) {
    return findings.push_back({"stream names",
                               Status::ok,
                               "each of the " + std::to_string(facts.streams.size()) +
                                   " streams can be opened without its host's name",
                               {},
                               {}});
  }
  std::string text, example;
  std::size_t named = 0;
  for (const auto& [key, hosts] : duplicates.owners()) {
    if (named++ == kMaxNamed) {
      text += " and " + std::to_string(duplicates.owners().size() - kMaxNamed) + " more";
      break;
    }
    const std::string name = key.first + ":" + std::to_string(key.second);
    text += (text.empty() ? "" : ", ") + in_quotes(name) + " of " + list_text(hosts);
    if (example.empty()) example = name + "@" + hosts.front();
  }
  findings.push_back({"stream names", Status::warn, "several hosts have " + text,
                      "the same program runs on several hosts; a name without a host opens only a "
                      "host's own stream",
                      "dssmctl info " + example + "  # and so in programs"});
}

}  // namespace

std::vector<Finding> findings_of(const Facts& facts) {
  Findings findings;
  check_daemon(facts, findings);
  if (!facts.failed) {
    check_version(facts, findings);
    check_memory(facts, findings);
    check_descriptors(facts, findings);
  }
  check_disks(facts, findings);
  check_clock(facts, findings);
  if (facts.failed) return findings;
  check_listening(facts, findings);
  check_mdns(facts, findings);
  check_hosts(facts, findings);
  check_fleet_clocks(facts, findings);
  check_host_names(facts, findings);
  check_stream_names(facts, findings);
  return findings;
}

}  // namespace dssm::ctl
