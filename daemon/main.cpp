// SPDX-License-Identifier: Apache-2.0
//
// dssmd: owns the streams of this PC. This file only wires the parts; what each does stands in its
// header. Exit status: 0 after SIGTERM or SIGINT, 1 when the system does not let it run or another
// dssmd is there, 2 when flags or configuration are wrong.
#include <signal.h>

#include <cstdio>
#include <optional>

#include "daemon/channel/channel_server.hpp"
#include "daemon/channel/mirrors.hpp"
#include "daemon/channel/network_listener.hpp"
#include "daemon/channel/remote_writers.hpp"
#include "daemon/channel/resolver.hpp"
#include "daemon/discovery/catalog.hpp"
#include "daemon/discovery/discovery.hpp"
#include "daemon/discovery/fleet_service.hpp"
#include "daemon/discovery/peers.hpp"
#include "daemon/local/listener.hpp"
#include "daemon/local/local_service.hpp"
#include "daemon/local/server.hpp"
#include "daemon/service/command_line.hpp"
#include "daemon/service/event_loop.hpp"
#include "daemon/service/log.hpp"
#include "daemon/service/message_ids.hpp"
#include "daemon/service/notify.hpp"
#include "daemon/service/process.hpp"
#include "daemon/service/runtime_dir.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {
namespace {

constexpr int kFailed = 1, kUsage = 2;

// What this dssmd says of itself to other hosts.
wire::Greeting own_greeting(const std::string& name) {
  wire::Greeting self;
  self.host = name;
  self.host_id = wire::host_id_for(name);
  self.life = wire::random_number();
  self.program = "dssmd";
  self.version = DSSM_VERSION;
  self.features = {std::string(wire::kFeatureTorn)};
  return self;
}

Result<void> run(const Config& config, Logger& logger) {
  raise_descriptor_limit();
  ignore_broken_pipes();
  silence_protobuf();
  return_large_memory();
  const Result<RuntimeDir> dir = RuntimeDir::open(config.runtime_dir);
  if (!dir) return dir.error();
  Result<EventLoop> loop = EventLoop::open();
  if (!loop) return std::move(loop).error();
  const Result<Listener> listener =
      Listener::open(dir->socket_path(), config.socket_group, config.socket_mode);
  if (!listener) return listener.error();
  const Result<NetworkListener> network = NetworkListener::open(config.listen, logger);
  if (!network) return network.error();
  const bool recovering = listener->predecessor_died() && config.recovery_grace > Duration::zero();

  Registry registry(config.name,
                    {config.max_streams, config.max_memory_bytes, config.max_property_bytes});
  OpenTable opens({config.max_opens, config.max_opens_per_client});
  PlaybackClockOwner clock;

  const wire::Greeting self = own_greeting(config.name);
  Resolver resolver(*loop);
  const ChannelParts parts{*loop, resolver, registry, logger, self};
  Catalog catalog(config.name);
  Mirrors mirrors(parts, catalog, config.mirror_linger);
  RemoteWriters writers(parts, catalog);
  Peers peers(*loop, resolver, config.peers, self, catalog, logger);
  FleetService fleet(*loop, {self, network->addresses(), config.insecure}, registry, catalog, peers,
                     mirrors, writers);

  LocalService service(registry, opens, clock, logger, recovering, &fleet);
  const Server server(*loop, *listener, config.max_clients, service, logger);
  ChannelServer channels(
      {*loop, registry, opens, logger}, self,
      {config.max_connections, config.max_connections_per_host, config.max_peer_memory_bytes});

  std::optional<Discovery> discovery;
  if (config.mdns) {
    discovery.emplace(*loop,
                      Discovery::Options{self, reach_of(network->addresses()), config.insecure,
                                         config.interfaces, config.avoid_interfaces},
                      registry, peers, fleet, logger);
  }
  const auto serve_others = [&] {
    channels.serve(*network);
    if (discovery) discovery->start_announcing();
  };
  EventSource grace = EventSource::timer(*loop, [&] {
    service.end_recovery();
    serve_others();
  });
  if (!recovering) serve_others();
  if (recovering) {
    grace.enable_in(config.recovery_grace);
    logger.notice(
        "the dssmd before this one did not end properly; programs give their streams back",
        {.message_id = message_id::kRecovering});
  }
  EventSource stops[] = {EventSource::signal(*loop, SIGTERM, [&] { loop->stop(); }),
                         EventSource::signal(*loop, SIGINT, [&] { loop->stop(); })};
  for (EventSource& stop : stops) stop.enable();
  if (config.insecure) {
    logger.warning(
        "insecure = true: samples cross the network in the clear, and whoever reaches this host "
        "can read and write all its streams",
        {.message_id = message_id::kInsecure});
  }

  const std::string ready =
      "ready, host '" + config.name + "', socket '" + dir->socket_path() + "', " + network->str();
  logger.notice(ready, {.message_id = message_id::kReady});
  notify_ready(ready);
  if (Result<void> ran = loop->run(); !ran) return ran;
  notify_stopping();
  logger.notice("stopping", {.message_id = message_id::kStopping});
  return {};
}

void print_lines(const std::string& lines) {
  for (std::size_t begin = 0; begin <= lines.size();) {
    const std::size_t end = std::min(lines.find('\n', begin), lines.size());
    std::fprintf(stderr, "dssmd: %s\n", lines.substr(begin, end - begin).c_str());
    begin = end + 1;
  }
}

int main(int argc, char** argv) {
  const Result<CommandLine> line = parse_command_line(argc, argv);
  if (!line) {
    print_lines(line.error().message);
    return kUsage;
  }
  if (line->action == CommandLine::Action::print) {
    std::fputs(line->text.c_str(), stdout);
    return 0;
  }
  if (line->action == CommandLine::Action::check_config) {
    std::puts("OK");
    return 0;
  }
  StderrLogger logger(line->config.log_level, under_systemd());
  if (Result<void> ran = run(line->config, logger); !ran) {
    logger.error(ran.error().message);
    return kFailed;
  }
  return 0;
}

}  // namespace
}  // namespace dssm::daemon

int main(int argc, char** argv) { return dssm::daemon::main(argc, argv); }
