// SPDX-License-Identifier: Apache-2.0
//
// Eight hosts with 128 streams each, without configuration and with Avahi's default limits: the
// time from the last start until every host knows every stream, and the cost afterwards.
#include <cinttypes>
#include <dssm/dssm.hpp>
#include <fstream>
#include <string>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/mdns_vehicle.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kHosts = 8, kStreamsPerHost = 128, kSeconds = 30;

// The first number after `word` in a file of /proc.
std::int64_t number_after(const std::string& path, const std::string& word) {
  std::ifstream file(path);
  for (std::string next; file >> next;) {
    std::int64_t number = 0;
    if (next == word && file >> number) return number;
  }
  fail(path.c_str());
}

// Packets sent to multicast addresses; for IPv4, the second line of IpExt has the values.
std::int64_t multicast_packets(test::MdnsVehicle& vehicle, int pc) {
  const test::Inside inside = vehicle.avahi(pc).inside();
  std::ifstream file("/proc/thread-self/net/netstat");
  std::vector<std::string> names;
  for (std::string line; std::getline(file, line);) {
    if (!line.starts_with("IpExt:")) continue;
    std::vector<std::string> words;
    for (std::size_t at = 0; at < line.size();) {
      const std::size_t end = std::min(line.find(' ', at), line.size());
      words.push_back(line.substr(at, end - at));
      at = end + 1;
    }
    if (names.empty()) {
      names = words;
      continue;
    }
    for (std::size_t i = 0; i < names.size() && i < words.size(); ++i) {
      if (names[i] == "OutMcastPkts") {
        return std::stoll(words[i]) +
               number_after("/proc/thread-self/net/snmp6", "Ip6OutMcastPkts");
      }
    }
  }
  fail("read netstat");
}

double seconds_since(MonoTime begin) {
  return static_cast<double>(to_ns(MonoClock::now() - begin)) / 1e9;
}

bool knows_all(Session& session) {
  std::uint32_t streams = 0;
  for (const HostInfo& host : session.list_hosts().value()) streams += host.streams;
  return streams == kHosts * kStreamsPerHost;
}

}  // namespace

int main() {
  test::MdnsVehicle vehicle;
  if (Result<void> opened = vehicle.open(kHosts); !opened) {
    std::printf("SKIPPED eight hosts by mDNS: %s\n", opened.error().message.c_str());
    return 0;
  }
  std::vector<RawWriter> writers;
  for (int pc = 1; pc <= kHosts; ++pc) {
    vehicle.add_dssmd();
    for (int i = 0; i < kStreamsPerHost; ++i) {
      writers.push_back(vehicle.session(pc)
                            .create_raw({"stream" + std::to_string(i / 4), i % 4, ""},
                                        {"", 64, 1, {}}, {16, 10ms})
                            .value());
    }
  }
  const MonoTime begin = MonoClock::now();
  for (int pc = 1; pc <= kHosts; ++pc) {
    while (!knows_all(vehicle.session(pc))) ::usleep(10'000);
  }
  std::printf("8 hosts, 1024 streams, by mDNS                 measured  target\n");
  std::printf("  complete on all hosts after the last start [s] %6.1f  <= 10\n",
              seconds_since(begin));
  std::fflush(stdout);
  for (int pc = 1; pc <= kHosts; ++pc) {
    while (vehicle.session(pc).daemon_info().value().mdns.announced != 1 + kStreamsPerHost) {
      ::usleep(10'000);
    }
  }
  std::printf("  all services announced [s]                     %6.1f\n", seconds_since(begin));
  std::int64_t avahi = 0;
  for (int pc = 1; pc <= kHosts; ++pc) avahi += cpu_ns(vehicle.avahi(pc).avahi_pid());
  std::printf("  CPU time of one avahi-daemon until then [s]    %6.1f\n",
              static_cast<double>(avahi) / kHosts / 1e9);
  std::fflush(stdout);
  std::int64_t packets = 0, cpu = 0, most_kib = 0;
  ::sleep(10);  // the announcements are repeated for some seconds
  for (int pc = 1; pc <= kHosts; ++pc) {
    packets -= multicast_packets(vehicle, pc);
    cpu -= cpu_ns(vehicle.dssmd(pc).pid());
  }
  ::sleep(kSeconds);
  for (int pc = 1; pc <= kHosts; ++pc) {
    packets += multicast_packets(vehicle, pc);
    const pid_t pid = vehicle.dssmd(pc).pid();
    cpu += cpu_ns(pid);
    most_kib =
        std::max(most_kib, number_after("/proc/" + std::to_string(pid) + "/status", "VmRSS:"));
  }
  std::printf("  multicast packets a second, of one host        %6.2f\n",
              static_cast<double>(packets) / kHosts / kSeconds);
  std::printf("  dssmd: share of a core, of one host [%%]        %6.2f\n",
              static_cast<double>(cpu) / kHosts / kSeconds / 1e7);
  std::printf("  dssmd: memory at most, without rings' [MiB]    %6.1f\n",
              static_cast<double>(most_kib) / 1024);
}
