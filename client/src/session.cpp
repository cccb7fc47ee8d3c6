// SPDX-License-Identifier: Apache-2.0
//
// Session's functions as requests to dssmd: each builds one message, and turns the answer into the
// API's types. await_raw_reader() repeats an open until it succeeds or fails for good.
#include <fmt/format.h>

#include <algorithm>
#include <dssm/session.hpp>

#include "client/src/client.hpp"
#include "client/src/lockstep.hpp"
#include "client/src/states.hpp"
#include "client/src/stream_wait.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "core/wire/clock_report.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;

// Between attempts to open a stream that is missing, in lockstep.
constexpr Duration kLockstepPause = 50ms;

std::string quoted(const char* verb, const StreamId& id) {
  return fmt::format("{} '{}'", verb, id.str());
}

// The response to `request`; a failure begins with `what`.
Result<local::Response> ask(detail::Client& client, local::Request request,
                            const std::string& what) {
  return DSSM_TRY(client.connection().call(std::move(request)), what).response;
}

Result<std::vector<StreamInfo>> listed(detail::Client& client, bool own_only) {
  local::Request request;
  request.mutable_list()->set_own_only(own_only);
  const auto response = DSSM_TRY(ask(client, std::move(request), "list the streams"));
  std::vector<StreamInfo> streams;
  streams.reserve(static_cast<std::size_t>(response.stream_list().streams_size()));
  for (const proto::Stream& stream : response.stream_list().streams()) {
    streams.push_back(wire::stream_info(stream));
  }
  return streams;
}

HostInfo host_info(const local::Host& message) {
  HostInfo host;
  host.name = message.name();
  host.addresses.assign(message.addresses().begin(), message.addresses().end());
  host.version = message.version();
  host.state = wire::enum_untrusted(message.state(), HostState::closed);
  host.reason = wire::enum_untrusted(message.reason(), HostReason::namesake);
  host.since = Duration(message.since_ns());
  host.round_trip = Duration(message.round_trip_ns());
  host.min_round_trip = Duration(message.least_round_trip_ns());
  host.carried_bytes_per_s = message.carried_bytes_per_s();
  host.streams = message.streams();
  host.insecure = message.insecure();
  host.error = message.error();
  host.id = hex(message.host_id());
  if (message.has_clock()) {
    wire::ClockReport report = wire::clock_report_untrusted(message.clock(), MonoClock::now());
    host.clock = report.clock;
    host.clock_reference = std::move(report.reference);
    host.clock_distance = Duration(message.clock_distance_ns());
  }
  host.clock_reason = message.clock_reason();
  host.clock_refused = message.clock_refused();
  host.found_by.assign(message.found_by().begin(), message.found_by().end());
  return host;
}

}  // namespace

namespace detail {

Result<std::vector<std::byte>> get_property(Client& client, const StreamId& id) {
  local::Request request;
  wire::to_message(id, *request.mutable_get_property()->mutable_id());
  const auto response =
      DSSM_TRY(ask(client, std::move(request), quoted("get the property of", id)));
  const std::string& text = response.property().property();
  const auto bytes = std::as_bytes(std::span(text));
  return std::vector<std::byte>(bytes.begin(), bytes.end());
}

Result<void> set_property(Client& client, const StreamId& id, std::span<const std::byte> property) {
  const std::string what = quoted("set the property of", id);
  if (property.size() > wire::kMaxPropertyBytes) {
    return Error{
        Errc::limit_exceeded,
        fmt::format("{}: it has {} bytes, at most {} are possible; put large data into a stream",
                    what, property.size(), wire::kMaxPropertyBytes)};
  }
  local::Request request;
  wire::to_message(id, *request.mutable_set_property()->mutable_id());
  request.mutable_set_property()->set_property(property.data(), property.size());
  DSSM_TRY(ask(client, std::move(request), what));
  return {};
}

}  // namespace detail

Session::Session(std::shared_ptr<detail::Client> client) noexcept : client_(std::move(client)) {}
Session::Session(const Session&) = default;
Session& Session::operator=(const Session&) = default;
Session::Session(Session&&) noexcept = default;
Session& Session::operator=(Session&&) noexcept = default;
Session::~Session() = default;

Result<Session> Session::connect(SessionOptions options) {
  return Session(DSSM_TRY(detail::Client::connect(std::move(options))));
}

Result<RawWriter> Session::create_raw(const StreamId& id, const TypeInfo& type,
                                      const History& history, const CreateOptions& options) {
  const std::string what = quoted("create", id);
  DSSM_TRY(id.check(), what);
  DSSM_TRY(type.check(), what);
  local::Request request;
  wire::to_message(id, type, history, *request.mutable_create());
  request.mutable_create()->set_tag(options.tag);
  request.mutable_create()->set_keep_existing(options.keep_existing);
  auto stream = DSSM_TRY(client_->open(std::move(request), Role::writer, options.tag), what);
  return RawWriter(std::make_unique<detail::WriterState>(std::move(stream)));
}

Result<RawWriter> Session::open_raw_writer(const StreamId& id, const TypeInfo* wanted,
                                           std::uint32_t tag) {
  const std::string what = quoted("open", id) + " for writing";
  auto stream = DSSM_TRY(client_->open_writer(id, tag), what);
  if (!wanted) return RawWriter(std::make_unique<detail::WriterState>(std::move(stream)));
  DSSM_TRY(stream->type.check_usable_as(*wanted), what);
  if (stream->type.is_less_described_than(*wanted)) {
    const Result<DaemonInfo> daemon = daemon_info();
    const ring::RingMapping& ring = *stream->ring->mapping;
    const History history{ring.geometry().depth, ring.identity().cycle};
    if (daemon && daemon->host == stream->id.host) {
      // Creating what exists opens it, and takes a type along. Without, writing works as well.
      Result<RawWriter> writer =
          create_raw(stream->id, *wanted, history, {.keep_existing = true, .tag = tag});
      if (writer) return writer;
    }
  }
  return RawWriter(std::make_unique<detail::WriterState>(std::move(stream)));
}

Result<RawReader> Session::open_raw_reader(const StreamId& id, const TypeInfo* wanted,
                                           std::uint32_t tag, FetchHistory history) {
  const std::string what = quoted("open", id);
  auto stream = DSSM_TRY(client_->open_reader(id, tag, history), what);
  if (wanted) DSSM_TRY(stream->type.check_usable_as(*wanted), what);
  return RawReader(std::make_unique<detail::ReaderState>(std::move(stream)));
}

Result<RawReader> Session::await_raw_reader(const StreamId& id, MonoTime deadline,
                                            const TypeInfo* wanted, FetchHistory history) {
  std::mutex mutex;
  std::condition_variable added;
  detail::StreamWait wait(id, MonoClock::now());  // guarded by the mutex
  const auto on_event = [&](const StreamEvent& event) {
    if (event.kind != StreamEvent::Kind::added || !wait.is_about(event.stream.id)) return;
    const std::lock_guard guard(mutex);
    wait.added();
    added.notify_one();
  };
  const Watch watching = DSSM_TRY(watch(on_event), quoted("wait for", id));
  std::unique_lock lock(mutex);
  for (;;) {
    wait.begin_attempt();
    lock.unlock();
    auto reader = open_raw_reader(id, wanted, 0, history);
    if (reader || !is_retryable(reader.error().code)) return reader;
    lock.lock();
    wait.failed(reader.error(), true, MonoClock::now());
    for (MonoTime now = MonoClock::now(); now < wait.next_attempt(); now = MonoClock::now()) {
      if (now >= deadline) return std::move(reader).error();
      if (now >= wait.next_notice()) {
        lock.unlock();
        const std::vector<StreamId> known = client_->watches().known_ids();
        client_->notice(wait.take_notice(now, known));
        lock.lock();
        continue;
      }
      if (detail::Lockstep* const lockstep = detail::Lockstep::of_process()) {
        // When an event arrives is not the same each time, the playback time is.
        lock.unlock();
        const auto never = [] { return false; };
        // Nor is how long this thread takes until it waits.
        const auto slept = deadline - now > kLockstepPause
                               ? lockstep->wait_for(kLockstepPause, never)
                               : lockstep->wait_until(deadline, never);
        lock.lock();
        if (slept) break;
      }
      const MonoTime next = std::min({deadline, wait.next_attempt(), wait.next_notice()});
      if (next == kNever) {
        added.wait(lock);
      } else {
        added.wait_until(lock, next);
      }
    }
  }
}

Result<void> Session::remove(const StreamId& id) {
  local::Request request;
  wire::to_message(id, *request.mutable_remove()->mutable_id());
  DSSM_TRY(ask(*client_, std::move(request), quoted("remove", id)));
  return {};
}

Result<std::vector<StreamInfo>> Session::list_streams() { return listed(*client_, false); }

Result<std::vector<StreamInfo>> Session::list_own_streams() { return listed(*client_, true); }

Result<StreamInfo> Session::stream_info(const StreamId& id) {
  local::Request request;
  wire::to_message(id, *request.mutable_info()->mutable_id());
  const auto response =
      DSSM_TRY(ask(*client_, std::move(request), quoted("get information on", id)));
  if (response.stream_list().streams_size() != 1) {
    return Error{Errc::protocol,
                 quoted("get information on", id) + ": dssmd's answer does not contain the stream"};
  }
  return wire::stream_info(response.stream_list().streams(0));
}

Result<StreamRights> Session::stream_rights(const StreamId& id) {
  local::Request request;
  wire::to_message(id, *request.mutable_list_rights()->mutable_id());
  const auto response =
      DSSM_TRY(ask(*client_, std::move(request), quoted("get the rights of", id)));
  const local::RightList& list = response.right_list();
  StreamRights rights{list.restricted(), list.own_verbs(), {}};
  for (const local::Right& right : list.rights()) {
    rights.lines.push_back({right.line(), right.verbs()});
  }
  return rights;
}

struct Session::Watch::State {
  std::shared_ptr<detail::Client> client;
  std::uint64_t key;
  ~State() { client->watches().remove(key); }
};

Session::Watch::Watch(std::unique_ptr<State> state) noexcept : state_(std::move(state)) {}
Session::Watch::Watch(Watch&&) noexcept = default;
Session::Watch& Session::Watch::operator=(Watch&&) noexcept = default;
Session::Watch::~Watch() = default;

Result<Session::Watch> Session::watch(std::function<void(const StreamEvent&)> on_event) {
  const std::uint64_t key =
      DSSM_TRY(client_->watches().add(std::move(on_event)), "watch the streams");
  return Watch(std::unique_ptr<Watch::State>(new Watch::State{client_, key}));
}

Result<void> Session::set_property(const StreamId& id, std::span<const std::byte> property) {
  return detail::set_property(*client_, id, property);
}

Result<std::vector<std::byte>> Session::property(const StreamId& id) {
  return detail::get_property(*client_, id);
}

Result<void> Session::describe(const StreamId& id, const TypeInfo& type, bool replace) {
  const std::string what = quoted("describe", id);
  DSSM_TRY(type.check(), what);
  local::Request request;
  proto::Describe& describe = *request.mutable_describe();
  wire::to_message(id, *describe.mutable_id());
  wire::to_message(type, *describe.mutable_type());
  describe.set_replace(replace);
  DSSM_TRY(ask(*client_, std::move(request), what));
  return {};
}

Result<std::vector<HostInfo>> Session::list_hosts() {
  local::Request request;
  request.mutable_list_hosts();
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "list the hosts"));
  std::vector<HostInfo> hosts;
  for (const local::Host& host : response.host_list().hosts()) {
    hosts.push_back(host_info(host));
  }
  return hosts;
}

Result<std::vector<NodeInfo>> Session::list_nodes() {
  local::Request request;
  request.mutable_list_nodes();
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "list the processes"));
  std::vector<NodeInfo> nodes;
  for (const proto::Node& message : response.node_list().nodes()) {
    NodeInfo node{message.host(), message.pid(), {}, message.program(), {}, message.error()};
    if (message.has_uid()) node.uid = message.uid();
    for (const proto::NodeStream& use : message.streams()) {
      node.streams.push_back({{use.id().name(), use.id().id(), use.id().host()},
                              use.writer() ? Role::writer : Role::reader,
                              wire::enum_untrusted(use.via(), StreamVia::connection)});
    }
    nodes.push_back(std::move(node));
  }
  return nodes;
}

Result<std::vector<ClockPair>> Session::list_clock_pairs() {
  local::Request request;
  request.mutable_list_clock_pairs();
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "list the pairs of clocks"));
  std::vector<ClockPair> pairs;
  for (const proto::ClockPair& pair : response.clock_pair_list().pairs()) {
    pairs.push_back(wire::clock_pair_untrusted(pair));
  }
  return pairs;
}

Result<std::vector<PlaybackFollower>> Session::share_playback_clock(std::uint64_t driver,
                                                                    bool ends) {
  local::Request request;
  request.mutable_follow_playback()->set_driver(driver);
  request.mutable_follow_playback()->set_ends(ends);
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "share the playback clock"));
  std::vector<PlaybackFollower> followers;
  for (const proto::PlaybackFollower& each : response.playback_followers().followers()) {
    PlaybackFollower& follower = followers.emplace_back();
    follower.host = each.host();
    if (each.has_failure()) follower.error = wire::failure(each.failure());
  }
  return followers;
}

Result<void> Session::hold_playback_clock(std::uint64_t driver, bool ends) {
  local::Request request;
  request.mutable_follow_playback()->set_driver(driver);
  request.mutable_follow_playback()->set_ends(ends);
  request.mutable_follow_playback()->set_this_host(true);
  DSSM_TRY(ask(*client_, std::move(request), "take the playback clock"));
  return {};
}

Result<RoundTrip> Session::ping(const std::string& host) {
  local::Request request;
  request.mutable_ping_host()->set_host(host);
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "ping '" + host + "'"));
  const local::RoundTrip& round_trip = response.round_trip();
  return RoundTrip{Duration(round_trip.round_trip_ns()), round_trip.address()};
}

Result<PlaybackClock> Session::open_playback_clock() {
  auto record = DSSM_TRY(client_->open_playback_clock(), "open the playback clock");
  return PlaybackClock(
      std::make_shared<detail::PlaybackClockState>(detail::PlaybackClockState{std::move(record)}));
}

Result<std::vector<ClientInfo>> Session::list_clients() {
  local::Request request;
  request.mutable_list_clients();
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "list the processes"));
  std::vector<ClientInfo> clients;
  for (const local::Client& client : response.client_list().clients()) {
    clients.push_back({client.pid(), client.uid(), client.program()});
  }
  return clients;
}

Result<std::vector<OpenInfo>> Session::list_opens() {
  local::Request request;
  request.mutable_list_opens();
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "list the open streams"));
  std::vector<OpenInfo> opens;
  for (const local::OpenEntry& entry : response.open_list().opens()) {
    opens.push_back({{entry.id().name(), entry.id().id(), entry.id().host()},
                     entry.creator_pid(),
                     entry.opener_pid(),
                     entry.tag(),
                     entry.for_writing() ? Role::writer : Role::reader});
  }
  return opens;
}

Result<DaemonInfo> Session::daemon_info() {
  local::Request request;
  request.mutable_get_daemon();
  const auto response = DSSM_TRY(ask(*client_, std::move(request), "ask dssmd about itself"));
  const local::Daemon& daemon = response.daemon();
  const local::Mdns& mdns = daemon.mdns();
  std::optional<CredentialsInfo> credentials;
  if (daemon.has_credentials()) {
    const local::Credentials& own = daemon.credentials();
    credentials = {own.name(), time_from_ns(own.valid_until_ns()), own.problem()};
  }
  std::vector<LimitInfo> limits;
  for (const local::LimitUse& one : daemon.limits()) {
    limits.push_back({one.name(), one.used(), one.limit(), one.unit()});
  }
  return DaemonInfo{
      daemon.host(),
      daemon.version(),
      daemon.pid(),
      daemon.streams(),
      daemon.memory_bytes(),
      daemon.memory_limit_bytes(),
      {wire::enum_untrusted(mdns.phase(), MdnsPhase::running), mdns.error(), mdns.avahi_version(),
       mdns.announced(), mdns.withheld(), mdns.own_host_seen(), mdns.hosts_heard()},
      std::move(credentials),
      std::move(limits),
      daemon.config_file(),
      daemon.clock_policy(),
      daemon.playback_driver()};
}

bool Session::is_connected() const noexcept { return client_->connection().is_up(); }

}  // namespace dssm
