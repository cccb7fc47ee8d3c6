// SPDX-License-Identifier: Apache-2.0
//
// dssmd: owns the streams of this PC. This file only wires the parts; what each does stands in its
// header. Exit status: 0 after SIGTERM or SIGINT, 1 when the system does not let it run or another
// dssmd is there, 2 when flags or configuration are wrong.
#include <signal.h>

#include <algorithm>
#include <cstdio>
#include <memory>
#include <optional>
#include <utility>

#include "core/wire/tcp.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/journal_logger.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/clock/fleet_clock.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/mdns/discovery.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/link/network_listener.hpp"
#include "daemon/link/resolver.hpp"
#include "daemon/local/fleet_service.hpp"
#include "daemon/local/listener.hpp"
#include "daemon/local/local_service.hpp"
#include "daemon/local/server.hpp"
#include "daemon/remote/mirrors.hpp"
#include "daemon/remote/remote_writers.hpp"
#include "daemon/serve/channel_server.hpp"
#include "daemon/service/command_line.hpp"
#include "daemon/service/inherited.hpp"
#include "daemon/service/process.hpp"
#include "daemon/service/reloader.hpp"
#include "daemon/service/runtime_dir.hpp"
#include "daemon/service/service_manager.hpp"
#include "daemon/service/status_line.hpp"
#include "daemon/streams/descriptor_store.hpp"
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
  self.features = {std::string(wire::kFeatureTorn), std::string(wire::kFeatureClock)};
  return self;
}

// The limits of the configuration, as the parts take them.
Registry::Limits stream_limits(const Config& config) {
  return {config.max_streams, config.max_memory_bytes, config.max_property_bytes};
}
OpenTable::Limits open_limits(const Config& config) {
  return {config.max_opens, config.max_opens_per_client};
}
PeerTable::Limits peer_limits(const Config& config) {
  return {config.max_connections, config.max_connections_per_host, config.max_peer_memory_bytes};
}

// The line in `systemctl status`.
std::string status_text(const Registry& registry, const Peers& peers, const FleetClock& clock,
                        const NetworkListener& network) {
  std::size_t up = 0, known = 0;
  for (const local::Host& host : peers.hosts()) {
    if (host.state() == "self") continue;
    ++known;
    if (host.state() == "up") ++up;
  }
  return "host '" + registry.host() + "', " + std::to_string(registry.streams().size()) +
         " streams, " + std::to_string(up) + " of " + std::to_string(known) + " other hosts up, " +
         clock.str() + ", " + network.str();
}

FleetClock::Options clock_options(const Config& config) {
  return {{wire::resolve_number(config.chronyd).front(),
           {config.clocks.general.limit, config.max_drift}},
          config.clocks};
}

// Touches the status line when streams come and go.
class StreamCount final : private StreamObserver {
 public:
  StreamCount(Registry& registry, StatusLine& line) : registry_(registry), line_(line) {
    registry_.add_observer(*this);
  }
  ~StreamCount() { registry_.remove_observer(*this); }

 private:
  void on_stream_added(const Stream&) override { line_.touch(); }
  void on_stream_removed(const Stream&) override { line_.touch(); }
  Registry& registry_;
  StatusLine& line_;
};

// Sockets that were handed over for other places than the configuration names.
void close_unused(const Inherited& inherited, ServiceManager& manager, Logger& logger) {
  const auto warn = [&](const std::string& where, const std::string& mend) {
    logger.warning("the service manager hands over a socket at " + where +
                       ", which the configuration does not name, closing it; " + mend,
                   {.message_id = message_id::kSocketUnused});
  };
  for (const NamedDescriptor& one : inherited.local) {
    warn("another path (" + one.name + ")",
         "make ListenStream= of its socket unit the key runtime_dir and /dssmd.sock");
  }
  for (const NamedDescriptor& one : inherited.network) {
    const Result<wire::SocketAddress> address = wire::local_address(one.fd.get());
    const std::string where = address ? "'" + address->str() + "'" : "no address";
    if (NetworkListener::is_kept_name(one.name)) {  // the configuration named it before
      manager.forget(one.name);
      logger.info("stop listening at " + where);
    } else {
      warn(where, "add it to the key listen, or take it out of the socket unit");
    }
  }
}

// read_again: reads the configuration file anew; none: there is no file.
Result<void> run(const Config& config, const Reloader::Read& read_again, LeveledLogger& logger) {
  HeldRequests requests;
  raise_descriptor_limit();
  ignore_broken_pipes();
  silence_protobuf();
  return_large_memory();
  const Result<RuntimeDir> dir = RuntimeDir::open(config.runtime_dir);
  if (!dir) return dir.error();
  Result<EventLoop> loop = EventLoop::open();
  if (!loop) return std::move(loop).error();
  ServiceManager manager(*loop, ServiceManager::notify_socket());
  Inherited inherited = Inherited::sort(take_handed_over());
  const Result<Listener> listener =
      Listener::open(dir->socket_path(), config.socket_group, config.socket_mode,
                     inherited.take_local(dir->socket_path()));
  if (!listener) return listener.error();
  const Result<NetworkListener> network =
      NetworkListener::open(config.listen, inherited.network, logger);
  if (!network) return network.error();
  close_unused(inherited, manager, logger);
  network->keep_in(manager);
  inherited.local.clear();
  inherited.network.clear();

  Registry registry(config.name, stream_limits(config));
  OpenTable opens(open_limits(config));
  PlaybackClockOwner clock;
  DescriptorStore store(registry, clock, manager, logger);
  const bool some_may_be_missing =
      store.restore_untrusted(std::move(inherited.others), network->has_kept());
  // Nothing tells whether there was a dssmd before this one when its socket was handed over.
  const bool recovering = some_may_be_missing &&
                          (listener->predecessor_died() || listener->inherited()) &&
                          config.recovery_grace > Duration::zero();

  wire::Greeting self = own_greeting(config.name);
  const auto own_clock = std::make_shared<wire::ClockReport>();
  self.clock = own_clock;
  Catalog catalog(config.name);
  Result<clock::ClockPageWriter> page = clock::ClockPageWriter::open(dir->clock_page_path());
  if (!page) return std::move(page).error();
  FleetClock fleet_clock(*loop, clock_options(config), *std::move(page), own_clock, self.host_id,
                         catalog, logger);
  Resolver resolver(*loop);
  const ChannelParts parts{*loop, resolver, registry, logger, self, &fleet_clock};
  Mirrors mirrors(parts, catalog, config.mirror_linger);
  RemoteWriters writers(parts, catalog);
  Peers peers(*loop, resolver, config.peers, self, catalog, logger);
  FleetService fleet(*loop, {self, network->addresses(), config.insecure, &fleet_clock}, registry,
                     catalog, peers, mirrors, writers);

  LocalService service(registry, opens, clock, logger, recovering, &fleet);
  Server server(*loop, *listener, config.max_clients, service, logger);
  ChannelServer channels({*loop, registry, opens, logger, &fleet_clock}, self, peer_limits(config));

  std::optional<Discovery> discovery;
  if (config.mdns) {
    discovery.emplace(*loop,
                      Discovery::Options{self, reach_of(network->addresses()), config.insecure,
                                         config.interfaces, config.avoid_interfaces},
                      registry, peers, logger);
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
    logger.notice(listener->predecessor_died()
                      ? "the dssmd before this one did not end properly; programs give their "
                        "streams back"
                      : "started without streams; programs that hold some give them back",
                  {.message_id = message_id::kRecovering});
  }
  EventSource stops[] = {EventSource::signal(*loop, SIGTERM, [&] { loop->stop(); }),
                         EventSource::signal(*loop, SIGINT, [&] { loop->stop(); })};
  for (EventSource& stop : stops) stop.enable();

  StatusLine status(*loop, manager,
                    [&] { return status_text(registry, peers, fleet_clock, *network); });
  const StreamCount count(registry, status);
  peers.on_change([&] { status.touch(); });
  fleet_clock.on_news([&] {
    channels.send_clock();
    status.touch();
  });
  fleet_clock.on_change([&] {
    mirrors.on_clock();
    channels.on_clock();
  });
  Reloader reloader(
      config, read_again,
      [&](const Config& changed) {
        logger.set_level(changed.log_level);
        registry.set_limits(stream_limits(changed));
        opens.set_limits(open_limits(changed));
        server.set_max_clients(changed.max_clients);
        channels.set_limits(peer_limits(changed));
        mirrors.set_linger(changed.mirror_linger);
        peers.set_configured(changed.peers);
        fleet_clock.set(changed.clocks, changed.max_drift);
      },
      logger);
  EventSource reload = EventSource::signal(*loop, SIGHUP, [&] {
    manager.reloading();
    reloader.reload();
    manager.ready(status.now());
  });
  if (read_again) reload.enable();
  requests.deliver();
  if (config.insecure) {
    logger.warning(
        "insecure = true: samples cross the network in the clear, and whoever reaches this host "
        "can read and write all its streams",
        {.message_id = message_id::kInsecure});
  }

  const std::string ready =
      "ready, host '" + config.name + "', socket '" + dir->socket_path() + "', " + network->str();
  logger.notice(ready, {.message_id = message_id::kReady});
  manager.ready(status.now());
  const Watchdog watchdog(*loop, manager);
  if (Result<void> ran = loop->run(); !ran) return ran;
  manager.stopping();
  peers.on_change({});
  fleet_clock.on_news({});
  fleet_clock.on_change({});
  logger.notice("stopping", {.message_id = message_id::kStopping});
  return {};
}

std::unique_ptr<LeveledLogger> open_log(LogLevel level) {
  if (stderr_is_journal()) return std::make_unique<JournalLogger>(level);
  return std::make_unique<StderrLogger>(level, false);
}

// What is wrong with flags and configuration, a line each.
void print_errors(const std::string& mistakes) {
  std::optional<JournalLogger> journal;
  if (stderr_is_journal()) journal.emplace(LogLevel::error);
  for (std::size_t begin = 0; begin <= mistakes.size();) {
    const std::size_t end = std::min(mistakes.find('\n', begin), mistakes.size());
    const std::string line = mistakes.substr(begin, end - begin);
    if (journal) {
      journal->error(line, {.message_id = message_id::kFailed});
    } else {
      std::fprintf(stderr, "dssmd: %s\n", line.c_str());
    }
    begin = end + 1;
  }
}

int main(int argc, char** argv) {
  const Result<CommandLine> line = parse_command_line(argc, argv);
  if (!line) {
    print_errors(line.error().message);
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
  const std::unique_ptr<LeveledLogger> logger = open_log(line->config.log_level);
  Reloader::Read read_again;
  if (!line->config_path.empty()) {
    read_again = [argc, argv]() -> Result<Config> {
      Result<CommandLine> again = parse_command_line(argc, argv);
      if (!again) return std::move(again).error();
      return std::move(again->config);
    };
  }
  if (Result<void> ran = run(line->config, read_again, *logger); !ran) {
    logger->error(ran.error().message, {.message_id = message_id::kFailed});
    return kFailed;
  }
  return 0;
}

}  // namespace
}  // namespace dssm::daemon

int main(int argc, char** argv) { return dssm::daemon::main(argc, argv); }
