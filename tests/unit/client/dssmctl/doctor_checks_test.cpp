// SPDX-License-Identifier: Apache-2.0
//
// The checks of dssmctl doctor: from a set of facts that differs from a healthy host's in one
// thing, which finding follows, with which advice.
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <fstream>
#include <sstream>

#include "client/dssmctl/doctor.hpp"

namespace dssm::ctl {
namespace {

using Status = Finding::Status;

constexpr std::uint64_t kGiB = 1ULL << 30;

HostInfo host_at(std::string name, HostState state, std::string address,
                 HostReason reason = HostReason::none) {
  HostInfo host;
  host.id = "id of " + name;
  host.name = std::move(name);
  host.state = state;
  if (!address.empty()) host.addresses = {std::move(address)};
  host.version = "1.2";
  host.reason = reason;
  if (reason != HostReason::none) host.error = "a sentence";
  return host;
}

StreamInfo stream_of(std::string name, std::string host) {
  StreamInfo stream;
  stream.id = {std::move(name), 0, std::move(host)};
  return stream;
}

// pc1, where dssmctl runs, and pc2: all is well.
Facts healthy() {
  Facts facts;
  facts.user = "anna";
  facts.version = "1.2";
  facts.socket = {.path = "/run/dssm/dssmd.sock",
                  .chosen = false,
                  .kind = SocketFacts::Kind::socket,
                  .group = "dssm",
                  .user_in_group = true,
                  .process_in_group = true};
  facts.daemon.host = "pc1";
  facts.daemon.version = "1.2";
  facts.daemon.pid = 42;
  facts.daemon.streams = 3;
  facts.daemon.memory_bytes = kGiB;
  facts.daemon.memory_limit_bytes = 4 * kGiB;
  facts.daemon.mdns.phase = MdnsPhase::running;
  facts.daemon.mdns.avahi_version = "avahi 0.8";
  facts.daemon.mdns.announced = 4;
  facts.daemon.mdns.own_host_seen = true;
  facts.daemon.mdns.hosts_heard = 1;
  facts.hosts = {host_at("pc1", HostState::self, "10.0.0.1:13776"),
                 host_at("pc2", HostState::up, "10.0.0.2:13776")};
  facts.streams = {stream_of("lidar", "pc1"), stream_of("odom", "pc2")};
  facts.memory = {8 * kGiB, 6 * kGiB};
  facts.descriptors.soft_limit = 1024;
  facts.avahi_installed = facts.avahi_running = true;
  facts.clock = {ClockFacts::State::synchronized, "pc2", false};
  facts.disks = {{"/", 100 * kGiB, 50 * kGiB}, {"/run", kGiB, kGiB}};
  return facts;
}

Facts unreachable(Errc code) {
  Facts facts = healthy();
  facts.failed = Error{code, "connect to '/run/dssm/dssmd.sock': it did not work"};
  return facts;
}

// The finding of that name; all findings say what to do unless they are ok.
Finding finding_of(const Facts& facts, const std::string& name) {
  Finding wanted{"none", Status::ok, {}, {}, {}};
  for (const Finding& finding : findings_of(facts)) {
    EXPECT_FALSE(finding.text.empty()) << finding.name;
    EXPECT_EQ(finding.status == Status::ok, finding.cause.empty()) << finding.name;
    EXPECT_EQ(finding.status == Status::ok, finding.command.empty()) << finding.name;
    if (finding.name == name) wanted = finding;
  }
  EXPECT_EQ(wanted.name, name);
  return wanted;
}

#define EXPECT_FINDING(facts, finding_name, wanted_status, part_of_command)                 \
  do {                                                                                      \
    const Finding finding = finding_of(facts, finding_name);                                \
    EXPECT_EQ(finding.status, wanted_status) << finding.text;                               \
    EXPECT_NE(finding.command.find(part_of_command), std::string::npos) << finding.command; \
  } while (false)

TEST(Doctor, FindsNothingWhereAllIsWell) {
  const std::vector<Finding> findings = findings_of(healthy());
  EXPECT_GE(findings.size(), 10U);
  for (const Finding& finding : findings) {
    EXPECT_EQ(finding.status, Status::ok) << finding.name << ": " << finding.text;
  }
}

TEST(Doctor, ReportsWhyDssmdIsNotThere) {
  Facts facts = unreachable(Errc::no_daemon);
  EXPECT_FINDING(facts, "daemon", Status::fail, "systemctl enable --now dssmd");
  facts.service = "failed";
  EXPECT_FINDING(facts, "daemon", Status::fail, "journalctl -u dssmd");
  facts.service = "active";
  EXPECT_FINDING(facts, "daemon", Status::fail, "runtime_dir");
  facts.socket.chosen = true;
  EXPECT_FINDING(facts, "daemon", Status::fail, "unset DSSM_SOCKET");
  facts.socket.kind = SocketFacts::Kind::something_else;
  EXPECT_FINDING(facts, "daemon", Status::fail, "ls -l /run/dssm/dssmd.sock");
  EXPECT_FINDING(unreachable(Errc::protocol), "daemon", Status::fail, "systemctl restart dssmd");
  EXPECT_FINDING(unreachable(Errc::unavailable), "daemon", Status::fail, "journalctl -u dssmd");
  EXPECT_FINDING(unreachable(Errc::invalid_argument), "daemon", Status::fail, "DSSM_SOCKET");
}

TEST(Doctor, ReportsWhichPermissionIsMissing) {
  Facts facts = unreachable(Errc::no_permission);
  EXPECT_FINDING(facts, "daemon", Status::fail, "socket_mode");
  facts.socket.process_in_group = false;
  EXPECT_FINDING(facts, "daemon", Status::fail, "newgrp dssm");
  facts.socket.user_in_group = false;
  EXPECT_FINDING(facts, "daemon", Status::fail, "usermod -aG dssm anna");
  facts.socket.group.clear();
  EXPECT_FINDING(facts, "daemon", Status::fail, "usermod -aG dssm anna");
  facts.socket.group = "robots";
  EXPECT_FINDING(facts, "daemon", Status::fail, "usermod -aG robots anna");
  facts.socket.group = "root";  // nobody is to join that
  EXPECT_FINDING(facts, "daemon", Status::fail, "usermod -aG dssm anna");
  EXPECT_FINDING(facts, "daemon", Status::fail, "--socket-group dssm");
}

TEST(Doctor, LeavesOutWhatOnlyDssmdKnowsWhileItIsDown) {
  for (const Finding& finding : findings_of(unreachable(Errc::no_daemon))) {
    EXPECT_TRUE(finding.name == "daemon" || finding.name == "clock" ||
                finding.name.starts_with("disk "))
        << finding.name;
  }
}

TEST(Doctor, ComparesVersions) {
  Facts facts = healthy();
  facts.hosts[1].version = "1.1";
  EXPECT_FINDING(facts, "version", Status::warn, "same version");
  facts.daemon.version = "1.1";
  EXPECT_FINDING(facts, "version", Status::warn, "restart dssmd");
}

TEST(Doctor, WarnsBeforeMemoryRunsOut) {
  Facts facts = healthy();
  facts.daemon.memory_bytes = 4 * kGiB - kGiB / 4;
  EXPECT_FINDING(facts, "memory", Status::warn, "max_memory");
  facts.daemon.memory_bytes = 5 * kGiB;  // more than allowed, since a configuration changed
  EXPECT_FINDING(facts, "memory", Status::warn, "max_memory");
  facts = healthy();
  facts.memory.available_bytes = kGiB / 8;
  EXPECT_FINDING(facts, "memory", Status::warn, "ps -eo");
}

TEST(Doctor, WarnsBeforeDescriptorsRunOut) {
  Facts facts = healthy();
  facts.daemon.streams = 160;
  EXPECT_FINDING(facts, "descriptors", Status::warn, "LimitNOFILE");
  facts.descriptors.soft_limit = 0;  // not known
  for (const Finding& finding : findings_of(facts)) EXPECT_NE(finding.name, "descriptors");
}

TEST(Doctor, WarnsOfFullDisks) {
  Facts facts = healthy();
  facts.disks[0].free_bytes = 4 * kGiB;  // of 100
  EXPECT_FINDING(facts, "disk /", Status::warn, "vacuum");
}

TEST(Doctor, WarnsOfRunOnlyWhenSystemdHasTooLittle) {
  Facts facts = healthy();
  facts.disks[1] = {"/run", 70ULL << 20, 68ULL << 20};  // of a PC with 384 MiB of memory
  EXPECT_FINDING(facts, "disk /run", Status::ok, "");
  facts.disks[1].free_bytes = 15ULL << 20;
  EXPECT_FINDING(facts, "disk /run", Status::warn, "du ");
}

TEST(Doctor, ChecksTheClockByChronycWhileDssmdDoesNotReport) {
  Facts facts = healthy();
  facts.clock = {ClockFacts::State::no_chrony, "", false};
  EXPECT_FINDING(facts, "clock", Status::warn, "apt install chrony");
  facts.clock = {ClockFacts::State::no_answer, "506 Cannot talk to daemon", false};
  EXPECT_FINDING(facts, "clock", Status::warn, "systemctl restart chrony");
  facts.clock = {ClockFacts::State::unsynchronized, "Not synchronised", false};
  EXPECT_FINDING(facts, "clock", Status::warn, "chronyc sources");
}

ClockSnapshot clock_of(ClockStatus status, ClockReason reason, ClockBasis basis,
                       Duration bound = kUnknownClockError) {
  ClockSnapshot clock;
  clock.status = status;
  clock.reason = reason;
  clock.basis = basis;
  clock.bound = bound;
  return clock;
}

// Both clocks are good; pc2's follows pc1's.
Facts with_clocks() {
  Facts facts = healthy();
  facts.hosts[0].clock = clock_of(ClockStatus::synchronized, ClockReason::none, ClockBasis::own,
                                  std::chrono::microseconds(1));
  facts.hosts[1].clock = clock_of(ClockStatus::synchronized, ClockReason::none,
                                  ClockBasis::reference, std::chrono::microseconds(250));
  facts.hosts[1].clock_reference = "pc1";
  facts.hosts[1].clock_distance = std::chrono::microseconds(250);
  return facts;
}

void refuse(Facts& facts, std::string reason) {
  facts.hosts[1].clock_reason = std::move(reason);
  facts.hosts[1].clock_refused = true;
}

TEST(Doctor, CallsTheReferenceTheReference) {
  Facts facts = with_clocks();
  EXPECT_EQ(finding_of(facts, "clock").text,
            "this PC is the fleet's reference; other PCs' clocks follow it: pc2");
  std::swap(facts.hosts[0].clock, facts.hosts[1].clock);
  facts.hosts[0].clock_reference = "pc2";
  EXPECT_EQ(finding_of(facts, "clock").text,
            "at most 250 us from the fleet's reference; chronyd follows 'pc2'");
  facts.hosts[0].clock->status = ClockStatus::holdover;
  EXPECT_FINDING(facts, "clock", Status::warn, "chronyc sources");
}

TEST(Doctor, FailsWhereThisClockIsWhyReadsAreRefused) {
  for (const auto& [reason, command] :
       {std::pair(ClockReason::no_chronyd, "sudo systemctl restart chrony"),
        std::pair(ClockReason::silent, "sudo systemctl restart chrony"),
        std::pair(ClockReason::unsynchronized, "chronyc sources"),
        std::pair(ClockReason::stepped, "dssmctl clock --wait"),
        std::pair(ClockReason::too_far, "chronyc sources")}) {
    Facts facts = with_clocks();
    facts.hosts[1].clock_reference.clear();
    facts.hosts[0].clock = clock_of(ClockStatus::out_of_bounds, reason, ClockBasis::nothing);
    EXPECT_FINDING(facts, "clock", Status::warn, command);  // no reads fail for it
    refuse(facts, "this PC's clock is out of bounds");
    EXPECT_FINDING(facts, "clock", Status::fail, command);
    EXPECT_FINDING(facts, "clock of pc2", Status::fail, command);
  }
}

TEST(Doctor, LetsAClockThatIsFarOffBeStepped) {
  Facts facts = with_clocks();
  facts.hosts[0].clock = clock_of(ClockStatus::out_of_bounds, ClockReason::too_far,
                                  ClockBasis::reference, std::chrono::milliseconds(553));
  facts.hosts[0].clock->offset = std::chrono::milliseconds(552);
  refuse(facts, "its samples' times may be 552800 us from this PC's clock");
  EXPECT_FINDING(facts, "clock", Status::fail, "chronyc makestep");
  EXPECT_NE(finding_of(facts, "clock").text.find("it may be 553 ms off"), std::string::npos)
      << finding_of(facts, "clock").text;
}

TEST(Doctor, GivesAReferenceAdviceOfItsRole) {
  Facts facts = with_clocks();
  facts.hosts[0].clock =
      clock_of(ClockStatus::out_of_bounds, ClockReason::unsynchronized, ClockBasis::nothing);
  refuse(facts, "this PC's clock is out of bounds (not synchronised)");
  EXPECT_FINDING(facts, "clock", Status::fail, "systemctl restart chrony");  // pc2 names it
  facts.hosts[1].clock_reference.clear();
  EXPECT_FINDING(facts, "clock", Status::fail, "chronyc sources");
  facts.clock.serves = true;
  EXPECT_FINDING(facts, "clock", Status::fail, "systemctl restart chrony");
}

TEST(Doctor, WarnsOfLoopbackOnlyWhereThereAreOtherPcs) {
  Facts facts = healthy();
  facts.hosts[0].addresses = {"127.0.0.1:4000", "[::1]:4000"};
  EXPECT_FINDING(facts, "listening", Status::warn,
                 "kill 42 && dssmd --listen 0.0.0.0:4000 --insec");
  facts.hosts[0].addresses.clear();
  facts.daemon.config_file = "/etc/dssm/dssmd.conf";
  EXPECT_FINDING(facts, "listening", Status::warn, "'1i listen = [\"0.0.0.0:13776\"]'");
  EXPECT_FINDING(facts, "listening", Status::warn, "insecure = true");
  facts.daemon.credentials.emplace();
  EXPECT_EQ(finding_of(facts, "listening").command.find("insecure"), std::string::npos);
  facts.hosts[1].addresses = {"127.0.0.1:20000"};  // a second dssmd of this PC
  EXPECT_FINDING(facts, "listening", Status::ok, "");
  facts.hosts.pop_back();
  EXPECT_FINDING(facts, "listening", Status::ok, "");
}

TEST(Doctor, PrintsACommandThatSetsKeysOfTheConfiguration) {
  const std::string file = testing::TempDir() + "doctor-" + std::to_string(::getpid()) + ".conf";
  std::ofstream(file) << "listen = [\"127.0.0.1:4000\"]\n#insecure = false\nname = \"pc1\"\n";
  Facts facts = healthy();
  facts.hosts[0].addresses = {"127.0.0.1:4000"};
  facts.daemon.config_file = file;
  const std::string command = finding_of(facts, "listening").command;
  ASSERT_TRUE(command.starts_with("sudo sed ")) << command;
  const std::size_t second = command.find(" && ");
  ASSERT_EQ(command.find("dssmd --config " + file + " --check-config && "), second + 4) << command;
  const auto end =
      run_program({"sh", "-c", command.substr(5, second - 5)}, std::chrono::minutes(1));
  ASSERT_TRUE(end && end->exit_status == 0) << (end ? end->output : "no sh");
  std::ostringstream text;
  text << std::ifstream(file).rdbuf();
  ::unlink(file.c_str());
  EXPECT_EQ(text.str(),
            "listen = [\"0.0.0.0:4000\"]\ninsecure = true\n#insecure = false\nname = \"pc1\"\n");
}

TEST(Doctor, SaysWhatABadClockMeansForReads) {
  Facts facts = with_clocks();
  facts.hosts[0].clock =
      clock_of(ClockStatus::out_of_bounds, ClockReason::no_chronyd, ClockBasis::nothing);
  facts.clock.state = ClockFacts::State::no_chrony;
  facts.daemon.config_file = "/etc/pc1.conf";
  Facts alone = facts, refused = facts;
  alone.hosts.pop_back();
  refuse(refused, "this PC's clock is out of bounds");
  const auto expect = [](Facts with, const std::string& policy, const std::string& words) {
    with.daemon.clock_policy = policy;
    const std::string text = finding_of(with, "clock").text;
    EXPECT_NE(text.find(words), std::string::npos) << text;
  };
  const std::string marked = "clock_policy = \"mark\" in /etc/pc1.conf";
  expect(refused, "enforce",
         "until it is good, streams of pc2 are not opened here; with " + marked);
  expect(refused, "mark", "until it is good, the times of the samples of pc2 are marked as bad");
  expect(alone, "enforce", "is enough, streams of other PCs are not opened here; with " + marked);
  expect(alone, "mark", "is enough, the times of the samples of other PCs are marked as bad");
  for (const char* policy : {"enforce", "mark"}) {
    expect(facts, policy, "the times of the samples of pc2 are good here, for as long as");
  }
  facts.daemon.clock_policy = "off";
  EXPECT_EQ(finding_of(facts, "clock").text.find("pc2"), std::string::npos);
}

TEST(Doctor, SaysWhetherConnectionsAreEncrypted) {
  Facts facts = healthy();
  for (const Finding& finding : findings_of(facts)) EXPECT_NE(finding.name, "encryption");
  facts.hosts[0].insecure = true;
  EXPECT_FINDING(facts, "encryption", Status::warn, "dssmctl pki");
  facts.daemon.credentials = {"host 'pc1'", WallClock::now() + std::chrono::hours(24 * 31), ""};
  EXPECT_FINDING(facts, "encryption", Status::warn, "without --insecure");
  facts.daemon.config_file = "/etc/dssm/dssmd.conf";
  EXPECT_FINDING(facts, "encryption", Status::warn, "'1i insecure = false'");
  facts.hosts[0].insecure = false;
  EXPECT_FINDING(facts, "encryption", Status::ok, "");
  facts.daemon.credentials->valid_until = WallClock::now() + std::chrono::hours(24 * 29);
  EXPECT_FINDING(facts, "encryption", Status::warn, "pki renew pc1 ");
  facts.daemon.credentials->problem = "expired";
  EXPECT_FINDING(facts, "encryption", Status::fail, "pki renew");
}

TEST(Doctor, ReportsWhatAvahiLacks) {
  Facts facts = healthy();
  facts.daemon.mdns.phase = MdnsPhase::waiting;
  EXPECT_FINDING(facts, "mdns", Status::warn, "dbus");
  facts.avahi_running = false;
  EXPECT_FINDING(facts, "mdns", Status::warn, "systemctl enable --now avahi-daemon");
  facts.avahi_installed = false;
  EXPECT_FINDING(facts, "mdns", Status::warn, "apt install avahi-daemon");
  facts.daemon.mdns.phase = MdnsPhase::off;
  EXPECT_FINDING(facts, "mdns", Status::ok, "");
}

TEST(Doctor, ReportsWhatMdnsLacks) {
  Facts facts = healthy();
  facts.daemon.mdns.hosts_heard = 0;
  EXPECT_FINDING(facts, "mdns", Status::warn, "5353");
  facts.hosts[1].state = HostState::down;  // then nobody knows whether it could be heard
  EXPECT_FINDING(facts, "mdns", Status::ok, "");
  facts.daemon.mdns.error = "a name was taken";
  EXPECT_FINDING(facts, "mdns", Status::warn, "journalctl -u avahi-daemon");
  facts.daemon.mdns.own_host_seen = false;
  EXPECT_FINDING(facts, "mdns", Status::warn, "avahi-browse");
  facts.daemon.mdns.withheld = 7;
  EXPECT_FINDING(facts, "mdns", Status::warn, "objects-per");
}

TEST(Doctor, ReportsOfEachHostWhyItIsNotUp) {
  struct Case {
    HostState state;
    HostReason reason;
    const char* command;
  };
  for (const Case& one : {
           Case{HostState::down, HostReason::connection_refused, "systemctl status dssmd"},
           Case{HostState::down, HostReason::no_answer, "ping -c 3 10.0.0.2 "},
           Case{HostState::down, HostReason::no_greeting, "ss -ltnp"},
           Case{HostState::down, HostReason::name_not_found, "getent hosts 10.0.0.2 "},
           Case{HostState::refused, HostReason::not_accepted, "same version"},
           Case{HostState::closed, HostReason::closed_there, "listen = "},
           Case{HostState::closed, HostReason::closed_here, "kill 42 && dssmd --insecure"},
           Case{HostState::connecting, HostReason::none, "dssmctl hosts"},
       }) {
    Facts facts = healthy();
    facts.hosts[1] = host_at("pc2", one.state, "10.0.0.2:13776", one.reason);
    const bool works = one.state == HostState::closed || one.state == HostState::connecting;
    EXPECT_FINDING(facts, "host pc2", works ? Status::warn : Status::fail, one.command);
  }
  Facts facts = healthy();
  facts.hosts[1] = host_at("", HostState::down, "[fe80::2%eth0]:4000", HostReason::no_answer);
  EXPECT_FINDING(facts, "host [fe80::2%eth0]:4000", Status::fail, "ping -c 3 fe80::2%eth0 ");
  EXPECT_FINDING(facts, "host [fe80::2%eth0]:4000", Status::fail, "port 4000 ");
}

TEST(Doctor, NamesCommandsThatWorkWithoutSystemd) {
  Facts facts = unreachable(Errc::no_daemon);
  facts.systemd = false;
  EXPECT_FINDING(facts, "daemon", Status::fail, "dssmd  # in a terminal");
  facts = healthy();
  facts.systemd = false;
  facts.clock.state = ClockFacts::State::no_answer;
  EXPECT_FINDING(facts, "clock", Status::warn, "sudo service chrony restart");
  facts.daemon.mdns.phase = MdnsPhase::waiting;
  facts.avahi_running = false;
  EXPECT_FINDING(facts, "mdns", Status::warn, "sudo service avahi-daemon start");
}

TEST(Doctor, ForgivesAnAddressThatDoesNotWorkWhileAnotherOfThatHostDoes) {
  Facts facts = healthy();
  facts.hosts.push_back(
      host_at("pc2", HostState::down, "192.168.0.2:13776", HostReason::no_answer));
  EXPECT_FINDING(facts, "host pc2", Status::ok, "");
  EXPECT_FINDING(facts, "host names", Status::ok, "");
  facts.hosts[1].state = HostState::down;
  EXPECT_FINDING(facts, "host pc2", Status::fail, "ping");
}

TEST(Doctor, FailsWhereReadersRefuse) {
  Facts facts = with_clocks();
  EXPECT_FINDING(facts, "clock of pc2", Status::ok, "");
  EXPECT_EQ(finding_of(facts, "clock of pc2").text, "at most 250 us from this one's");
  refuse(facts, "its samples' times may be 1600 us from this PC's clock");
  EXPECT_FINDING(facts, "clock of pc2", Status::fail, "chronyc sources  # here and there");
  EXPECT_EQ(finding_of(facts, "clock of pc2").text,
            "reads of its samples by time are refused: its samples' times may be 1600 us from this "
            "PC's clock");
  facts.hosts[1].clock =
      clock_of(ClockStatus::out_of_bounds, ClockReason::no_chronyd, ClockBasis::nothing);
  EXPECT_FINDING(facts, "clock of pc2", Status::fail, "sudo systemctl restart chrony  # on pc2");
  facts.hosts[1].clock_refused = false;  // clock_policy = "mark"
  EXPECT_FINDING(facts, "clock of pc2", Status::warn, "# on pc2");
  facts.hosts[1].clock.reset();  // it reports none
  EXPECT_FINDING(facts, "clock of pc2", Status::warn, "chronyc sources");
}

TEST(Doctor, NamesTheClockThatDisagreesWithTheOthers) {
  Facts facts = with_clocks();
  refuse(facts, "one of them follows a clock that was set or is wrong");
  EXPECT_TRUE(finding_of(facts, "clock of pc2").cause.starts_with("the two follow different"));
  facts.hosts.push_back(facts.hosts[1]);
  facts.hosts[2].name = "pc3";
  EXPECT_EQ(finding_of(facts, "clock of pc2").cause,
            "the clocks of all others (pc2, pc3) disagree with this PC's");
  facts.hosts[2].clock_reason.clear();
  EXPECT_EQ(finding_of(facts, "clock of pc2").cause,
            "only the clock of pc2 disagrees with this PC's; these agree with it: pc3");
}

TEST(Doctor, FindsHostsOfOneName) {
  Facts facts = healthy();
  facts.hosts.push_back(host_at("pc2", HostState::up, "10.0.0.3:13776"));
  facts.hosts.back().id = "another one";
  EXPECT_FINDING(facts, "host names", Status::fail, "name = ");
  facts = healthy();
  facts.hosts[1].name = "pc1";
  EXPECT_FINDING(facts, "host names", Status::fail, "name = ");
}

TEST(Doctor, FindsACopyOfThisHost) {
  Facts facts = healthy();
  facts.hosts[1] = host_at("pc1", HostState::refused, "10.0.0.2:13776", HostReason::duplicate);
  EXPECT_FINDING(facts, "host names", Status::fail, "name = ");
  EXPECT_FINDING(facts, "host pc1", Status::fail, "rm /etc/machine-id");
  facts.hosts[1].id += "9";
  facts.hosts[1].reason = HostReason::namesake;
  EXPECT_EQ(finding_of(facts, "host pc1").command.find("machine-id"), std::string::npos);
  EXPECT_FINDING(facts, "host pc1", Status::fail, "name = ");
  facts.hosts[0].reason = facts.hosts[1].reason;
  facts.hosts[0].error = facts.hosts[1].error;
  facts.hosts.pop_back();
  EXPECT_FINDING(facts, "host pc1", Status::fail, "host names");
}

TEST(Doctor, FindsStreamsOfOneNameAndNamesOnlySome) {
  Facts facts = healthy();
  facts.streams.push_back(stream_of("lidar", "pc2"));
  EXPECT_FINDING(facts, "stream names", Status::warn, "dssmctl info 'lidar:0@pc1'");
  EXPECT_EQ(finding_of(facts, "stream names").text,
            "several hosts have a stream of the same name: 'lidar:0' (on pc1, pc2)");
  for (int i = 0; i < 100; ++i) {
    for (const char* host : {"pc1", "pc2"}) {
      facts.streams.push_back(stream_of("x" + std::to_string(i), host));
    }
  }
  EXPECT_TRUE(finding_of(facts, "stream names").text.ends_with(" and 96 more"));
}

TEST(Doctor, FindsStreamsWhoseTimesAreNotGoodThoughTheirHostsClocksAre) {
  Facts facts = healthy();
  StreamInfo& stream = facts.streams[1];
  EXPECT_FINDING(facts, "times", Status::ok, "");
  stream.mirror.emplace();
  EXPECT_FINDING(facts, "times", Status::ok, "");
  stream.mirror->clock = "programs on other PCs write to it";
  EXPECT_FINDING(facts, "times", Status::ok, "");  // nothing has come yet
  stream.mirror->state = MirrorState::live;
  EXPECT_FINDING(facts, "times", Status::warn, "dssmctl clock");  // they are only marked
  stream.mirror->clock_refused = true;
  EXPECT_FINDING(facts, "times", Status::fail, "dssmctl clock");
  EXPECT_EQ(finding_of(facts, "times").text, "not good here: programs on other PCs write to it");
  facts.hosts[1].clock_reason = "2 ms apart";  // which is a finding of its own
  EXPECT_FINDING(facts, "times", Status::ok, "");
  facts.hosts[1].clock_reason.clear();
  facts.hosts[1].state = HostState::down;  // as is this
  EXPECT_FINDING(facts, "times", Status::ok, "");
}

TEST(Doctor, FindsRingsThatKeepLessThanTheyWereCreatedFor) {
  Facts facts = healthy();
  StreamInfo& stream = facts.streams[0];
  stream.id.name = "it's";
  stream.depth = 101;
  stream.cycle = std::chrono::milliseconds(10);
  stream.rate_hz = 110;
  EXPECT_FINDING(facts, "histories", Status::ok, "");
  stream.rate_hz = 500;
  EXPECT_FINDING(facts, "histories", Status::warn, "dssmctl hz 'it'\\''s:0@pc1'");
  EXPECT_EQ(finding_of(facts, "histories").text,
            "'it's:0@pc1' keeps 200 ms, not 1.00 s: 500.0 samples a second, not 100.0");
}

TEST(Doctor, FindsTypesOfOneNameThatDiffer) {
  Facts facts = healthy();
  facts.streams[0].type = {"Pose", 16, 8, {}};
  facts.streams[1].type = {"Pose", 16, 8, {{"x", Scalar::float64, 0, 1, 0}}};
  facts.streams.push_back(facts.streams[1]);
  facts.streams.push_back(stream_of("bytes", "pc2"));
  EXPECT_FINDING(facts, "types", Status::ok, "");
  facts.streams[2].id.name = "other";
  facts.streams[2].type.fields[0].name = "y";
  EXPECT_FINDING(facts, "types", Status::warn, "dssmctl info 'other:0@pc2'");
  EXPECT_EQ(finding_of(facts, "types").text,
            "different types have one name: 'Pose' of 'odom:0@pc2' and of 'other:0@pc2'");
}

TEST(Doctor, WarnsOfStalledStreamsAndNamesOneWithAWriterFirst) {
  Facts facts = healthy();
  ASSERT_EQ(facts.streams.size(), 2U);
  EXPECT_FINDING(facts, "streams", Status::ok, "");
  facts.streams[0].state = StreamState::no_writer;
  facts.streams[0].age = std::chrono::seconds(98);
  const std::string first = facts.streams[0].id.str(), second = facts.streams[1].id.str();
  EXPECT_FINDING(facts, "streams", Status::warn, "dssmctl rm '" + first);
  EXPECT_EQ(finding_of(facts, "streams").text,
            "no samples of '" + first + "' for 98.0 s (no writer is connected)");
  facts.streams[1].state = StreamState::stalled;
  facts.streams[1].age = std::chrono::seconds(3);
  EXPECT_FINDING(facts, "streams", Status::warn, "dssmctl info '" + second);
  EXPECT_TRUE(finding_of(facts, "streams")
                  .text.ends_with(", '" + second + "' for 3.00 s (its writer is connected)"));
}

TEST(Doctor, WarnsOfMirrorsThatTheNetworkCannotFill) {
  Facts facts = healthy();
  EXPECT_TRUE(finding_of(facts, "mirrors").text.starts_with("no stream of another host"));
  StreamInfo& stream = facts.streams[1];
  stream.cycle = std::chrono::milliseconds(33);
  stream.rate_hz = 30;
  stream.newest = 1000;
  stream.newest_time = time_from_ns(10'000'000'000);
  stream.mirror.emplace();
  stream.mirror->state = MirrorState::live;
  stream.mirror->newest = 999;
  stream.mirror->newest_time = time_from_ns(9'900'000'000);
  EXPECT_FINDING(facts, "mirrors", Status::ok, "");
  stream.mirror->state = MirrorState::filling;
  EXPECT_TRUE(finding_of(facts, "mirrors").text.ends_with("read of a stream of another host"));
  stream.mirror->state = MirrorState::live;
  stream.mirror->newest_time = time_from_ns(8'000'000'000);
  EXPECT_FINDING(facts, "mirrors", Status::warn, "dssmctl info 'odom:0@pc2'");
  EXPECT_EQ(finding_of(facts, "mirrors").text, "'odom:0@pc2': 2.00 s behind its owner");
  stream.mirror->recent_samples = 90;
  stream.mirror->recent_lost_samples = 57;
  EXPECT_EQ(finding_of(facts, "mirrors").text,
            "'odom:0@pc2': the network carries 11 of 30 samples a second");
  stream.mirror->max_rate_hz = 10;
  stream.mirror->newest_time = stream.newest_time;
  EXPECT_FINDING(facts, "mirrors", Status::ok, "");
  stream.mirror->recent_lost_samples = 75;
  EXPECT_EQ(finding_of(facts, "mirrors").text,
            "'odom:0@pc2': the network carries 5 of the 10 samples a second that are asked for");
}

}  // namespace
}  // namespace dssm::ctl
