// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/catalog_requests.hpp"

#include <fmt/format.h>

#include <utility>

#include "core/base/try.hpp"
#include "core/wire/messages.hpp"
#include "local.pb.h"
#include "network.pb.h"

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxNamedUsers = 10;  // in one sentence

// Programs of this host, then those of others.
std::vector<StreamUser> users_of(const Stream& stream, const OpenTable& opens) {
  std::vector<StreamUser> users = opens.users(stream);
  for (const Stream::Channel& channel : stream.channels()) {
    users.insert(users.end(), channel.users.begin(), channel.users.end());
  }
  return users;
}

// As many as fit into a list of `max_bytes`: other hosts may name more.
void describe_users(const std::vector<StreamUser>& users, std::size_t max_bytes,
                    proto::Stream& out) {
  constexpr std::size_t kFrame = 16;  // around a user in the list
  std::size_t bytes = out.ByteSizeLong();
  for (const StreamUser& user : users) {
    proto::User message;
    wire::to_message(user, message);
    bytes += message.ByteSizeLong() + kFrame;
    if (bytes > max_bytes) return;
    *out.add_users() = std::move(message);
  }
}

Result<void> check_fits(const Stream& stream, const TypeInfo& type, const History& history) {
  DSSM_TRY(stream.type().check_usable_as(type));
  const std::uint64_t depth = stream.mapping().geometry().depth;
  if (history.depth <= depth) return {};
  return Error{Errc::conflict, fmt::format("its ring has {} slots, and this program asks for {}",
                                           depth, history.depth)};
}

}  // namespace

void describe(const Stream& stream, const OpenTable& opens, proto::Stream& out, bool with_fields) {
  StreamInfo info = stream.info(with_fields);
  const OpenTable::Counts counts = opens.counts(stream);
  info.writers += counts.writers;
  info.readers += counts.readers;
  const auto may_write = [](const Stream::Channel& channel) { return !channel.states_users; };
  if (info.state == StreamState::stalled && info.writers == 0 &&
      std::none_of(stream.channels().begin(), stream.channels().end(), may_write)) {
    info.state = StreamState::no_writer;
  }
  wire::to_message(info, out);
}

proto::StreamEvent added_event(const Stream& stream, const OpenTable& opens, bool property_set) {
  proto::StreamEvent event;
  event.set_property_set(property_set);
  describe(stream, opens, *event.mutable_stream());
  return event;
}

proto::StreamEvent removed_event(const StreamId& id, std::uint64_t incarnation) {
  proto::StreamEvent event;
  event.set_removed(true);
  wire::to_message(id, *event.mutable_stream()->mutable_id());
  event.mutable_stream()->set_incarnation(incarnation);
  return event;
}

Error unknown_request(const std::string& host) {
  return {Errc::protocol, fmt::format("dssmd of host '{}' ({}) does not know this request; install "
                                      "the same version of DSSM on both sides",
                                      host, DSSM_VERSION)};
}

template <class Request, class Response>
Result<void> CatalogRequests::serve_untrusted(const Request& request, Response& response,
                                              const std::string& account, const StreamId* channel) {
  if (request.has_list()) return list(*response.mutable_stream_list());
  if (request.has_list_nodes()) return list_nodes(*response.mutable_node_list());
  const proto::StreamId* named = subject(request);
  if (!named) return unknown_request(registry_.host());
  const StreamId id = channel ? *channel : DSSM_TRY(wire::stream_id_untrusted(*named));
  switch (request.body_case()) {
    case Request::kInfo: {
      const std::shared_ptr<Stream> stream = DSSM_TRY(registry_.find(id));
      proto::Stream& out = *response.mutable_stream_list()->add_streams();
      describe(*stream, opens_, out);
      describe_users(users_of(*stream, opens_), max_list_bytes_, out);
      return {};
    }
    case Request::kRemove:
      DSSM_TRY(registry_.remove(id));
      response.mutable_done();
      return {};
    case Request::kSetProperty:
      DSSM_TRY(registry_.set_property(id, request.set_property().property(), account));
      response.mutable_done();
      return {};
    case Request::kGetProperty:
      response.mutable_property()->set_property(DSSM_TRY(property_of(id)));
      return {};
    case Request::kDescribe: {
      const TypeInfo type = DSSM_TRY(wire::type_untrusted(request.describe().type()));
      DSSM_TRY(registry_.describe(id, type, request.describe().replace()));
      response.mutable_done();
      return {};
    }
    default:
      return unknown_request(registry_.host());
  }
}

template Result<void> CatalogRequests::serve_untrusted(const local::Request&, local::Response&,
                                                       const std::string&, const StreamId*);
template Result<void> CatalogRequests::serve_untrusted(const net::Frame&, net::Frame&,
                                                       const std::string&, const StreamId*);

Result<std::string> CatalogRequests::property_of(const StreamId& id) const {
  const std::shared_ptr<Stream> stream = DSSM_TRY(registry_.find(id));
  std::string property = DSSM_TRY(stream->property(), "stream '" + stream->id().str() + "'");
  if (!property.empty()) return property;
  return Error{Errc::not_found,
               fmt::format("stream '{}' has no property set; `dssmctl property set` sets one",
                           stream->id().str())};
}

Result<std::shared_ptr<Stream>> CatalogRequests::find_untrusted(const proto::StreamId& id) const {
  return registry_.find(DSSM_TRY(wire::stream_id_untrusted(id)));
}

Result<OpenedRing> CatalogRequests::create_untrusted(const proto::Create& request,
                                                     const Identity& who, const Rights& rights) {
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(request.id()));
  const TypeInfo type = DSSM_TRY(wire::type_untrusted(request.type()));
  const History history{request.depth(), Duration(request.cycle_ns())};
  const Result<std::shared_ptr<Stream>> existing = registry_.find(id);
  if (existing && !request.keep_existing()) {
    const std::string context = "stream '" + (*existing)->id().str() + "'";
    Result<void> fits = check_fits(**existing, type, history);
    if (!fits) {
      // While a program is being developed its type changes, and nobody wants the old ring.
      Result<void> replaceable = check_unused(**existing);
      if (replaceable) replaceable = rights.check(who, Action::create, id);
      if (replaceable) replaceable = rights.check(who, Action::remove, id);
      if (replaceable) {
        return OpenedRing{DSSM_TRY(registry_.replace(id, type, history, who.pid, who.account())),
                          true};
      }
      Error error = std::move(fits).error().context(context);
      error.message += "; no new ring takes its place: " + replaceable.error().message;
      return error;
    }
  }
  // A description is for all programs: one that may only write joins the stream as it is.
  const bool may_describe =
      rights.check(who, Action::create, id) || rights.check(who, Action::describe, id);
  if (existing && !may_describe) {
    DSSM_TRY((*existing)->type().check_usable_as(type), "stream '" + (*existing)->id().str() + "'");
    return OpenedRing{*existing, false};
  }
  return registry_.create(id, type, history, who.pid, who.account());
}

// Whether nothing would be taken away from anybody.
//   fails  with the reason, for people
Result<void> CatalogRequests::check_unused(const Stream& stream) const {
  if (registry_.recovery() != Registry::Recovery::over) {
    return Error{Errc::unavailable,
                 "dssmd was restarted, and does not know yet who has the stream open; try again in "
                 "a second"};
  }
  std::vector<std::string> names;
  for (const StreamUser& user : users_of(stream, opens_)) {
    const bool is_own = user.host.empty() || user.host == registry_.host();
    names.push_back(fmt::format("'{}' (pid {}){}", user.program, user.pid,
                                is_own ? "" : " on host '" + user.host + "'"));
  }
  for (const Stream::Channel& channel : stream.channels()) {
    if (channel.users.empty()) names.emplace_back("another host");
  }
  if (names.empty()) return {};
  if (names.size() > kMaxNamedUsers) {
    const std::size_t more = names.size() - kMaxNamedUsers;
    names.resize(kMaxNamedUsers);
    names.push_back(fmt::format("{} more", more));
  }
  return Error{
      Errc::conflict,
      fmt::format("the stream is open in {}; end these programs, or remove it (`dssmctl rm "
                  "{}`): then its readers continue with the new ring, and its writers have "
                  "to be restarted",
                  fmt::join(names, ", "), stream.id().str())};
}

NodeTable CatalogRequests::nodes(bool of_channels) const {
  NodeTable nodes(registry_.host());
  for (const auto& [number, open] : opens_.entries()) {
    if (open.stream->removed()) continue;
    StreamUser user = OpenTable::user(open);
    user.host = registry_.host();
    nodes.add(user, open.stream->id());
  }
  if (!of_channels) return nodes;
  for (const std::shared_ptr<Stream>& stream : registry_.streams()) {
    for (const Stream::Channel& channel : stream->channels()) {
      for (const StreamUser& user : channel.users) nodes.add(user, stream->id());
    }
  }
  return nodes;
}

Result<void> CatalogRequests::list_nodes(proto::NodeList& out) const {
  nodes().to_message(out);
  if (out.ByteSizeLong() <= max_list_bytes_) return {};
  // Other hosts tell of their own processes themselves.
  out.Clear();
  nodes(false).to_message(out);
  if (out.ByteSizeLong() <= max_list_bytes_) return {};
  return Error{Errc::limit_exceeded,
               fmt::format("the list of the {} processes of host '{}' is longer than one message "
                           "may be; Info names those that use one stream",
                           out.nodes_size(), registry_.host())};
}

// In the order of creation.
Result<void> CatalogRequests::list(proto::StreamList& out) const {
  std::size_t fields = 0;
  for (const std::shared_ptr<Stream>& stream : registry_.streams()) {
    fields += stream->type().fields.size();
  }
  const bool with_fields = fields <= kMaxListedFields;
  for (const std::shared_ptr<Stream>& stream : registry_.streams()) {
    describe(*stream, opens_, *out.add_streams(), with_fields);
  }
  if (out.ByteSizeLong() <= max_list_bytes_) return {};
  // Few fields with names that fill pages.
  for (proto::Stream& stream : *out.mutable_streams()) stream.mutable_type()->clear_fields();
  if (out.ByteSizeLong() <= max_list_bytes_) return {};
  return Error{Errc::limit_exceeded,
               fmt::format("the list of the {} streams of host '{}' is longer than one message may "
                           "be; Watch reports them one by one",
                           registry_.streams().size(), registry_.host())};
}

}  // namespace dssm::daemon
