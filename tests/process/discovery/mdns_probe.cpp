// SPDX-License-Identifier: Apache-2.0
//
// A dssmd reduced to its Mdns, for one test PC each: libdbus reads DBUS_SYSTEM_BUS_ADDRESS once per
// process.
//
//   mdns-probe COMMANDS ID NAME PORT [open|closed] [use=PATTERN]... [avoid=PATTERN]...
//              [pause=MILLISECONDS]
//
// ID is one byte, of which the host id is made. Reads commands from descriptor COMMANDS, one a
// line, and ends with it:
//
//   announce STREAM...   "lidar:0" (depth 8), "lidar:0/16" (depth 16), all besides the host itself
//   many COUNT           so many streams, besides the host itself
//   tick                 answered at once by "tock", from the loop that Mdns was given
//
// Prints one line per event:
//
//   found ID NAME closed|open ADDRESS...
//   lost ID
//   state PHASE announced=N withheld=N own=0|1 heard=N version=... error=...
//   log LEVEL TEXT
//   ended                after Mdns is destroyed
#include <unistd.h>

#include <cstdio>
#include <cstdlib>
#include <sstream>
#include <string>
#include <string_view>

#include "daemon/fleet/mdns/mdns.hpp"

namespace {

using namespace dssm;
using namespace dssm::daemon;

class Printer final : public HostFinderObserver, public Logger {
 public:
  void on_host_found(const FoundHost& host) override {
    std::printf("found %d %s %s", host.id[0], host.name.c_str(), host.closed ? "closed" : "open");
    for (const wire::Address& address : host.addresses) std::printf(" %s", address.str().c_str());
    std::printf("\n");
  }
  void on_host_lost(const wire::HostId& id) override { std::printf("lost %d\n", id[0]); }
  void on_mdns_state(const MdnsInfo& state) override {
    std::printf("state %s announced=%u withheld=%u own=%d heard=%u version=%s error=%s\n",
                name_of(state.phase).data(), state.announced, state.withheld, state.own_host_seen,
                state.hosts_heard, state.avahi_version.c_str(), state.error.c_str());
  }
  void write(LogLevel level, std::string_view text, const LogFields&) noexcept override {
    std::printf("log %d %.*s\n", static_cast<int>(level), static_cast<int>(text.size()),
                text.data());
  }
};

ServiceRecord host_record(const char* const* words) {
  ServiceRecord record;
  record.host_id.fill(static_cast<std::uint8_t>(std::atoi(words[2])));
  record.host = words[3];
  record.protocol_version = wire::kNetworkProtocolVersion;
  return record;
}

ServiceRecord stream_record(ServiceRecord record, const std::string& word) {
  const std::size_t colon = word.find(':');
  const std::size_t slash = word.find('/');
  ServiceRecord::Stream stream;
  stream.name = word.substr(0, colon);
  stream.id = std::atoi(word.c_str() + colon + 1);
  stream.payload_bytes = 64;
  stream.depth = slash == word.npos ? 8 : static_cast<std::uint64_t>(std::atoi(&word[slash + 1]));
  stream.cycle = std::chrono::milliseconds(100);
  stream.type = "Scan";
  stream.type_hash = 1;
  stream.incarnation = 1;
  record.stream = stream;
  return record;
}

}  // namespace

int main(int argc, char** argv) {
  std::setvbuf(stdout, nullptr, _IOLBF, 0);
  if (argc < 5) return 2;
  const int commands = std::atoi(argv[1]);
  ServiceRecord self = host_record(argv);
  Mdns::Options options{self.host_id, static_cast<std::uint16_t>(std::atoi(argv[4])), {}, {}};
  for (int i = 5; i < argc; ++i) {
    const std::string_view word = argv[i];
    if (word == "closed") self.closed = true;
    if (word.starts_with("use=")) options.interfaces.emplace_back(word.substr(4));
    if (word.starts_with("pause=")) {
      options.stream_pause = std::chrono::milliseconds(std::atoi(word.substr(6).data()));
    }
    if (word.starts_with("avoid=")) options.avoid_interfaces.emplace_back(word.substr(6));
  }
  Result<EventLoop> loop = EventLoop::open();
  if (!loop) return 1;
  Printer printer;
  {
    Mdns mdns(*loop, options, printer, printer);
    mdns.announce({self});
    std::string input;
    EventSource source = EventSource::readable(*loop, commands, [&] {
      char buffer[4096];
      const ssize_t n = ::read(commands, buffer, sizeof buffer);
      if (n <= 0) return loop->stop();
      input.append(buffer, static_cast<std::size_t>(n));
      for (std::size_t end; (end = input.find('\n')) != input.npos; input.erase(0, end + 1)) {
        std::istringstream line(input.substr(0, end));
        std::string command, word;
        line >> command;
        if (command == "tick") std::printf("tock\n");
        std::vector<ServiceRecord> records{self};
        if (command == "announce") {
          while (line >> word) records.push_back(stream_record(self, word));
          mdns.announce(std::move(records));
        } else if (command == "many") {
          int count = 0;
          line >> count;
          for (int i = 0; i < count; ++i) {
            records.push_back(stream_record(self, "many:" + std::to_string(i)));
          }
          mdns.announce(std::move(records));
        }
      }
    });
    source.enable();
    if (!loop->run()) return 1;
  }
  std::printf("ended\n");
  return 0;
}
