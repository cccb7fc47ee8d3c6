// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/fleet_service.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <new>
#include <set>
#include <tuple>
#include <utility>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/memory_budget.hpp"

namespace dssm::daemon {
namespace {

StreamId owned_by(const KnownHost& host, const StreamId& id) {
  return {id.name, id.id, host.greeting.host};
}

// Takes over what `host` reports about one of its streams: afterwards every value is valid.
Result<proto::Stream> stream_untrusted(const std::string& host, proto::Stream stream) {
  stream.mutable_id()->set_host(host);  // no host reports streams of another one
  DSSM_TRY(wire::stream_id_untrusted(stream.id()));
  DSSM_TRY(wire::type_untrusted(stream.type()));
  for (proto::User& user : *stream.mutable_users()) {
    wire::to_message(wire::stream_user_untrusted(user), user);
  }
  stream.clear_mirror();  // this host reports that
  return stream;
}

Error unexpected(const std::string& host) {
  return {Errc::protocol, fmt::format("host '{}' sent a response of another kind", host)};
}

// What one host states of the clocks of others.
struct ClockRow {
  std::string reader;
  Result<std::vector<ClockPair>> pairs = std::vector<ClockPair>();
};

Error has_not_answered(const std::string& host) {
  return {Errc::unavailable, fmt::format("host '{}' has not answered within {} ms", host,
                                         Fleet::kFreshTimeout / std::chrono::milliseconds(1))};
}

// Adds what `host` answered to ListNodes. It knows what its own processes use, and who uses its own
// streams.
Result<void> add_nodes_untrusted(const std::string& host, const Result<net::Frame>& answer,
                                 NodeTable& nodes) {
  if (!answer) return answer.error();
  if (!answer->has_node_list()) return unexpected(host);
  for (const proto::Node& node : answer->node_list().nodes()) {
    if (!check_host_name(node.host())) continue;
    StreamUser user;
    user.host = node.host();
    user.pid = std::max(node.pid(), 0);
    if (node.has_uid()) user.uid = node.uid();
    user.program = wire::text_untrusted(node.program(), wire::kMaxProgramBytes);
    for (const proto::NodeStream& use : node.streams()) {
      const Result<StreamId> id = wire::stream_id_untrusted(use.id());
      if (!id || id->host.empty() || (user.host != host && id->host != host)) continue;
      user.role = use.writer() ? Role::writer : Role::reader;
      user.via = wire::enum_untrusted(use.via(), StreamVia::connection);
      nodes.add(user, *id);
    }
  }
  return {};
}

// The answer of `host` to ListClockPairs.
Result<std::vector<ClockPair>> clock_pairs_untrusted(const std::string& host,
                                                     const Result<net::Frame>& answer) {
  if (!answer) return answer.error();
  if (!answer->has_clock_pair_list()) return unexpected(host);
  std::vector<ClockPair> pairs;
  for (const proto::ClockPair& message : answer->clock_pair_list().pairs()) {
    if (pairs.size() == wire::kMaxClockPairs) break;
    ClockPair pair = wire::clock_pair_untrusted(message);
    if (pair.owner.empty()) continue;
    pair.error.clear();  // only clock_matrix() states one
    pairs.push_back(std::move(pair));
  }
  return pairs;
}

ClockPair unknown_pair(const std::string& reader, const std::string& owner,
                       const std::string& error) {
  ClockPair pair;
  pair.reader = reader;
  pair.owner = owner;
  pair.error = wire::text_untrusted(error, wire::kMaxSentenceBytes);
  return pair;
}

// All pairs of `rows`, by reader, then owner. Each host has its own peers, so a row may lack a host
// that has one itself.
std::vector<ClockPair> clock_matrix(const std::vector<ClockRow>& rows) {
  std::vector<ClockPair> all;
  for (const auto& [reader, pairs] : rows) {
    if (!pairs) {
      all.push_back(unknown_pair(reader, {}, pairs.error().message));
      continue;
    }
    std::set<std::string> owners = {reader};
    for (const ClockPair& pair : *pairs) {
      owners.insert(pair.owner);
      all.push_back(pair);
      all.back().reader = reader;
    }
    for (const ClockRow& other : rows) {
      if (!owners.insert(other.reader).second) continue;
      all.push_back(unknown_pair(
          reader, other.reader,
          fmt::format("'{}' has no connection to '{}'; see `dssmctl hosts` and the key peers there",
                      reader, other.reader)));
    }
  }
  std::stable_sort(all.begin(), all.end(), [](const ClockPair& a, const ClockPair& b) {
    return std::tie(a.reader, a.owner) < std::tie(b.reader, b.owner);
  });
  return all;
}

// The request that has the owner of `id` do what a program asks for.
net::Frame network_request(const StreamId& id, const local::Request& request) {
  net::Frame frame;
  proto::StreamId* named = nullptr;
  switch (request.body_case()) {
    case local::Request::kRemove:
      named = frame.mutable_remove()->mutable_id();
      break;
    case local::Request::kGetProperty:
      named = frame.mutable_get_property()->mutable_id();
      break;
    case local::Request::kSetProperty:
      frame.mutable_set_property()->set_property(request.set_property().property());
      named = frame.mutable_set_property()->mutable_id();
      break;
    case local::Request::kDescribe:
      *frame.mutable_describe() = request.describe();
      named = frame.mutable_describe()->mutable_id();
      break;
    default:  // Info
      named = frame.mutable_info()->mutable_id();
  }
  wire::to_message(id, *named);
  return frame;
}

}  // namespace

FleetService::FleetService(const EventLoop& loop, Self self, const Registry& registry,
                           Catalog& catalog, Peers& peers, RemoteStreams<Mirror>& mirrors,
                           RemoteStreams<RemoteWriter>& writers)
    : loop_(loop),
      self_(std::move(self)),
      registry_(registry),
      catalog_(catalog),
      peers_(peers),
      mirrors_(mirrors),
      writers_(writers),
      list_timer_(EventSource::timer(loop, [this] { on_list_timeout(); })),
      early_turn_(EventSource::timer(loop, [this] { answer_early(); })) {
  catalog_.add_observer(*this);
  peers_.on_startup_over([this] { answer_early(); });
}

FleetService::~FleetService() {
  peers_.on_startup_over({});
  catalog_.remove_observer(*this);
}

// --- finding owners

void FleetService::when_known(const StreamId& id, std::size_t bytes, std::function<void()> go_on) {
  const bool known = !id.host.empty() && catalog_.find_host(id.host);
  const bool is_full = early_.size() >= kMaxEarlyRequests || early_bytes_ + bytes > kMaxEarlyBytes;
  if (known || peers_.startup_is_over() || is_full) return go_on();
  early_.push_back({std::move(go_on), bytes});
  early_bytes_ += bytes;
}

void FleetService::answer_early() {
  for (int answered = 0; answered < kEarlyPerTurn && !early_.empty(); ++answered) {
    const Early next = std::move(early_.front());
    early_.pop_front();
    early_bytes_ -= next.bytes;
    next.go_on();
  }
  if (!early_.empty()) early_turn_.enable_in(Duration::zero());
}

// What is not found may be at a peer that is unavailable.
Error FleetService::with_unavailable_peers(Error error) const {
  if (error.code != Errc::not_found) return error;
  if (const std::string unavailable = peers_.report().unavailable_peers(); !unavailable.empty()) {
    error.message += "; not answering at the moment: " + unavailable;
  }
  return error;
}

// The mirror of a stream whose owner is unavailable: its history is still here. While the owner is
// available, its own answer about the stream counts.
Mirror* FleetService::mirror_without_owner(const StreamId& id) const {
  Mirror* mirror = mirrors_.find(id);
  if (!mirror) return nullptr;
  const Result<const KnownHost*> owner = catalog_.find_host(mirror->id().host);
  return !owner && owner.error().code == Errc::not_found ? mirror : nullptr;
}

void FleetService::open_reader(const StreamId& id, bool history, const std::string& account,
                               Then<std::shared_ptr<Stream>> then) {
  const Result<const KnownHost*> owner = catalog_.find_owner(id);
  if (owner) {
    const StreamId named = owned_by(**owner, id);
    const auto want = [&] {
      Mirror* mirror = history ? mirrors_.find(named) : nullptr;
      if (mirror) mirror->want_history();
    };
    want();  // so that open() waits for it
    mirrors_.open(
        **owner, id, nullptr,
        [this, named, history, then = std::move(then)](Result<OpenedRing> ring) {
          if (!ring) return then(std::move(ring).error());
          then(for_reader(named, history, std::move(ring->stream)));
        },
        account, history);
    return want();  // of a new mirror, which is not connected yet
  }
  if (Mirror* mirror = mirror_without_owner(id)) {
    if (std::shared_ptr<Stream> stream = mirror->acquire()) {
      return then(for_reader(mirror->id(), history, std::move(stream)));
    }
  }
  then(with_unavailable_peers(owner.error()));
}

// The ring of the mirror `id`, as a reader holds it.
std::shared_ptr<Stream> FleetService::for_reader(const StreamId& id, bool history,
                                                 std::shared_ptr<Stream> ring) const {
  Mirror* mirror = history ? mirrors_.find(id) : nullptr;
  return mirror ? mirror->with_history(ring) : ring;
}

void FleetService::want_history(const StreamId& id) {
  if (Mirror* mirror = mirrors_.find(id)) mirror->want_history();
}

void FleetService::open_writer(const StreamId& id, const CreatePlan* plan,
                               const std::string& account, Then<OpenedRing> then) {
  const Result<const KnownHost*> owner = catalog_.find_owner(id);
  if (!owner) return then(with_unavailable_peers(owner.error()));
  writers_.open(**owner, id, plan, std::move(then), account);
}

Result<std::shared_ptr<Stream>> FleetService::adopt_untrusted(const StreamId& id, Role role,
                                                              OfferedFiles files, bool history,
                                                              const std::string& account) {
  if (role == Role::writer) return writers_.adopt_untrusted(id, std::move(files), account);
  return for_reader(id, history, DSSM_TRY(mirrors_.adopt_untrusted(id, std::move(files), account)));
}

// --- about one stream

// Info of a mirror whose owner is unavailable; nullopt: there is none.
std::optional<local::Response> FleetService::describe_mirror(const StreamId& id) const {
  local::Response response;
  const Mirror* mirror = mirror_without_owner(id);
  if (!mirror || !mirror->describe_stream(*response.mutable_stream_list()->add_streams())) {
    return std::nullopt;
  }
  return response;
}

void FleetService::forward(const StreamId& id, const local::Request& request,
                           Then<local::Response> then) {
  const Result<const KnownHost*> owner = catalog_.find_owner(id);
  if (!owner) {
    // Info of a mirror whose owner is unavailable comes from here.
    auto mirror = request.has_info() ? describe_mirror(id) : std::nullopt;
    return mirror ? then(*std::move(mirror)) : then(with_unavailable_peers(owner.error()));
  }
  const StreamId named = owned_by(**owner, id);
  // A host in the catalog has a connection.
  peers_.connection_to((*owner)->greeting.host_id)
      ->ask(network_request(named, request), [this, named, body = request.body_case(),
                                              then = std::move(then)](Result<net::Frame> answer) {
        if (answer) return then(response_to(body, named, *std::move(answer)));
        auto mirror = body == local::Request::kInfo ? describe_mirror(named) : std::nullopt;
        mirror ? then(*std::move(mirror)) : then(std::move(answer).error());
      });
}

Result<local::Response> FleetService::response_to(local::Request::BodyCase request,
                                                  const StreamId& id, net::Frame answer) const {
  local::Response response;
  switch (request) {
    case local::Request::kInfo: {
      if (answer.stream_list().streams_size() != 1) return unexpected(id.host);
      proto::Stream& stream = *response.mutable_stream_list()->add_streams();
      stream = DSSM_TRY(
          stream_untrusted(id.host, std::move(*answer.mutable_stream_list()->mutable_streams(0))));
      if (const Mirror* mirror = mirrors_.find(id)) mirror->describe(*stream.mutable_mirror());
      break;
    }
    case local::Request::kGetProperty:
      *response.mutable_property() = std::move(*answer.mutable_property());
      break;
    default:
      response.mutable_done();
  }
  return response;
}

// --- lists

std::vector<const KnownHost*> FleetService::hosts_by_name() const {
  std::vector<const KnownHost*> hosts;
  for (const auto& [id, host] : catalog_.hosts()) hosts.push_back(&host);
  std::stable_sort(hosts.begin(), hosts.end(), [](const KnownHost* one, const KnownHost* other) {
    return one->greeting.host < other->greeting.host;
  });
  return hosts;
}

const StreamInfo* FleetService::next_stream(const StreamId& id) const {
  const auto place = [](const StreamId& of) { return std::tie(of.host, of.name, of.id); };
  const StreamInfo* next = nullptr;
  for (const auto& [host_id, host] : catalog_.hosts()) {
    if (host.greeting.host < id.host) continue;
    const auto stream = host.greeting.host == id.host ? host.streams.upper_bound({id.name, id.id})
                                                      : host.streams.begin();
    if (stream == host.streams.end()) continue;
    if (!next || place(stream->second.id) < place(next->id)) next = &stream->second;
  }
  return next;
}

// Calls `then` when all have answered, or at the timeout; `fail` besides when that found no memory.
void FleetService::ask_all(const net::Frame& request, std::function<void(Answers)> then,
                           std::function<void(const Error&)> fail) {
  const auto listing = std::make_shared<Listing>();
  listing->then = std::move(then);
  listing->fail = std::move(fail);
  listing->deadline = loop_.deadline_in(kFreshTimeout);
  listing->unanswered = catalog_.hosts().size() + 1;  // this function is one of them until its end
  for (const auto& [id, host] : catalog_.hosts()) {
    peers_.connection_to(id)->ask(request, [listing, host_id = id](Result<net::Frame> answer) {
      if (!listing->done) listing->answers.emplace(host_id, std::move(answer));
      if (--listing->unanswered == 0) finish(*listing);
    });
  }
  if (--listing->unanswered == 0) return finish(*listing);
  listings_.push_back(listing);
  if (listings_.size() == 1) list_timer_.enable_in(kFreshTimeout);
}

void FleetService::finish(Listing& listing) {
  if (std::exchange(listing.done, true)) return;
  const auto then = std::exchange(listing.then, {});
  const auto fail = std::exchange(listing.fail, {});
  try {
    then(std::exchange(listing.answers, {}));
  } catch (const std::bad_alloc&) {  // a list may be long, and this may be a timer's callback
    fail(no_memory_left());
  }
}

// One in a turn of the loop: each may be long, and a program may ask for many.
void FleetService::on_list_timeout() {
  while (!listings_.empty() && listings_.front()->done) listings_.pop_front();
  if (listings_.empty()) return;
  const std::shared_ptr<Listing> first = listings_.front();
  if (const Duration left = first->deadline - loop_.now(); left > Duration::zero()) {
    return list_timer_.enable_in(left);
  }
  listings_.pop_front();
  finish(*first);
  if (!listings_.empty()) list_timer_.enable_in(Duration::zero());
}

// With what has arrived, and with the catalog for hosts that have not answered.
void FleetService::list(Then<std::vector<proto::Stream>> then) {
  net::Frame request;
  request.mutable_list();
  auto all = [this, then](Answers answers) {
    std::vector<proto::Stream> streams;
    for (const KnownHost* host : hosts_by_name()) {
      const auto answer = answers.find(host->greeting.host_id);
      if (answer == answers.end() || !answer->second) {
        for (const auto& [key, stream] : host->streams)
          wire::to_message(stream, streams.emplace_back());
        continue;
      }
      for (proto::Stream& message : *answer->second->mutable_stream_list()->mutable_streams()) {
        Result<proto::Stream> stream = stream_untrusted(host->greeting.host, std::move(message));
        if (stream) streams.push_back(*std::move(stream));
      }
    }
    for (proto::Stream& stream : streams) {
      const Result<StreamId> id = wire::stream_id_untrusted(stream.id());
      const Mirror* mirror = id ? mirrors_.find(*id) : nullptr;
      if (mirror) mirror->describe(*stream.mutable_mirror());
    }
    then(std::move(streams));
  };
  ask_all(request, std::move(all), std::move(then));
}

void FleetService::list_nodes(NodeTable nodes, std::function<void(NodeTable)> then) {
  net::Frame request;
  request.mutable_list_nodes();
  auto all = [this, nodes = std::move(nodes), then](const Answers& answers) mutable {
    for (const KnownHost* host : hosts_by_name()) {
      const std::string& name = host->greeting.host;
      const auto answer = answers.find(host->greeting.host_id);
      const Result<void> added = answer == answers.end()
                                     ? Result<void>(has_not_answered(name))
                                     : add_nodes_untrusted(name, answer->second, nodes);
      if (added) continue;
      nodes.add_unknown(name, wire::text_untrusted(added.error().message, wire::kMaxSentenceBytes));
    }
    then(std::move(nodes));
  };
  ask_all(request, std::move(all), [this, then = std::move(then)](const Error& error) {
    NodeTable none(self_.greeting.host);
    none.add_unknown(self_.greeting.host, error.message);
    then(std::move(none));
  });
}

void FleetService::follow_playback(const proto::FollowPlayback& follow,
                                   Then<proto::PlaybackFollowers> then) {
  net::Frame request;
  *request.mutable_follow_playback() = follow;
  auto all = [this, then](const Answers& answers) {
    proto::PlaybackFollowers followers;
    for (const KnownHost* host : hosts_by_name()) {
      proto::PlaybackFollower& follower = *followers.add_followers();
      follower.set_host(host->greeting.host);
      const auto answer = answers.find(host->greeting.host_id);
      if (answer == answers.end()) {
        wire::to_message(has_not_answered(host->greeting.host), *follower.mutable_failure());
      } else if (!answer->second) {
        wire::to_message(answer->second.error(), *follower.mutable_failure());
      }
    }
    then(std::move(followers));
  };
  ask_all(request, std::move(all), std::move(then));
}

void FleetService::list_clock_pairs(std::function<void(std::vector<ClockPair>)> then) {
  net::Frame request;
  request.mutable_list_clock_pairs();
  auto all = [this, then](const Answers& answers) {
    std::vector<ClockRow> rows(1);
    rows.front().reader = self_.greeting.host;
    if (self_.clock) rows.front().pairs = self_.clock->clock_pairs();
    for (const KnownHost* host : hosts_by_name()) {
      const auto answer = answers.find(host->greeting.host_id);
      rows.push_back(
          {host->greeting.host, answer == answers.end()
                                    ? has_not_answered(host->greeting.host)
                                    : clock_pairs_untrusted(host->greeting.host, answer->second)});
    }
    then(clock_matrix(rows));
  };
  ask_all(request, std::move(all), [this, then = std::move(then)](const Error& error) {
    then({unknown_pair(self_.greeting.host, {}, error.message)});
  });
}

// --- hosts

std::vector<local::Host> FleetService::hosts() const {
  std::vector<local::Host> hosts(1);
  local::Host& self = hosts.front();
  self.set_name(self_.greeting.host);
  self.set_host_id(self_.greeting.host_id.data(), self_.greeting.host_id.size());
  for (const std::string& address : self_.addresses) self.add_addresses(address);
  self.set_version(self_.greeting.version);
  self.set_state(local::Host::SELF);
  self.set_streams(static_cast<std::uint32_t>(registry_.streams().size()));
  wire::send_clock(self_.greeting, *self.mutable_clock());
  self.set_insecure(self_.insecure);
  const PeerReport report = peers_.report();
  const PeerProblem warning = report.own_warning();
  self.set_reason(static_cast<local::Host::Reason>(warning.reason));
  self.set_error(warning.text);
  self.set_clock_distance_ns(0);
  for (local::Host& host : report.hosts()) {
    state_clock(host);
    hosts.push_back(std::move(host));
  }
  return hosts;
}

// How far its clock is from this PC's, and whether its samples' times are good here.
void FleetService::state_clock(local::Host& host) const {
  host.set_clock_distance_ns(to_ns(kUnknownClockError));
  wire::HostId id{};
  if (!self_.clock || host.host_id().size() != id.size()) return;
  std::copy(host.host_id().begin(), host.host_id().end(), id.begin());
  const KnownHost* known = catalog_.find(id);
  if (!known) return;
  const wire::ClockReport* clock = known->greeting.clock.get();
  if (clock) host.set_clock_distance_ns(to_ns(self_.clock->distance_to(*clock)));
  if (host.state() != local::Host::UP) return;
  host.set_clock_reason(self_.clock->reason_against(clock));
  host.set_clock_refused(!host.clock_reason().empty() && self_.clock->refuses());
}

Result<UniqueFd> FleetService::clock_page() const {
  if (self_.clock) return self_.clock->page_for_reading();
  return Error{Errc::not_found, "this dssmd does not watch the clock"};
}

void FleetService::describe(local::Daemon& daemon) const {
  *daemon.mutable_mdns() = mdns();
  const auto credentials = wire::credentials_of(self_.greeting);
  if (!credentials) return;
  local::Credentials& own = *daemon.mutable_credentials();
  own.set_name(credentials->own().str());
  own.set_valid_until_ns(to_ns(credentials->own_valid_until()));
  own.set_problem(credentials->own_problem());
}

local::Mdns FleetService::mdns() const {
  const MdnsInfo& state = peers_.mdns();
  local::Mdns mdns;
  mdns.set_phase(static_cast<local::Mdns::Phase>(state.phase));
  mdns.set_error(printable(state.error));
  mdns.set_avahi_version(printable(state.avahi_version));
  mdns.set_announced(state.announced);
  mdns.set_withheld(state.withheld);
  mdns.set_own_host_seen(state.own_host_seen);
  mdns.set_hosts_heard(state.hosts_heard);
  return mdns;
}

void FleetService::ping(const std::string& host, Then<local::RoundTrip> then) {
  const Result<const KnownHost*> known = catalog_.find_host(host);
  if (!known) return then(with_unavailable_peers(known.error()));
  PeerConnection& link = *peers_.connection_to((*known)->greeting.host_id);
  net::Frame request;
  wire::send_clock(self_.greeting, *request.mutable_ping()->mutable_clock());
  link.ask(std::move(request), [address = link.address(), &loop = loop_, sent = loop_.now(),
                                then = std::move(then)](Result<net::Frame> answer) {
    if (!answer) return then(std::move(answer).error());
    local::RoundTrip round_trip;
    round_trip.set_round_trip_ns(to_ns(loop.now() - sent));
    round_trip.set_address(address);
    then(std::move(round_trip));
  });
}

// --- events

void FleetService::on_remote_stream_added(const KnownHost&, const StreamInfo& stream) {
  if (observer_) observer_->on_remote_stream_added(stream);
}

void FleetService::on_remote_property_set(const StreamInfo& stream) {
  if (observer_) observer_->on_remote_property_set(stream);
}

void FleetService::on_remote_stream_removed(const KnownHost&, const StreamInfo& stream) {
  if (observer_) observer_->on_remote_stream_removed(stream.id);
}

}  // namespace dssm::daemon
