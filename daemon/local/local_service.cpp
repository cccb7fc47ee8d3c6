// SPDX-License-Identifier: Apache-2.0
#include "daemon/local/local_service.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

#include "core/wire/frame.hpp"
#include "core/wire/local_protocol.hpp"
#include "core/wire/request_size.hpp"
#include "daemon/base/limit_use.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/fleet/peer_connection.hpp"
#include "daemon/streams/catalog_requests.hpp"

namespace dssm::daemon {
namespace {

// One user leaves half of what may wait for a peer to others, and may set the longest property.
static_assert(2 * LocalService::kMaxAwaitedPerUser <= PeerConnection::kMaxWaiting);
static_assert(2 * LocalService::kMaxAwaitedBytesPerUser <= PeerConnection::kMaxWaitingBytes);
static_assert(LocalService::kMaxAwaitedBytesPerUser > wire::kMaxLocalRequestBytes);

// Whether the request has an effect besides its answer.
bool changes_something(const local::Request& request) noexcept {
  const std::optional<Action> action = action_of(request);
  return action == Action::close || action == Action::remove || action == Action::set_property ||
         action == Action::describe || action == Action::offer_for_reading ||
         action == Action::offer_for_writing;
}

StreamId id_of(const proto::StreamEvent& event) {
  const proto::StreamId& id = event.stream().id();
  return {id.name(), id.id(), id.host()};
}

local::Response failure_response(std::uint64_t serial, const Error& error) {
  local::Response response;
  response.set_serial(serial);
  wire::to_message(error, *response.mutable_failure());
  return response;
}

}  // namespace

// Counts from its construction until end(). A request whose answer never comes, for lack of memory,
// ends with the function that waits for it.
class LocalService::AwaitedRequest {
 public:
  AwaitedRequest(std::shared_ptr<AwaitedOfUser> of_user, std::size_t bytes)
      : of_user_(std::move(of_user)), bytes_(bytes) {
    ++of_user_->requests;
    of_user_->bytes += bytes_;
  }
  AwaitedRequest(const AwaitedRequest&) = delete;
  AwaitedRequest& operator=(const AwaitedRequest&) = delete;
  ~AwaitedRequest() { end(); }

  // False: it has ended before.
  bool end() noexcept {
    if (!of_user_) return false;
    --of_user_->requests;
    of_user_->bytes -= bytes_;
    of_user_.reset();
    return true;
  }

 private:
  std::shared_ptr<AwaitedOfUser> of_user_;
  const std::size_t bytes_;
};

LocalService::LocalService(Registry& registry, OpenTable& opens, PlaybackClockOwner& clock,
                           const Rights& rights, Logger& logger, Fleet* fleet)
    : registry_(registry),
      opens_(opens),
      clock_(clock),
      rights_(rights),
      logger_(logger),
      refusals_(logger),
      requests_(registry, opens, clock, rights, fleet),
      fleet_(fleet) {
  registry_.add_observer(*this);
  if (fleet_) fleet_->observe(this);
}

LocalService::~LocalService() {
  if (fleet_) fleet_->observe(nullptr);
  registry_.remove_observer(*this);
}

ClientNumber LocalService::connect(const Identity& identity, ClientOutput& output) {
  const ClientNumber number = next_client_++;
  Client client;
  client.identity = std::make_shared<ClientIdentity>(ClientIdentity{identity, number});
  client.output = &output;
  clients_.emplace(number, std::move(client));
  return number;
}

bool LocalService::disconnect(ClientNumber number, bool by_client) {
  clock_.on_client_gone(number);
  if (const auto client = clients_.extract(number)) {
    end_watch(number, client.mapped());
    if (client.mapped().greeted) {
      logger_.debug("client disconnected", {.peer = client.mapped().identity->str()});
    }
  }
  return leave(number, by_client);
}

void LocalService::on_reader_gone(ClientNumber number) {
  Client& client = clients_.at(number);
  client.has_reader = false;
  end_watch(number, client);
}

bool LocalService::on_frame_untrusted(ClientNumber number, std::span<const std::byte> frame,
                                      DescriptorQueue& descriptors) {
  Client& client = clients_.at(number);
  if (Result<void> checked = wire::check_request_size_untrusted(frame); !checked) {
    const std::uint64_t serial = wire::serial_untrusted(frame);
    if (serial == 0 || !client.greeted) return refuse(client, 0, checked.error());
    send_failure(client, serial, checked.error());  // what follows the frame can be read
    return true;
  }
  local::Request request;
  if (!request.ParseFromArray(frame.data(), static_cast<int>(frame.size()))) {
    return refuse(client, 0,
                  {Errc::protocol, "the frame is not a request of DSSM's local protocol"});
  }
  const std::uint64_t serial = request.serial();
  if (serial == 0) {
    return refuse(client, 0, {Errc::protocol, "the request has no serial; it takes one above 0"});
  }
  if (request.has_hello()) return greet(client, serial, request.hello());
  if (!client.greeted) {
    return refuse(client, serial,
                  {Errc::protocol, "the first request on a connection has to be Hello"});
  }
  if (!client.has_reader && !changes_something(request)) return true;
  if (Result<void> allowed = check_access(*client.identity, request); !allowed) {
    send_failure(client, serial, allowed.error());
  } else if (must_wait(request)) {
    defer(client, request, frame.size());
  } else {
    serve(number, request, descriptors);
    // Only an offer can end a wait.
    if (request.has_offer() || request.has_open_clock()) serve_deferred();
  }
  return true;
}

Result<void> LocalService::check_access(const ClientIdentity& client,
                                        const local::Request& request) {
  const std::optional<Action> action = action_of(request);
  if (!action) return unknown_request(registry_.host());
  StreamId stream;
  if (const proto::StreamId* named = LocalRequests::subject(request)) {
    stream = {named->name(), named->id(), named->host()};
  }
  // A program that could not get memory for its new stream removes it.
  if (*action == Action::remove && is_only_user(client, stream)) return {};
  Result<void> checked =
      *action == Action::create
          ? rights_.check_create(client, stream, exists(stream), Action::open_for_writing)
          : rights_.check(client, *action, stream);
  if (!checked) {
    refusals_.warning(
        "refuse a request: " + checked.error().message,
        {.stream = stream.str(), .peer = client.str(), .message_id = message_id::kRequestRefused});
  }
  return checked;
}

// Whether a Create of `id` may find the stream; without a host it is searched here only. Who may
// not create it waits until that is known, and then joins it or is refused.
bool LocalService::exists(const StreamId& id) const {
  if (id.host.empty() || id.host == registry_.host()) {
    return registry_.knows(id) || registry_.may_come_back(id);
  }
  return fleet_ != nullptr;
}

bool LocalService::is_only_user(const ClientIdentity& client, const StreamId& id) const {
  const Result<std::shared_ptr<Stream>> stream = registry_.find(id);
  if (!stream) return false;
  const OpenTable::Counts counts = opens_.counts(**stream);
  return counts.writers == 1 && counts.readers == 0 && (*stream)->channels().empty() &&
         (*stream)->creator_pid() == client.pid &&
         // Another user's program may get that pid later, and those of other hosts have none.
         (*stream)->account() == client.account() && opens_.is_writing(**stream, client.number);
}

bool LocalService::refuse(const Client& client, std::uint64_t serial, const Error& error) {
  logger_.warning("close a connection: " + error.message,
                  {.peer = client.identity->str(), .message_id = message_id::kClientRefused});
  send_failure(client, serial, error);
  return false;
}

bool LocalService::greet(Client& client, std::uint64_t serial, const proto::Hello& hello) {
  if (client.greeted) {
    return refuse(client, serial, {Errc::protocol, "Hello comes once, as the first request"});
  }
  ClientIdentity identity = *client.identity;
  identity.program = wire::text_untrusted(hello.program(), wire::kMaxProgramBytes);
  client.identity = std::make_shared<ClientIdentity>(std::move(identity));
  if (hello.protocol_version() != wire::kLocalProtocolVersion) {
    return refuse(client, serial,
                  wire::other_protocol_version({"local", wire::kLocalProtocolVersion},
                                               "the program " + client.identity->str(),
                                               hello.protocol_version()));
  }
  if (Result<void> allowed = rights_.check(*client.identity, Action::greet, {}); !allowed) {
    return refuse(client, serial, allowed.error());
  }
  client.greeted = true;
  logger_.debug("client connected", {.peer = client.identity->str()});
  Reply reply;
  proto::Hello& ours = *reply.response.mutable_hello();
  ours.set_protocol_version(wire::kLocalProtocolVersion);
  ours.set_host(registry_.host());
  ours.set_version(DSSM_VERSION);
  send(client, serial, std::move(reply));
  return true;
}

void LocalService::serve(ClientNumber number, const local::Request& request,
                         DescriptorQueue& descriptors) {
  if (request.has_watch()) return watch(number, request.serial());
  if (request.has_list_clients()) return list_clients(clients_.at(number), request.serial());
  const auto identity = clients_.at(number).identity;
  if (requests_.waits_for_hosts(request)) {
    if (const LocalRequests::Answer answer = await(number, request)) {
      ask_hosts(identity, request, answer);
    }
    return;
  }
  Result<Reply> reply = requests_.serve_untrusted(identity, request, descriptors);
  if (request.has_offer()) log_offer(*identity, request.offer(), reply);
  // A program hears of what it did before the answer.
  while (tell_news(number, end_of_news())) {
  }
  on_answer(number, request.serial(), std::move(reply));
}

void LocalService::ask_hosts(const std::shared_ptr<const ClientIdentity>& client,
                             const local::Request& request, const LocalRequests::Answer& answer) {
  const std::optional<StreamId> asked = requests_.asked_untrusted(request);
  if (!asked) return requests_.ask_hosts_untrusted(client, request, answer);
  fleet_->when_known(*asked, request.ByteSizeLong(), [this, client, request, answer] {
    // The rights may have changed meanwhile.
    if (Result<void> allowed = check_access(*client, request); !allowed) {
      return answer(std::move(allowed).error());
    }
    requests_.ask_hosts_untrusted(client, request, answer);
  });
}

// Takes the response of another host to the client; none when this client or its user waits for too
// many already: then it has got a failure.
LocalRequests::Answer LocalService::await(ClientNumber number, const local::Request& request) {
  Client& client = clients_.at(number);
  std::erase_if(awaited_, [](const auto& user) { return user.second.expired(); });
  std::weak_ptr<AwaitedOfUser>& kept = awaited_[client.identity->uid];
  std::shared_ptr<AwaitedOfUser> of_user = kept.lock();
  if (!of_user) kept = of_user = std::make_shared<AwaitedOfUser>();
  const std::size_t bytes = request.ByteSizeLong() + (request.has_ping_host() ? kPingBytes : 0);
  if (Result<void> checked = check_awaited(client, *of_user, bytes); !checked) {
    send_failure(client, request.serial(), checked.error());
    return {};
  }
  ++client.awaited;
  const auto awaited = std::make_shared<AwaitedRequest>(std::move(of_user), bytes);
  return [this, number, serial = request.serial(), awaited](Result<Reply> reply) {
    const auto asker = clients_.find(number);
    // One for which there was no memory is followed by a failure.
    if (awaited->end() && asker != clients_.end()) --asker->second.awaited;
    on_answer(number, serial, std::move(reply));
  };
}

Result<void> LocalService::check_awaited(const Client& client, const AwaitedOfUser& of_user,
                                         std::size_t bytes) const {
  const auto error = [](const std::string& what) {
    return Error{Errc::limit_exceeded,
                 fmt::format("other hosts have not answered {} yet; wait for them", what)};
  };
  if (client.awaited >= kMaxAwaited) {
    return error(fmt::format("{} requests of this program", kMaxAwaited));
  }
  if (!is_limited(client.identity->uid)) return {};
  if (of_user.requests >= kMaxAwaitedPerUser) {
    return error(fmt::format("{} requests of this user's programs", kMaxAwaitedPerUser));
  }
  if (of_user.bytes + bytes > kMaxAwaitedBytesPerUser) {
    return error("1.5 MiB of requests of this user's programs");
  }
  return {};
}

void LocalService::on_answer(ClientNumber number, std::uint64_t serial, Result<Reply> reply) {
  const auto client = clients_.find(number);
  if (client == clients_.end()) {
    // It disconnected meanwhile, perhaps because of the events of this request.
    while (leave(number, false)) {
    }
    return;
  }
  if (reply) {
    if (reply->response.has_stream_list()) {
      rights_.hide(*client->second.identity, *reply->response.mutable_stream_list());
    }
    if (reply->response.has_node_list()) {
      rights_.hide(*client->second.identity, *reply->response.mutable_node_list());
    }
    send(client->second, serial, *std::move(reply));
  } else {
    send_failure(client->second, serial, reply.error());
  }
}

void LocalService::log_offer(const ClientIdentity& client, const local::Offer& offer,
                             const Result<Reply>& reply) {
  if (!reply) {
    return logger_.warning("refuse an offered stream: " + reply.error().message,
                           {.peer = client.str(), .message_id = message_id::kOfferRefused});
  }
  StreamId id{offer.id().name(), offer.id().id(), offer.id().host()};
  if (id.host.empty()) id.host = registry_.host();
  logger_.info("took stream '" + id.str() + "' back from a program",
               {.peer = client.str(), .message_id = message_id::kStreamAdopted});
}

// First the existing streams, then the response: after a reconnect it shows the client that streams
// which were not among them do not exist any more. Changes are told before further existing ones,
// also those of streams that have not been told: a receiver ignores what it knows.
void LocalService::watch(ClientNumber number, std::uint64_t serial) {
  Client& client = clients_.at(number);
  if (!client.has_reader) return;
  Watch begun;
  if (client.watch) {
    begun.serials = std::move(client.watch->serials);
    begun.before = std::move(client.watch->before);
    begun.news = client.watch->news;
  } else {
    begun.news = end_of_news();
    informed_.insert(number);
    ++watches_;
  }
  begun.serials.push_back(serial);
  client.watch = std::move(begun);
  client.output->request_turn();
}

void LocalService::end_watch(ClientNumber number, Client& client) {
  if (!client.watch) return;
  client.watch.reset();
  informed_.erase(number);
  --watches_;
}

bool LocalService::go_on(ClientNumber number) {
  const Client& client = clients_.at(number);
  if (client.watch) {
    if (tell_news(number, end_of_news())) return true;
    if (!clients_.contains(number)) return false;
    // Sending may have ended the watch alone.
    if (client.watch && client.watch->is_telling) return tell_streams(number);
  }
  return serve_deferred(number);
}

// Those before `end`. Whether there are more; false, too, when the client does not watch, or is
// disconnected by then.
bool LocalService::tell_news(ClientNumber number, std::uint64_t end) {
  std::size_t bytes = 0;
  for (int sent = 0;;) {
    const auto found = clients_.find(number);  // sending may end the connection
    if (found == clients_.end() || !found->second.watch) return false;
    Watch& watch = *found->second.watch;
    if (watch.news >= end) return false;
    if (sent == kStreamsPerTurn || bytes >= kStreamBytesPerTurn) return true;
    const News& next = news_[watch.news++ - first_news_];
    if (watch.news == end_of_news()) informed_.insert(number);
    if (!next.frame.empty() && (shows(found->second, next.stream) ||
                                (next.is_removed && showed(found->second, next.stream)))) {
      ++sent;
      bytes += next.frame.size();
      found->second.output->send(next.frame, {});
    }
  }
}

bool LocalService::tell_streams(ClientNumber number) {
  Client& client = clients_.at(number);
  const std::vector<proto::StreamEvent> events = next_events(client);
  const bool is_telling = client.watch->is_telling;
  std::vector<std::uint64_t> serials;
  if (!is_telling) serials.swap(client.watch->serials);
  if (!send_events(number, events)) return false;
  for (const std::uint64_t serial : serials) {
    Reply done;
    done.response.mutable_done();
    on_answer(number, serial, std::move(done));
  }
  return is_telling;
}

// The next part of the streams that exist; is_telling is false after the last one.
std::vector<proto::StreamEvent> LocalService::next_events(Client& client) const {
  Watch& watch = *client.watch;
  std::vector<proto::StreamEvent> events;
  std::size_t bytes = 0;
  int seen = 0;
  const auto is_full = [&] { return seen == kStreamsPerTurn || bytes >= kStreamBytesPerTurn; };
  const auto add = [&](proto::StreamEvent event) {
    bytes += event.ByteSizeLong();
    events.push_back(std::move(event));
  };
  const std::vector<std::shared_ptr<Stream>>& own = registry_.streams();
  auto next = std::upper_bound(own.begin(), own.end(), watch.own,
                               [](std::uint64_t order, const std::shared_ptr<Stream>& stream) {
                                 return order < stream->created_order();
                               });
  for (; next != own.end(); ++next, ++seen) {
    if (is_full()) return events;
    const Stream& stream = **next;
    watch.own = stream.created_order();
    if (shows(client, stream.id())) {
      add(added_event(stream, opens_));
    } else if (showed(client, stream.id())) {
      add(removed_event(stream.id(), stream.incarnation()));
    }
  }
  const auto next_other = [&] { return fleet_ ? fleet_->next_stream(watch.others) : nullptr; };
  for (; const StreamInfo* stream = next_other(); ++seen) {
    if (is_full()) return events;
    watch.others = stream->id;
    if (shows(client, stream->id)) {
      proto::StreamEvent event;
      wire::to_message(*stream, *event.mutable_stream());
      add(std::move(event));
    } else if (showed(client, stream->id)) {
      add(removed_event(stream->id, stream->incarnation));
    }
  }
  watch.is_telling = false;
  watch.before.clear();
  return events;
}

bool LocalService::shows(const Client& client, const StreamId& id) const {
  return rights_.shows(*client.identity, id);
}

// Whether a client that watches may know the stream by earlier rights, and has not been told yet
// that it may not see it any more.
bool LocalService::showed(const Client& client, const StreamId& id) const {
  const auto& before = client.watch->before;
  return std::any_of(before.begin(), before.end(),
                     [&](const auto& rights) { return rights->shows(*client.identity, id); });
}

// False when the client is disconnected by then.
bool LocalService::send_events(ClientNumber number, const std::vector<proto::StreamEvent>& events) {
  for (const proto::StreamEvent& event : events) {
    const auto client = clients_.find(number);  // sending may end the connection
    if (client == clients_.end()) return false;
    Reply reply;
    *reply.response.mutable_stream_event() = event;
    send(client->second, 0, std::move(reply));
  }
  return clients_.contains(number);
}

void LocalService::list_clients(const Client& client, std::uint64_t serial) {
  Reply reply;
  local::ClientList& list = *reply.response.mutable_client_list();
  for (const auto& [number, other] : clients_) {
    if (!other.greeted) continue;
    local::Client& entry = *list.add_clients();
    entry.set_pid(other.identity->pid);
    entry.set_uid(other.identity->uid);
    entry.set_program(other.identity->program);
  }
  send(client, serial, std::move(reply));
}

void LocalService::send(const Client& client, std::uint64_t serial, Reply reply) {
  reply.response.set_serial(serial);
  client.output->send(wire::encode_frame(reply.response), std::move(reply.descriptors));
}

void LocalService::send_failure(const Client& client, std::uint64_t serial, const Error& error) {
  client.output->send(wire::encode_frame(failure_response(serial, error)), {});
}

void LocalService::broadcast(const proto::StreamEvent& event) {
  if (watches_ == 0) return;
  local::Response response;
  *response.mutable_stream_event() = event;
  const StreamId id = id_of(event);
  News news{id, event.removed(), wire::encode_frame(response)};
  if (event.property_set()) clear_property_news(id);
  news_.push_back(std::move(news));
  news_bytes_ += sizeof(News) + news_.back().frame.size();
  // Last: without memory for it, the event just stays when the property is set again.
  if (event.property_set()) properties_[id.str()] = end_of_news() - 1;
  // The others have more to get already, and their turn comes.
  for (const ClientNumber number : std::exchange(informed_, {})) {
    clients_.at(number).output->request_turn();
  }
  if (news_bytes_ > kMaxNewsBytes || news_.size() >= 2 * kept_news_ + kStreamsPerTurn) drop_news();
}

// A property may be set faster than programs take events: then they get only the last event.
void LocalService::clear_property_news(const StreamId& stream) {
  const auto newest = properties_.find(stream.str());
  if (newest == properties_.end()) return;
  std::string& frame = news_[newest->second - first_news_].frame;
  news_bytes_ -= frame.size();
  std::string().swap(frame);
  properties_.erase(newest);
}

// Drops what all clients have got. If the rest takes too much memory, the oldest of it is sent to
// those that have not got it, and dropped, too: the output of a client has limits of its own.
void LocalService::drop_news() {
  std::uint64_t end = end_of_news();
  for (const auto& [number, client] : clients_) {
    if (client.watch) end = std::min(end, client.watch->news);
  }
  const auto size = [](const News& one) { return sizeof(News) + one.frame.size(); };
  std::size_t left = news_bytes_;
  for (std::uint64_t i = first_news_; i < end; ++i) left -= size(news_[i - first_news_]);
  std::vector<ClientNumber> behind;  // a copy: sending may end connections
  for (; left > kMaxNewsBytes; ++end) left -= size(news_[end - first_news_]);
  for (const auto& [number, client] : clients_) {
    if (client.watch && client.watch->news < end) behind.push_back(number);
  }
  for (const ClientNumber number : behind) {
    while (tell_news(number, end)) {
    }
  }
  for (; first_news_ < end; ++first_news_) {
    const News& oldest = news_.front();
    news_bytes_ -= size(oldest);
    const auto newest = properties_.find(oldest.stream.str());
    if (newest != properties_.end() && newest->second == first_news_) properties_.erase(newest);
    news_.pop_front();
  }
  kept_news_ = news_.size();
}

void LocalService::on_stream_added(const Stream& stream) {
  broadcast(added_event(stream, opens_));
  logger_.debug("stream '" + stream.id().str() + "' is added",
                {.stream = stream.id().str(), .message_id = message_id::kStreamCreated});
  notify_successors(stream.id());
}

void LocalService::on_stream_described(const Stream& stream) {
  broadcast(added_event(stream, opens_));
}

void LocalService::on_property_set(const Stream& stream) {
  broadcast(added_event(stream, opens_, true));
}

void LocalService::on_stream_removed(const Stream& stream) {
  const StreamId& id = stream.id();
  broadcast(removed_event(id, stream.incarnation()));
  logger_.debug("stream '" + id.str() + "' is removed",
                {.stream = id.str(), .message_id = message_id::kStreamRemoved});
  notify_successors(id);
}

void LocalService::on_remote_stream_added(const StreamInfo& stream) {
  proto::StreamEvent event;
  wire::to_message(stream, *event.mutable_stream());
  broadcast(event);
  notify_successors(stream.id);
}

void LocalService::on_remote_property_set(const StreamInfo& stream) {
  proto::StreamEvent event;
  event.set_property_set(true);
  wire::to_message(stream, *event.mutable_stream());
  broadcast(event);
}

void LocalService::on_remote_stream_removed(const StreamId& id) {
  broadcast(removed_event(id));
  notify_successors(id);
}

// --- rings with a successor

void LocalService::notify_replaced(const OpenTable::Reading& reading) {
  const auto client = clients_.find(reading.client);
  if (client == clients_.end()) return;  // sending to another one may have closed it
  Reply event;
  event.response.mutable_replaced()->set_handle(reading.number);
  send(client->second, 0, std::move(event));
}

void LocalService::on_ring_replaced(const Stream& stream) {
  for (const OpenTable::Reading& reading : opens_.readers_of(stream)) notify_replaced(reading);
}

// A stream with the name in `id` was added or removed. Notifies the readers of streams of that name
// that get no samples any more, if the name that they used refers to another stream now.
void LocalService::notify_successors(const StreamId& id) {
  const StreamId any{id.name, id.id, ""};
  const bool here = registry_.knows(any), elsewhere = fleet_ && fleet_->is_there(any);
  for (const auto& stream : opens_.open_streams(id.name, id.id)) {
    if (!is_gone(*stream)) continue;
    const bool own = stream->id().host == registry_.host();
    for (const OpenTable::Reading& reading : opens_.readers_of(*stream)) {
      if (reading.any_host ? here || elsewhere : own && here) notify_replaced(reading);
    }
  }
}

bool LocalService::is_gone(const Stream& stream) const {
  if (stream.id().host == registry_.host()) return stream.removed();
  return !fleet_ || !fleet_->is_there(stream.id());
}

// --- new rights

void LocalService::on_new_rights(const Rights& before) {
  const std::map<OpenNumber, OpenEntry> opens = opens_.entries();  // sending may end opens
  for (const auto& [number, open] : opens) {
    const Action action =
        open.role == Role::writer ? Action::open_for_writing : Action::open_for_reading;
    const Result<void> checked = rights_.check(*open.client, action, open.stream->id());
    if (checked) continue;
    const bool is_own = open.stream->purpose() == Purpose::own;
    logger_.warning(
        fmt::format("end an open: {}{}", checked.error().message,
                    is_own ? "; it keeps the memory that it has open until it ends" : ""),
        {.stream = open.stream->id().str(),
         .peer = open.client->str(),
         .message_id = message_id::kRequestRefused});
    if (open.role == Role::reader) notify_replaced({open.client->number, number, open.any_host});
    static_cast<void>(opens_.remove(open.client->number, number));  // sending may have ended it
  }
  // All again and in parts, because there may be many watches and streams. The rights of several
  // reloads that follow each other closely all count.
  const auto of_before = std::make_shared<const Rights>(before.lines());
  for (auto& [number, client] : clients_) {
    if (!client.watch) continue;
    client.watch->is_telling = true;
    client.watch->own = 0;
    client.watch->others = {};
    client.watch->before.push_back(of_before);
    client.output->request_turn();
  }
}

// --- recovery

bool LocalService::must_wait(const local::Request& request) const {
  if (!registry_.may_miss_streams() || request.has_offer()) return false;
  if (request.has_open_clock()) return !request.open_clock().offered() && !clock_.has_one();
  // Otherwise they would leave out streams that are about to be offered.
  if (request.has_watch() || request.has_list_nodes()) return true;
  const proto::StreamId* subject = LocalRequests::subject(request);
  if (!subject) return false;
  const Result<StreamId> id = wire::stream_id_untrusted(*subject);
  return id && registry_.may_come_back(*id);
}

void LocalService::defer(Client& client, const local::Request& request, std::size_t bytes) {
  bytes += kDeferredBytes;
  std::size_t of_user = 0;
  for (const auto& [number, other] : clients_) {
    if (other.identity->uid == client.identity->uid) of_user += other.deferred_bytes;
  }
  const bool is_full = client.deferred_bytes + bytes > kMaxDeferredBytes;
  if (is_full || of_user + bytes > kMaxDeferredBytesPerUser) {
    return send_failure(
        client, request.serial(),
        {Errc::limit_exceeded,
         fmt::format("dssmd was restarted and waits for streams that programs give back; {} of "
                     "requests waiting already: ask again in a second",
                     is_full ? "this program has 1 MiB" : "this user's programs have 16 MiB")});
  }
  client.deferred_bytes += bytes;
  client.deferred.push_back({request, bytes});
}

// Each client's in its turn.
void LocalService::serve_deferred() {
  for (auto& [number, client] : clients_) {
    if (client.deferred.empty()) continue;
    client.may_serve_deferred = true;
    client.output->request_turn();
  }
}

// One of them. True: there may be more.
bool LocalService::serve_deferred(ClientNumber number) {
  Client& client = clients_.at(number);
  if (!client.may_serve_deferred) return false;
  const auto ready = std::find_if(client.deferred.begin(), client.deferred.end(),
                                  [this](const Deferred& one) { return !must_wait(one.request); });
  client.may_serve_deferred = ready != client.deferred.end();
  if (!client.may_serve_deferred) return false;
  const Deferred next = std::move(*ready);
  client.deferred.erase(ready);
  client.deferred_bytes -= next.bytes;
  // The rights may have changed meanwhile.
  if (Result<void> allowed = check_access(*client.identity, next.request); !allowed) {
    send_failure(client, next.request.serial(), allowed.error());
  } else {
    DescriptorQueue none;
    serve(number, next.request, none);
  }
  return clients_.contains(number);
}

}  // namespace dssm::daemon
