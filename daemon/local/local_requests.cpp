// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/local_requests.hpp"

#include <unistd.h>

#include <utility>

#include "core/base/try.hpp"
#include "core/wire/clock_report.hpp"
#include "daemon/service/config_values.hpp"

namespace dssm::daemon {
namespace {

// Of a StreamList; the rest of a frame is for the response around it.
constexpr std::size_t kMaxLocalListBytes = wire::kMaxLocalFrameBytes - (1U << 20);

Role role_of(bool for_writing) noexcept { return for_writing ? Role::writer : Role::reader; }

// The descriptors of the oldest message that brought any.
std::vector<UniqueFd> take_descriptors(DescriptorQueue& queue) {
  if (queue.empty()) return {};
  std::vector<UniqueFd> taken = std::move(queue.front());
  queue.pop_front();
  return taken;
}

// The memory files of an Offer, from its descriptors.
//   fails  protocol: some are missing
Result<OfferedFiles> offered_files(DescriptorQueue& queue, Role role) {
  std::vector<UniqueFd> offered = take_descriptors(queue);
  if (offered.size() < 3) {
    return Error{Errc::protocol, "the request comes without its descriptors (ring, bell, meta)"};
  }
  OfferedFiles files{std::move(offered[0]), std::move(offered[1]), std::move(offered[2]), {}, 0};
  if (offered.size() > 3 && role == Role::writer) files.doorbell = std::move(offered[3]);
  return files;
}

// Adds the other hosts' streams to the list of the own ones.
Result<Reply> with_streams(Reply reply, std::vector<proto::Stream> streams) {
  proto::StreamList& list = *reply.response.mutable_stream_list();
  std::size_t bytes = list.ByteSizeLong();
  for (proto::Stream& stream : streams) {
    if (bytes + stream.ByteSizeLong() > kMaxLocalListBytes) stream.mutable_type()->clear_fields();
    bytes += stream.ByteSizeLong();
    if (bytes > kMaxLocalListBytes) {
      return Error{Errc::limit_exceeded,
                   "the list of all hosts' streams is longer than one message may be; ask for "
                   "those of this host only"};
    }
    *list.add_streams() = std::move(stream);
  }
  return reply;
}

Reply done() {
  Reply reply;
  reply.response.mutable_done();
  return reply;
}

}  // namespace

LocalRequests::LocalRequests(Registry& registry, OpenTable& opens, PlaybackClockOwner& clock,
                             const Rights& rights, Fleet* fleet)
    : registry_(registry),
      opens_(opens),
      clock_(clock),
      rights_(rights),
      fleet_(fleet),
      catalog_(registry, opens, kMaxLocalListBytes) {}

// An id without a host belongs to this one if it has such a stream.
bool LocalRequests::is_elsewhere(const StreamId& id) const {
  if (!fleet_) return false;
  return id.host.empty() ? !registry_.knows(id) : id.host != registry_.host();
}

bool LocalRequests::waits_for_hosts(const local::Request& request) const {
  if (!fleet_ || request.has_offer() || request.has_want_history() || request.has_list_rights()) {
    return false;
  }
  if (request.has_ping_host() || request.has_list_clock_pairs() || request.has_list_nodes() ||
      request.has_follow_playback()) {
    return true;
  }
  if (request.has_list()) return !request.list().own_only();
  const proto::StreamId* named = subject(request);
  if (!named) return false;
  const Result<StreamId> id = wire::stream_id_untrusted(*named);
  if (!id) return false;  // serve_untrusted() refuses it
  // Without a host a stream is created here.
  return is_elsewhere(*id) && !(request.has_create() && id->host.empty());
}

// --- this host

Result<Reply> LocalRequests::serve_untrusted(const Client& client, const local::Request& request,
                                             DescriptorQueue& descriptors) {
  switch (request.body_case()) {
    case local::Request::kCreate:
      return create(client, request.create());
    case local::Request::kOpen:
      return open(client, request.open());
    case local::Request::kOffer:
      return offer(client, request.offer(), descriptors);
    case local::Request::kClose: {
      DSSM_TRY(opens_.remove(client->number, request.close().handle()));
      return done();
    }
    case local::Request::kWantHistory: {
      const StreamId id = DSSM_TRY(wire::stream_id_untrusted(request.want_history().id()));
      if (fleet_) fleet_->want_history(id);
      return done();
    }
    case local::Request::kOpenClock:
      return open_clock(request.open_clock(), descriptors);
    case local::Request::kListOpens:
      return list_opens(client);
    case local::Request::kListRights:
      return list_rights(client, DSSM_TRY(wire::stream_id_untrusted(request.list_rights().id())));
    case local::Request::kGetDaemon:
      return get_daemon(client);
    case local::Request::kListHosts:
      if (fleet_) return list_hosts();
      break;
    case local::Request::kOpenClockPage:
      if (fleet_) return open_clock_page();
      break;
    default:
      break;
  }
  Reply reply;
  DSSM_TRY(catalog_.serve_untrusted(request, reply.response, client->account()));
  return reply;
}

Result<Reply> LocalRequests::create(const Client& client, const proto::Create& request) {
  DSSM_TRY(opens_.check_quota(*client));
  const OpenedRing created = DSSM_TRY(catalog_.create_untrusted(request, *client, rights_));
  Result<Reply> reply =
      opened({client, created.stream, Role::writer, request.tag(), request.id().host().empty()});
  if (reply) {
    reply->response.mutable_opened()->set_created(created.created);
  } else if (created.created) {
    // No program knows of it yet, and nothing is written to it.
    static_cast<void>(registry_.remove(created.stream->id()));
  }
  return reply;
}

Result<Reply> LocalRequests::open(const Client& client, const proto::Open& request) {
  const std::shared_ptr<Stream> stream = DSSM_TRY(catalog_.find_untrusted(request.id()));
  return opened(
      {client, stream, role_of(request.for_writing()), request.tag(), request.id().host().empty()});
}

Result<Reply> LocalRequests::offer(const Client& client, const local::Offer& request,
                                   DescriptorQueue& descriptors) {
  const Role role = role_of(request.for_writing());
  OfferedFiles files = DSSM_TRY(offered_files(descriptors, role));
  files.client = client->number;
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(request.id()));
  DSSM_TRY(opens_.check_quota(*client));
  // An offer without a host is of this one: it may not know the stream after its restart.
  const bool is_own = id.host.empty() || !is_elsewhere(id);
  const bool creates = rights_.check(*client, Action::create, id).has_value();
  files.may_create = creates;
  const std::shared_ptr<Stream> stream =
      DSSM_TRY(is_own ? registry_.adopt_untrusted(id, std::move(files))
                      : fleet_->adopt_untrusted(id, role, std::move(files), request.history(),
                                                client->account()));
  return record_open({client, stream, role, request.tag(), request.any_host(),
                      creates && !is_own && role == Role::writer});
}

Result<Reply> LocalRequests::open_clock(const local::OpenClock& request,
                                        DescriptorQueue& descriptors) {
  if (request.offered()) {
    std::vector<UniqueFd> offered = take_descriptors(descriptors);
    if (offered.empty()) {
      return Error{Errc::protocol, "the request comes without its descriptor (clock)"};
    }
    if (!clock_.has_one()) DSSM_TRY(clock_.adopt_untrusted(std::move(offered[0])));
  }
  Reply reply;
  reply.response.mutable_clock();
  reply.descriptors.push_back(DSSM_TRY(clock_.get()));
  return reply;
}

Result<Reply> LocalRequests::open_clock_page() const {
  Reply reply;
  reply.response.mutable_clock_page();
  reply.descriptors.push_back(DSSM_TRY(fleet_->clock_page()));
  return reply;
}

// The rights of this host, also for a stream of another host: what that one allows to this host's
// dssmd is in its own configuration.
Reply LocalRequests::list_rights(const Client& client, const StreamId& id) const {
  Reply reply;
  local::RightList& list = *reply.response.mutable_right_list();
  list.set_restricted(!rights_.lines().empty());
  list.set_own_verbs(rights_.verbs(*client, id).str());
  for (const Right& right : rights_.lines()) {
    if (!names_stream(right.streams, id)) continue;
    local::Right& entry = *list.add_rights();
    entry.set_verbs(right.verbs.str());
    entry.set_line(right.line);
  }
  return reply;
}

Reply LocalRequests::list_opens(const Client& client) const {
  Reply reply;
  local::OpenList& list = *reply.response.mutable_open_list();
  for (const auto& [number, open] : opens_.entries()) {
    if (open.stream->removed() || !rights_.shows(*client, open.stream->id())) continue;
    local::OpenEntry& entry = *list.add_opens();
    wire::to_message(open.stream->id(), *entry.mutable_id());
    entry.set_creator_pid(open.stream->creator_pid());
    entry.set_opener_pid(open.client->pid);
    entry.set_tag(open.tag);
    entry.set_for_writing(open.role == Role::writer);
  }
  return reply;
}

Reply LocalRequests::list_hosts() const {
  Reply reply;
  local::HostList& list = *reply.response.mutable_host_list();
  for (local::Host& host : fleet_->hosts()) *list.add_hosts() = std::move(host);
  return reply;
}

Reply LocalRequests::get_daemon(const Client& client) const {
  Reply reply;
  local::Daemon& daemon = *reply.response.mutable_daemon();
  daemon.set_host(registry_.host());
  daemon.set_version(DSSM_VERSION);
  daemon.set_pid(::getpid());
  daemon.set_streams(registry_.streams().size());
  daemon.set_memory_bytes(registry_.budget().used());
  daemon.set_memory_limit_bytes(registry_.budget().limit());
  const DaemonFacts facts = facts_ ? facts_() : DaemonFacts();
  daemon.set_config_file(facts.config_file);
  daemon.set_clock_policy(std::string(name_of(facts.clock_policy)));
  if (rights_.check(*client, Action::open_clock, {})) {
    daemon.set_playback_driver(clock_.followed_driver(MonoClock::now()));
  }
  for (const LimitUse& one : facts.limits) {
    local::LimitUse& entry = *daemon.add_limits();
    entry.set_name(std::string(one.name));
    entry.set_used(one.used);
    entry.set_limit(one.limit);
    entry.set_unit(std::string(one.unit));
  }
  if (fleet_) fleet_->describe(daemon);
  return reply;
}

// --- other hosts

std::optional<StreamId> LocalRequests::asked_untrusted(const local::Request& request) const {
  if (request.has_ping_host()) {
    const std::string& host = request.ping_host().host();
    return host == registry_.host() ? std::nullopt : std::optional(StreamId{"", 0, host});
  }
  const proto::StreamId* named = subject(request);
  if (!named) return std::nullopt;
  const Result<StreamId> id = wire::stream_id_untrusted(*named);
  return id ? std::optional(*id) : std::nullopt;
}

void LocalRequests::ask_hosts_untrusted(const Client& client, const local::Request& request,
                                        Answer answer) {
  if (request.has_list()) return list_all(std::move(answer));
  if (request.has_list_nodes()) return list_nodes(std::move(answer));
  if (request.has_list_clock_pairs()) return list_clock_pairs(std::move(answer));
  if (request.has_follow_playback()) {
    return follow_playback(client, request.follow_playback(), std::move(answer));
  }
  if (request.has_ping_host()) return ping(request.ping_host().host(), std::move(answer));
  const StreamId id = *wire::stream_id_untrusted(*subject(request));
  if (request.has_create()) {
    return create_elsewhere(client, id, request.create(), std::move(answer));
  }
  if (request.has_open()) return open_elsewhere(client, id, request.open(), std::move(answer));
  fleet_->forward(id, request, [answer = std::move(answer)](Result<local::Response> response) {
    if (!response) return answer(std::move(response).error());
    answer(Reply{*std::move(response), {}});
  });
}

void LocalRequests::create_elsewhere(const Client& client, const StreamId& id,
                                     const proto::Create& request, Answer answer) {
  const Result<TypeInfo> type = wire::type_untrusted(request.type());
  if (!type) return answer(type.error());
  if (Result<void> quota = opens_.check_quota(*client); !quota) return answer(quota.error());
  CreatePlan plan{*type, {request.depth(), Duration(request.cycle_ns())}, request.keep_existing()};
  // The owner decides only about this host, which may do more than this program.
  const Result<void> creates = rights_.check(*client, Action::create, id);
  if (!creates) {
    plan.scope = CreatePlan::Scope::join;
  } else if (!rights_.check(*client, Action::remove, id)) {
    plan.scope = CreatePlan::Scope::create;
  }
  fleet_->open_writer(id, &plan, client->account(),
                      [this, client, creates, tag = request.tag(),
                       answer = std::move(answer)](Result<OpenedRing> writer) {
                        if (!writer) {
                          Error error = std::move(writer).error();
                          if (!creates && error.code == Errc::not_found) {
                            error.message += "; " + creates.error().message;
                          }
                          return answer(std::move(error));
                        }
                        OpenEntry entry{client, writer->stream, Role::writer, tag};
                        entry.creates = creates.has_value();
                        Result<Reply> reply = opened(entry);
                        if (reply) reply->response.mutable_opened()->set_created(writer->created);
                        answer(std::move(reply));
                      });
}

void LocalRequests::open_elsewhere(const Client& client, const StreamId& id,
                                   const proto::Open& request, Answer answer) {
  if (Result<void> quota = opens_.check_quota(*client); !quota) return answer(quota.error());
  OpenEntry entry{client, nullptr, role_of(request.for_writing()), request.tag(), id.host.empty()};
  if (request.for_writing()) {
    return fleet_->open_writer(
        id, nullptr, client->account(),
        [this, entry, answer = std::move(answer)](Result<OpenedRing> writer) mutable {
          if (!writer) return answer(std::move(writer).error());
          entry.stream = writer->stream;
          answer(opened(entry));
        });
  }
  fleet_->open_reader(
      id, request.history(), client->account(),
      [this, entry, answer = std::move(answer)](Result<std::shared_ptr<Stream>> stream) mutable {
        if (!stream) return answer(std::move(stream).error());
        entry.stream = *std::move(stream);
        Result<Reply> reply = opened(entry);
        if (reply) reply->response.mutable_opened()->set_mirror(true);
        answer(std::move(reply));
      });
}

void LocalRequests::list_all(Answer answer) {
  // Shared, because functions that are handed around have to be copyable.
  const auto own = std::make_shared<Reply>();
  local::Request request;
  request.mutable_list();
  if (Result<void> listed = catalog_.serve_untrusted(request, own->response, {}); !listed) {
    return answer(std::move(listed).error());
  }
  fleet_->list([own, answer = std::move(answer)](Result<std::vector<proto::Stream>> streams) {
    if (!streams) return answer(std::move(streams).error());
    answer(with_streams(std::move(*own), *std::move(streams)));
  });
}

void LocalRequests::list_nodes(Answer answer) {
  fleet_->list_nodes(catalog_.nodes(), [answer = std::move(answer)](const NodeTable& nodes) {
    Reply reply;
    proto::NodeList& list = *reply.response.mutable_node_list();
    nodes.to_message(list);
    if (list.ByteSizeLong() <= kMaxLocalListBytes) return answer(std::move(reply));
    answer(Error{Errc::limit_exceeded,
                 "the list of all hosts' processes is longer than one message may be"});
  });
}

void LocalRequests::list_clock_pairs(Answer answer) {
  fleet_->list_clock_pairs([answer = std::move(answer)](const std::vector<ClockPair>& pairs) {
    Reply reply;
    proto::ClockPairList& list = *reply.response.mutable_clock_pair_list();
    for (const ClockPair& pair : pairs) wire::to_message(pair, *list.add_pairs());
    if (list.ByteSizeLong() <= kMaxLocalListBytes) return answer(std::move(reply));
    answer(Error{Errc::limit_exceeded,
                 "the list of all hosts' clocks is longer than one message may be"});
  });
}

void LocalRequests::follow_playback(const Client& client, const proto::FollowPlayback& request,
                                    Answer answer) {
  Result<proto::FollowPlayback> lead =
      clock_.lead(request, fmt::format("{}@{}", client->program, registry_.host()), client->number,
                  MonoClock::now());
  if (!lead) return answer(std::move(lead).error());
  if (request.this_host()) {
    Reply reply;
    reply.response.mutable_playback_followers();
    return answer(std::move(reply));
  }
  fleet_->follow_playback(*lead,
                          [answer = std::move(answer)](Result<proto::PlaybackFollowers> followers) {
                            if (!followers) return answer(std::move(followers).error());
                            Reply reply;
                            *reply.response.mutable_playback_followers() = *std::move(followers);
                            answer(std::move(reply));
                          });
}

void LocalRequests::ping(const std::string& host, Answer answer) {
  if (host == registry_.host()) {  // this response shows that it runs
    Reply reply;
    reply.response.mutable_round_trip();
    return answer(std::move(reply));
  }
  fleet_->ping(host, [answer = std::move(answer)](Result<local::RoundTrip> round_trip) {
    if (!round_trip) return answer(std::move(round_trip).error());
    Reply reply;
    *reply.response.mutable_round_trip() = *std::move(round_trip);
    answer(std::move(reply));
  });
}

// --- opens

// Records that a client has a stream open. The reply comes without descriptors.
Reply LocalRequests::record_open(const OpenEntry& entry) {
  Reply reply;
  proto::Opened& message = *reply.response.mutable_opened();
  wire::to_message(entry.stream->id(), *message.mutable_stream()->mutable_id());
  wire::to_message(entry.stream->type(), *message.mutable_stream()->mutable_type());
  message.set_handle(opens_.add(entry));  // last: nothing is recorded when memory is short
  return reply;
}

// The same, with the descriptors that go with a Create or an Open.
//   fails  limit_exceeded (opens), os errors; then nothing is recorded
Result<Reply> LocalRequests::opened(const OpenEntry& entry) {
  DSSM_TRY(opens_.check_quota(*entry.client));
  // Another host may have answered after a reload of the rights.
  DSSM_TRY(rights_.check(
      *entry.client,
      entry.role == Role::writer ? Action::open_for_writing : Action::open_for_reading,
      entry.stream->id()));
  std::vector<UniqueFd> descriptors =
      DSSM_TRY(entry.stream->descriptors_for(entry.role, entry.client->number));
  Reply reply = record_open(entry);
  reply.descriptors = std::move(descriptors);
  return reply;
}

}  // namespace dssm::daemon
