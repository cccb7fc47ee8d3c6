// SPDX-License-Identifier: Apache-2.0
//
// dssmd: owns the streams of this PC. This file only connects the parts; the header of each says
// what it does. From the inside out:
//
//   Sockets     the runtime folder, the Unix socket, the TCP sockets
//   OwnStreams  registry, open table, playback clock, descriptor store
//   OtherHosts  clock, catalog, peers, mirrors, remote writers
//   Dssmd       all of them, and the two servers: for programs (Server), for hosts (ChannelServer)
//
// Exit status: 0 after SIGTERM or SIGINT, 1 when the system does not let it run or another dssmd
// runs already, 2 when flags or configuration are wrong.
#include <fmt/format.h>
#include <signal.h>

#include <algorithm>
#include <cstdio>
#include <memory>
#include <optional>
#include <thread>
#include <utility>
#include <vector>

#include "core/base/try.hpp"
#include "core/wire/tcp.hpp"
#include "daemon/base/event_loop.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/clock/fleet_clock.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/mdns/discovery.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/link/interface_watch.hpp"
#include "daemon/link/network_listener.hpp"
#include "daemon/link/resolver.hpp"
#include "daemon/local/fleet_service.hpp"
#include "daemon/local/local_service.hpp"
#include "daemon/local/server.hpp"
#include "daemon/remote/mirror.hpp"
#include "daemon/remote/remote_streams.hpp"
#include "daemon/remote/remote_writer.hpp"
#include "daemon/serve/channel_server.hpp"
#include "daemon/service/command_line.hpp"
#include "daemon/service/process.hpp"
#include "daemon/service/service_manager.hpp"
#include "daemon/streams/descriptor_store.hpp"
#include "daemon/streams/open_table.hpp"
#include "daemon/streams/playback_clock_owner.hpp"
#include "daemon/streams/registry.hpp"

namespace dssm::daemon {
namespace {

constexpr int kFailed = 1, kUsage = 2;

// systemd starts a dssmd that failed again at once (RestartSec=0), and what is wrong may last.
constexpr Duration kRetryPause = std::chrono::milliseconds(250);

// How this dssmd greets other hosts.
wire::Greeting own_greeting(const std::string& name, std::shared_ptr<const wire::ClockReport> clock,
                            std::shared_ptr<const wire::OwnCredentials> credentials) {
  wire::Greeting self;
  self.host = name;
  self.host_id = wire::host_id_for(name);
  self.instance_id = wire::random_number();
  self.program = "dssmd";
  self.version = DSSM_VERSION;
  self.features = {std::string(wire::kFeatureTorn), std::string(wire::kFeatureClock),
                   std::string(wire::kFeatureNewestFirst), std::string(wire::kFeatureUsers)};
  self.clock = std::move(clock);
  self.credentials = std::move(credentials);
  return self;
}

// The limits of the configuration, for each part.
Registry::Limits stream_limits(const Config& config) {
  return {config.max_streams,
          config.max_memory_bytes,
          config.max_property_bytes,
          {config.max_share_percent}};
}
Server::Limits client_limits(const Config& config) {
  return {config.max_clients, config.max_clients_per_user};
}
OpenTable::Limits open_limits(const Config& config) {
  return {config.max_opens, config.max_opens_per_client, {config.max_share_percent}};
}
PeerTable::Limits peer_limits(const Config& config) {
  return {config.max_connections, config.max_connections_per_host, config.max_peer_memory_bytes,
          memory_of_the_machine()};
}

// The line in `systemctl status`.
std::string status_text(const Registry& registry, const Peers& peers, const FleetClock& clock,
                        const NetworkListener& network) {
  std::size_t up = 0, known = 0;
  for (const local::Host& host : peers.report().hosts()) {
    if (host.state() == local::Host::SELF) continue;
    ++known;
    if (host.state() == local::Host::UP) ++up;
  }
  return fmt::format("host '{}', {} streams, {} of {} other hosts up, {}, {}", registry.host(),
                     registry.streams().size(), up, known, clock.str(), network.str());
}

FleetClock::Options clock_options(const Config& config) {
  return {{wire::resolve_number(config.chronyd).front(),
           {config.clocks.general.limit, config.max_drift}},
          config.clocks};
}

// Refreshes the status line when a stream is added or removed.
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

// Closes and logs inherited sockets at addresses that the configuration does not name.
void close_unused(const Inherited& inherited, ServiceManager& manager, Logger& logger) {
  const auto warn = [&](const std::string& where, const std::string& fix) {
    logger.warning("the service manager hands over a socket at " + where +
                       ", which the configuration does not name, closing it; " + fix,
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

// The folder and the sockets of this dssmd.
struct Sockets {
  RuntimeDir dir;
  Listener listener;
  NetworkListener network;

  // Takes from `inherited` the sockets that the configuration names, and closes the others.
  static Result<Sockets> open(const Config& config, Inherited& inherited, ServiceManager& manager,
                              Logger& logger) {
    RuntimeDir dir = DSSM_TRY(RuntimeDir::open(config.runtime_dir));
    Listener listener =
        DSSM_TRY(Listener::open(dir.socket_path(), config.socket_group, config.socket_mode,
                                inherited.take_local(dir.socket_path())));
    NetworkListener network =
        DSSM_TRY(NetworkListener::open(config.listen, inherited.network, logger));
    close_unused(inherited, manager, logger);
    network.keep_in(manager);
    inherited.local.clear();
    inherited.network.clear();
    return Sockets{std::move(dir), std::move(listener), std::move(network)};
  }
};

// The streams of this host.
struct OwnStreams {
  OwnStreams(const Config& config, ServiceManager& manager, Logger& logger)
      : registry(config.name, stream_limits(config)),
        opens(open_limits(config)),
        store(registry, playback_clock, manager, logger) {}

  Registry registry;
  OpenTable opens;
  PlaybackClockOwner playback_clock;
  DescriptorStore store;
};

// This host's clock, the other hosts, and the copies of their streams.
struct OtherHosts {
  OtherHosts(const Config& config, const EventLoop& loop, const NetworkListener& network,
             clock::ClockPageWriter page, Registry& registry, const OpenTable& opens,
             Logger& logger)
      : own_clock(std::make_shared<wire::ClockReport>()),
        credentials(std::make_shared<wire::OwnCredentials>(
            wire::OwnCredentials{config.loaded_credentials})),
        self(own_greeting(config.name, own_clock, credentials)),
        catalog(config.name),
        clock(loop, clock_options(config), std::move(page), own_clock, self.host_id, catalog,
              logger),
        resolver(loop),
        handshakes(loop),
        parts{loop,           resolver,      registry, logger, self, &clock, config.mirror_linger,
              config.mirrors, config.sending},
        mirrors(parts, catalog),
        writers(parts, catalog),
        peers(loop, resolver, config.peers, self, catalog, logger, &handshakes),
        interfaces(loop, [this] { peers.on_network_changed(); }),
        service(loop, {self, network.addresses(), config.insecure, &clock}, registry, catalog,
                peers, mirrors, writers) {
    parts.opens = &opens;
    parts.handshakes = &handshakes;
    parts.on_ring_replaced = [this](const Stream& old) { service.on_ring_replaced(old); };
  }

  void on_their_heartbeat(const wire::Greeting& them,
                          const std::optional<clock::HeartbeatTimes>& returned) {
    clock.poll_if_due();
    if (returned) clock.add_returned_untrusted(them.host_id, *returned);
    if (PeerConnection* own = peers.connection_to(them.host_id)) own->on_their_heartbeat();
  }

  std::shared_ptr<wire::ClockReport> own_clock;
  std::shared_ptr<wire::OwnCredentials> credentials;
  wire::Greeting self;
  Catalog catalog;
  FleetClock clock;
  Resolver resolver;
  HandshakeBudget handshakes;
  ChannelParts parts;
  RemoteStreams<Mirror> mirrors;
  RemoteStreams<RemoteWriter> writers;
  Peers peers;
  // A cable that is plugged in again: a host that was away for long is tried only once a second.
  InterfaceWatch interfaces;
  FleetService service;
};

// All parts of a running dssmd. Each is constructed after those that it uses.
class Dssmd {
 public:
  // What is given by reference outlives it.
  //   stored  descriptors that the service manager kept over a restart
  Dssmd(const Config& config, EventLoop& loop, ServiceManager& manager, Sockets& sockets,
        clock::ClockPageWriter page, std::vector<NamedDescriptor> stored, LeveledLogger& logger)
      : config_(config),
        loop_(loop),
        manager_(manager),
        sockets_(sockets),
        logger_(logger),
        rights_(config.rights),
        streams_(config, manager, logger),
        hosts_(config, loop, sockets.network, std::move(page), streams_.registry, streams_.opens,
               logger),
        local_(streams_.registry, streams_.opens, streams_.playback_clock, rights_, logger,
               &hosts_.service),
        server_(loop, sockets.listener, config.name, client_limits(config), local_, logger),
        channels_({loop, streams_.registry, streams_.opens, rights_, logger, &hosts_.clock,
                   [this](const wire::Greeting& them,
                          const std::optional<clock::HeartbeatTimes>& returned) {
                     hosts_.on_their_heartbeat(them, returned);
                   },
                   config.insecure,
                   [this](const wire::SocketAddress& from, const wire::CertifiedPeer* certified) {
                     return hosts_.peers.is_configured(from, certified);
                   },
                   &streams_.playback_clock},
                  hosts_.self, peer_limits(config)),
        status_(loop, manager,
                [this] {
                  return status_text(streams_.registry, hosts_.peers, hosts_.clock,
                                     sockets_.network);
                }),
        count_(streams_.registry, status_) {
    restore(std::move(stored));
    local_.set_facts_source([this] { return facts(); });
    channels_.set_sending(config.sending);
    if (config.mdns) {
      discovery_.emplace(loop,
                         Discovery::Options{hosts_.self, reach_of(sockets.network.addresses()),
                                            config.insecure || config.loaded_credentials,
                                            config.interfaces, config.avoid_interfaces},
                         streams_.registry, hosts_.peers, logger);
    }
    hosts_.peers.on_change([this] { status_.touch(); });
    streams_.playback_clock.on_lease(
        [this] { playback_lease_.enable_in(PlaybackClockOwner::kLease); });
    hosts_.clock.on_new_generation([this] {
      channels_.send_clock();
      status_.touch();
    });
    hosts_.clock.on_change([this] {
      hosts_.mirrors.for_each([](Mirror& mirror) { mirror.on_own_clock(); });
      channels_.on_clock();
    });
  }
  Dssmd(const Dssmd&) = delete;
  Dssmd& operator=(const Dssmd&) = delete;
  ~Dssmd() {
    hosts_.peers.on_change({});
    streams_.playback_clock.on_lease({});
    hosts_.clock.on_new_generation({});
    hosts_.clock.on_change({});
  }

  // Serves until SIGTERM or SIGINT.
  //   read_again  reads the configuration file again, after SIGHUP; none: there is no file
  //   signals     blocked until now
  Result<void> run(const Reloader::Read& read_again, BlockedSignals& signals) {
    EventSource grace = EventSource::timer(loop_, [this] { streams_.registry.end_recovery(); });
    if (streams_.registry.recovery() != Registry::Recovery::over) {
      grace.enable_in(config_.recovery_grace);
    }
    if (streams_.registry.may_miss_streams()) {
      logger_.notice("programs that hold streams of the dssmd before this one give them back",
                     {.message_id = message_id::kRecovering});
    }
    channels_.serve(sockets_.network);
    if (discovery_) discovery_->start_announcing();
    EventSource stops[] = {EventSource::signal(loop_, SIGTERM, [this] { loop_.stop(); }),
                           EventSource::signal(loop_, SIGINT, [this] { loop_.stop(); })};
    for (EventSource& stop : stops) stop.enable();
    Reloader reloader(
        config_, read_again, [this](const Config& changed) { apply(changed); }, logger_);
    EventSource reload = EventSource::signal(loop_, SIGHUP, [&] {
      manager_.reloading();
      reloader.reload();
      manager_.ready(status_.now());
    });
    if (read_again) reload.enable();
    signals.deliver();
    log_ready();
    manager_.ready(status_.now());
    const Watchdog watchdog(loop_, manager_);
    DSSM_TRY(loop_.run());
    manager_.stopping();
    logger_.notice("stopping", {.message_id = message_id::kStopping});
    if (!streams_.registry.streams().empty()) sockets_.listener.leave_file();
    return {};
  }

 private:
  // Brings back the streams that the service manager kept. Programs may hold others, which they
  // need time to offer.
  void restore(std::vector<NamedDescriptor> stored) {
    const bool some_may_be_missing =
        streams_.store.restore_untrusted(std::move(stored), sockets_.network.has_kept());
    // With an inherited socket it is unknown whether a dssmd ran before this one.
    if ((sockets_.listener.found_file() || sockets_.listener.inherited()) &&
        config_.recovery_grace > Duration::zero()) {
      streams_.registry.begin_recovery(some_may_be_missing ? Registry::Recovery::streams
                                                           : Registry::Recovery::opens);
    }
  }

  void check_playback_lease() {
    const MonoTime end = streams_.playback_clock.check_lease(loop_.now());
    if (end != kNever) playback_lease_.enable_in(end - loop_.now());
  }

  // What `dssmctl info` and `dssmctl doctor` show.
  DaemonFacts facts() const {
    DaemonFacts facts;
    facts.config_file = config_.file;
    facts.clock_policy = clock_policy_;
    streams_.registry.add_limits(facts.limits);
    streams_.opens.add_limits(facts.limits);
    server_.add_limits(facts.limits);
    channels_.add_limits(facts.limits);
    return facts;
  }

  // The keys that may change while dssmd runs.
  void apply(const Config& changed) {
    logger_.set_level(changed.log_level);
    streams_.registry.set_limits(stream_limits(changed));
    streams_.opens.set_limits(open_limits(changed));
    server_.set_limits(client_limits(changed));
    channels_.set_limits(peer_limits(changed));
    hosts_.parts.mirror_linger = changed.mirror_linger;
    hosts_.parts.mirrors = changed.mirrors;
    hosts_.parts.sending = changed.sending;
    channels_.set_sending(changed.sending);
    hosts_.mirrors.for_each([](Mirror& mirror) { mirror.on_new_demand(); });
    hosts_.peers.set_configured(changed.peers);
    hosts_.clock.set(changed.clocks, changed.max_drift);
    clock_policy_ = changed.clocks.general.policy;
    use(changed);
    if (changed.rights != rights_.lines()) {
      const Rights before(rights_.lines());
      rights_.set(changed.rights);
      local_.on_new_rights(before);
      channels_.on_new_rights(before);
    }
  }

  // Running connections go on if the new ones accept the other side, too. Another folder and
  // another name count from the next start on.
  void use(const Config& changed) {
    const auto& credentials = changed.loaded_credentials;
    if (!credentials || changed.credentials != config_.credentials ||
        changed.name != config_.name) {
      return;
    }
    hosts_.credentials->now = credentials;
    logger_.info("credentials of " + credentials->own().str() + " read again");
    channels_.on_new_credentials();
    hosts_.peers.on_new_credentials();
    hosts_.mirrors.for_each([](Mirror& mirror) { mirror.connection().on_new_credentials(); });
    hosts_.writers.for_each([](RemoteWriter& writer) { writer.connection().on_new_credentials(); });
    log_problem_of_credentials();
  }

  void log_problem_of_credentials() {
    if (!hosts_.credentials->now) return;
    const std::string problem = hosts_.credentials->now->own_problem();
    if (problem.empty()) return;
    logger_.warning("credentials: other hosts will refuse this one: " + problem,
                    {.message_id = message_id::kPeerRefused});
  }

  void log_ready() {
    if (config_.insecure) {
      logger_.warning(
          "insecure = true: samples cross the network unencrypted, and any host that reaches this "
          "one can read and write all its streams",
          {.message_id = message_id::kInsecure});
    }
    log_problem_of_credentials();
    logger_.notice(fmt::format("ready, host '{}', socket '{}', {}", config_.name,
                               sockets_.dir.socket_path(), sockets_.network.str()),
                   {.message_id = message_id::kReady});
  }

  const Config& config_;
  ClockPolicy clock_policy_ = config_.clocks.general.policy;
  EventLoop& loop_;
  ServiceManager& manager_;
  Sockets& sockets_;
  LeveledLogger& logger_;
  Rights rights_;
  OwnStreams streams_;
  OtherHosts hosts_;
  LocalService local_;
  Server server_;
  ChannelServer channels_;
  StatusLine status_;
  EventSource playback_lease_ = EventSource::timer(loop_, [this] { check_playback_lease(); });
  const StreamCount count_;
  std::optional<Discovery> discovery_;
};

// read_again: reads the configuration file again; none: there is no file.
Result<void> run(const Config& config, const Reloader::Read& read_again, LeveledLogger& logger) {
  BlockedSignals signals;
  raise_descriptor_limit();
  ignore_broken_pipes();
  silence_protobuf();
  return_large_memory();
  EventLoop loop = DSSM_TRY(EventLoop::open());
  ServiceManager manager(loop, ServiceManager::notify_socket());
  Inherited inherited = Inherited::sort(take_handed_over());
  Sockets sockets = DSSM_TRY(Sockets::open(config, inherited, manager, logger));
  clock::ClockPageWriter page =
      DSSM_TRY(clock::ClockPageWriter::open(sockets.dir.clock_page_path()));
  Dssmd dssmd(config, loop, manager, sockets, std::move(page), std::move(inherited.others), logger);
  return dssmd.run(read_again, signals);
}

std::unique_ptr<LeveledLogger> open_log(LogLevel level) {
  if (stderr_is_journal()) return std::make_unique<JournalLogger>(level);
  return std::make_unique<StderrLogger>(level, false);
}

// Prints the mistakes in flags and configuration, one a line.
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
  if (!line->config.file.empty()) {
    read_again = [argc, argv]() -> Result<Config> {
      return DSSM_TRY(parse_command_line(argc, argv)).config;
    };
  }
  const bool is_service = !ServiceManager::notify_socket().empty();
  if (Result<void> ran = run(line->config, read_again, *logger); !ran) {
    logger->error(ran.error().message, {.message_id = message_id::kFailed});
    if (is_service) std::this_thread::sleep_for(kRetryPause);
    return kFailed;
  }
  return 0;
}

}  // namespace
}  // namespace dssm::daemon

int main(int argc, char** argv) { return dssm::daemon::main(argc, argv); }
