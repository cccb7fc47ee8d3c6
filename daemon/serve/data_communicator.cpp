// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/data_communicator.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <new>
#include <utility>

#include "core/base/try.hpp"
#include "daemon/base/message_ids.hpp"
#include "daemon/streams/catalog_requests.hpp"

namespace dssm::daemon {
namespace {

// What receivers take of a frame, less what frames a list.
constexpr std::size_t kMaxListBytes = wire::kMaxNetworkFrameBytes - (4U << 10);

constexpr std::size_t kUnchargedBytes = 2U << 10;  // of a request that waits

constexpr std::uint64_t kReserveSliceBytes = 4U << 20;  // about 1 ms

bool opens_a_stream(const net::Frame& request) noexcept {
  return request.has_open() || request.has_create();
}

// The most memory that a parsed request takes besides what is charged for each connection: of what
// is no property, two bytes may take 200.
std::size_t parsed_bytes(const net::Frame& request) {
  const std::size_t bytes = request.ByteSizeLong(),
                    property = request.set_property().property().size();
  return bytes <= kUnchargedBytes ? 0 : property + 100 * (bytes - property);
}

// Whether only a control connection takes `request`. A channel takes requests for properties too:
// there without a name.
bool is_control(const net::Frame& request) noexcept {
  return request.has_list() || request.has_watch() || request.has_info() || request.has_remove() ||
         request.has_list_clock_pairs() || request.has_list_nodes() || request.has_describe() ||
         request.has_follow_playback() ||
         (request.has_set_property() && request.set_property().has_id()) ||
         (request.has_get_property() && request.get_property().has_id());
}

// Whether the answer would be another one when all streams have come back.
bool must_wait_for_recovery(const net::Frame& request, const Registry& registry) {
  if (!registry.may_miss_streams()) return false;
  if (request.has_list() || request.has_list_nodes()) return true;
  const proto::StreamId* named = subject(request);
  if (!named) return false;
  const Result<StreamId> id = wire::stream_id_untrusted(*named);
  return id && registry.may_come_back(*id);
}

}  // namespace

DataCommunicator::DataCommunicator(const Parts& parts, PeerPlace place,
                                   std::unique_ptr<wire::Transport> transport,
                                   std::string peer_address)
    : parts_(parts),
      place_(std::move(place)),
      peer_address_(std::move(peer_address)),
      link_(parts.loop, std::move(transport), *this, kMaxQueuedBytes),
      catalog_(parts.registry, parts.opens, kMaxListBytes),
      turn_(parts.turns, account_of(peer_address_, link_.peer()), [this] { work_now(); }),
      next_turn_(EventSource::timer(parts.loop, [this] { work_now(); })),
      greeting_timeout_(EventSource::timer(
          parts.loop,
          [this] {
            link_.close_with({Errc::protocol, peer() + " connected and sent no Hello for 3 s"});
          })),
      idle_timeout_(EventSource::timer(parts.loop, [this] { check_idle(); })),
      peer_timeout_(EventSource::timer(parts.loop, [this] { check_peer_timeout(); })) {
  link_.set_budget(place_.budget());
  link_.take_requests_only();
  link_.set_pace(place_.pace());
  link_.set_output_timeout(kOutputTimeout);
  greeting_timeout_.enable_in(wire::kHelloTimeout);
}

DataCommunicator::~DataCommunicator() = default;

std::string DataCommunicator::peer() const {
  // A host's certificate names what its greeting names; a program's does not.
  const bool shows_certificate = them_ && them_->program != "dssmd" && identity_.certified;
  return fmt::format(
      "{}{} at '{}'", them_ ? them_->str() : "a peer",
      shows_certificate ? ", with the certificate of " + identity_.certified->str() + "," : "",
      peer_address_);
}

// --- frames

Result<void> DataCommunicator::on_frame(net::Frame& frame) {
  if (!them_) return greet(frame);
  if (frame.serial() == 0) {
    if (!frame.has_failure()) {
      return Error{Errc::protocol, "a request has no serial; it takes one above 0"};
    }
    if (!their_failure_.message.empty()) {
      return Error{Errc::protocol, "a final failure comes once, at the end"};
    }
    their_failure_ = wire::failure(frame.failure());
    return {};
  }
  if (served_ < kRequestsPerTurn && served_for_ < kMaxTurn && can_serve(frame) &&
      turn_.may_begin()) {
    serve(frame);
    return {};
  }
  std::optional<MemoryShare> share = place_.budget().try_take(parsed_bytes(frame));
  if (!share) {
    return Error{Errc::limit_exceeded,
                 fmt::format("no memory is left to keep a request of {} bytes until its turn: {} "
                             "are used up; read the answers faster, use fewer connections, or "
                             "raise that key",
                             frame.ByteSizeLong(), peer_memory(place_.budget()))};
  }
  waiting_ = {std::move(frame), *std::move(share)};
  link_.pause();
  // Otherwise work_now() serves it when what is in progress ends. History does not keep its pace
  // then.
  if (can_serve(waiting_->request)) turn_.wait();
  if (channel_ && channel_->busy()) work_soon();
  return {};
}

Result<void> DataCommunicator::greet(const net::Frame& frame) {
  if (!frame.has_hello()) {
    return Error{Errc::protocol, "the first frame on a connection has to be Hello"};
  }
  Result<wire::Greeting> them =
      wire::greeting_untrusted(frame.hello(), "the program at '" + peer_address_ + "'");
  if (!them) {
    // With the names of both ends, which the peer logs.
    return std::move(them).error().context("dssmd of host '" + parts_.self.host + "' refuses");
  }
  if (const wire::CertifiedPeer* peer = link_.peer()) {
    DSSM_TRY(wire::check_certified(*them, *peer, wire::TransportEnd::accepted),
             "dssmd of host '" + parts_.self.host + "' refuses");
    identity_.certified = *peer;
  }
  them_ = *std::move(them);
  identity_.address = peer_address_;
  identity_.host = them_->host;
  identity_.host_id = them_->host_id;
  identity_.program = them_->program;
  DSSM_TRY(parts_.rights.check(identity_, Action::greet, {}));
  greeting_timeout_.disable();
  parts_.observer.on_greeted(*this);
  idle_timeout_.enable_in(kIdleTimeout);
  net::Frame hello;
  wire::to_message(parts_.self, *hello.mutable_hello());
  link_.send(hello);
  return {};
}

void DataCommunicator::on_new_credentials(const wire::TlsCredentials& credentials) {
  const wire::CertifiedPeer* peer = link_.peer();
  if (!peer) return;
  if (Result<void> checked = credentials.check(*peer); !checked) close_with(checked.error());
}

void DataCommunicator::on_new_rights(const Rights& before) {
  if (watch_) {
    watch_->on_new_rights([&](const StreamId& stream) { return before.shows(identity_, stream); });
    work_soon();
  }
  if (!channel_) return;
  for (const Action action : allowed_) {
    Result<void> checked = parts_.rights.check(identity_, action, channel_->stream().id());
    if (!checked) return close_with(checked.error());
  }
}

bool DataCommunicator::can_serve(const net::Frame& request) const {
  if (!link_.is_open() || !link_.output_empty() || opening_) return false;
  return channel_ ? !channel_->busy() : !must_wait_for_recovery(request, parts_.registry);
}

// Whether it is the dssmd that it says it is. A host without credentials has to believe that.
bool DataCommunicator::proves_host() const {
  if (!them_->is_dssmd()) return false;
  if (!wire::credentials_of(parts_.self)) return true;
  return identity_.certified && identity_.certified->kind == wire::CertifiedPeer::Kind::host;
}

void DataCommunicator::become_control() {
  if (!std::exchange(is_control_, true)) link_.stamp_arrivals();  // of heartbeats
}

void DataCommunicator::serve(const net::Frame& request) {
  ++served_;
  const TurnQueue::Work work(parts_.turns);
  const MonoTime begin = MonoClock::now();
  if (Result<void> done = dispatch(request); !done) send_failure(request.serial(), done.error());
  served_for_ += MonoClock::now() - begin;
}

// A channel's actions are decided about once, until the rights change.
Result<void> DataCommunicator::check_access(const net::Frame& request) {
  const std::optional<Action> action = action_of(request);
  if (!action) return unknown_request(parts_.self.host);
  if (channel_ && allowed_.contains(*action)) return {};
  StreamId stream;
  if (channel_) {
    stream = channel_->stream().id();
  } else if (const proto::StreamId* named = subject(request)) {
    stream = {named->name(), named->id(), named->host()};
  }
  Result<void> checked =
      *action == Action::create
          ? parts_.rights.check_create(identity_, stream, parts_.registry.knows(stream),
                                       Action::publish)
          : parts_.rights.check(identity_, *action, stream);
  if (!checked) {
    parts_.logger.warning(
        "refuse a request: " + checked.error().message,
        {.stream = stream.str(), .peer = peer_address_, .message_id = message_id::kRequestRefused});
    return checked;
  }
  if (channel_) allowed_.insert(*action);
  return {};
}

Result<void> DataCommunicator::dispatch(const net::Frame& request) {
  DSSM_TRY(check_access(request));
  if (request.has_ping()) {
    become_control();
    RawTime received = RawClock::now();
    if (parts_.self.clock) received = parts_.self.clock->line.arrival(link_.arrived(), received);
    peer_timeout_.enable_in(wire::kPeerTimeout);
    idle_timeout_.disable();
    if (parts_.clock) parts_.clock->clock_generation();  // so that the report is of now
    net::Frame pong;
    pong.set_serial(request.serial());
    wire::send_clock(parts_.self, *pong.mutable_pong()->mutable_clock());
    pong.mutable_pong()->set_received_ns(to_ns(received));
    pong.mutable_pong()->set_carried_bytes_per_s(
        static_cast<std::uint64_t>(place_.pace().carried_bytes_per_s(parts_.loop.coarse_now())));
    std::optional<clock::HeartbeatTimes> returned;
    if (const net::Ping& ping = request.ping(); pong_sent_ != RawTime() && ping.answered_ns()) {
      returned = {pong_sent_, RawTime(Duration(ping.answered_ns())),
                  RawTime(Duration(ping.raw_ns())), received};
    }
    // All other work first: a PC that has answered is done, which matters where several virtual
    // machines share a processor. The time that it takes is known there.
    parts_.observer.on_heartbeat(proves_host() ? &*them_ : nullptr, returned);
    const RawTime now = RawClock::now();
    if (request.ping().raw_ns()) pong_sent_ = now;
    pong.mutable_pong()->set_raw_ns(to_ns(now));
    link_.send(pong);
    return {};
  }
  if (!channel_ && is_control(request)) return serve_control(request);
  if (!channel_ && opens_a_stream(request)) {
    if (is_control_) {
      return Error{Errc::protocol, "this is a control connection; open another one for the stream"};
    }
    return request.has_open() ? open(request) : create(request);
  }
  if (channel_) {
    if (request.has_start_publishing()) link_.set_turn(turn_, parts_.turns);
    return channel_->serve_untrusted(request);
  }
  return Error{Errc::protocol,
               "dssmd of host '" + parts_.self.host +
                   "' (" DSSM_VERSION
                   ") takes no such request on a connection without an open stream"};
}

Result<void> DataCommunicator::serve_control(const net::Frame& request) {
  become_control();
  if (request.has_watch()) {
    watch_ = std::make_unique<StreamWatch>(
        parts_.registry, parts_.opens, link_,
        [this](const StreamId& stream) { return parts_.rights.shows(identity_, stream); },
        request.serial());
    work_soon();
    return {};
  }
  net::Frame answer;
  answer.set_serial(request.serial());
  if (request.has_list_clock_pairs() && parts_.clock) {
    proto::ClockPairList& list = *answer.mutable_clock_pair_list();
    for (const ClockPair& pair : parts_.clock->clock_pairs()) {
      wire::to_message(pair, *list.add_pairs());
    }
  } else if (request.has_follow_playback()) {
    if (!parts_.playback) return unknown_request(parts_.self.host);
    DSSM_TRY(parts_.playback->follow_untrusted(request.follow_playback(), parts_.loop.now()));
    answer.mutable_done();
  } else {
    DSSM_TRY(catalog_.serve_untrusted(request, answer, identity_.account()));
    if (request.has_list()) parts_.rights.hide(identity_, *answer.mutable_stream_list());
    if (request.has_list_nodes()) parts_.rights.hide(identity_, *answer.mutable_node_list());
  }
  link_.send(answer);
  return {};
}

void DataCommunicator::send_clock() {
  if (channel_ && link_.is_open()) channel_->on_new_clock();
  if (!is_control_ || !link_.is_open() || !them_->has_feature(wire::kFeatureClock)) return;
  net::Frame frame;
  wire::send_clock(parts_.self, *frame.mutable_pong()->mutable_clock());
  link_.send(frame);
}

void DataCommunicator::send_failure(std::uint64_t serial, const Error& error) {
  net::Frame frame;
  frame.set_serial(serial);
  wire::to_message(error, *frame.mutable_failure());
  link_.send(frame);
}

// --- opening

Result<void> DataCommunicator::open(const net::Frame& request) {
  std::shared_ptr<Stream> stream = DSSM_TRY(catalog_.find_untrusted(request.open().id()));
  DSSM_TRY(check_clock(stream->id()));
  opening_ = {request.serial(), std::move(stream), false};
  return go_on_opening();
}

Result<void> DataCommunicator::check_clock(const StreamId& id) const {
  return parts_.clock ? parts_.clock->check_serving(id, *them_) : Result<void>();
}

Result<void> DataCommunicator::create(const net::Frame& request) {
  const StreamId id = DSSM_TRY(wire::stream_id_untrusted(request.create().id()));
  DSSM_TRY(check_clock(id));
  const OpenedRing created =
      DSSM_TRY(catalog_.create_untrusted(request.create(), identity_, parts_.rights));
  opening_ = {request.serial(), created.stream, created.created};
  return go_on_opening();
}

// Takes a slice of a new ring's memory from the system, before anything is written to it, as the
// library does for the programs of this PC: dssmd itself writes to this ring, and would be killed
// by a page that cannot be had. A gigabyte takes a quarter of a second, so it is one slice per turn
// of the loop. True when it was the last one.
//   fails  no_memory
Result<bool> DataCommunicator::reserve_some() {
  Stream& stream = *opening_->stream;
  const std::uint64_t total_bytes = stream.mapping().geometry().total_bytes;
  const std::uint64_t slice = std::min(total_bytes - opening_->reserved_bytes, kReserveSliceBytes);
  DSSM_TRY(stream.reserve(opening_->reserved_bytes, slice));
  opening_->reserved_bytes += slice;
  return opening_->reserved_bytes == total_bytes;
}

Result<void> DataCommunicator::go_on_opening() {
  if (opening_->stream->removed()) {
    const std::string id = opening_->stream->id().str();
    opening_.reset();
    return Error{Errc::not_found, "stream '" + id + "' was removed meanwhile; create it again"};
  }
  if (opening_->created) {
    const Result<bool> reserved = reserve_some();
    if (!reserved) {
      static_cast<void>(parts_.registry.remove(opening_->stream->id()));
      opening_.reset();
      return reserved.error();
    }
    if (!*reserved) {
      work_soon();
      return {};
    }
  }
  const Opening opening = *std::exchange(opening_, std::nullopt);
  idle_timeout_.disable();
  channel_ = std::make_unique<StreamChannel>(
      StreamChannel::Parts{parts_.loop, catalog_, link_, place_.budget(), *this, parts_.self,
                           *them_, identity_.account(), parts_.clock, parts_.sending},
      parts_.streams.get(opening.stream), them_->has_feature(wire::kFeatureTorn));
  net::Frame answer;
  answer.set_serial(opening.serial);
  describe(*opening.stream, parts_.opens, *answer.mutable_opened()->mutable_stream());
  answer.mutable_opened()->set_created(opening.created);
  link_.send(answer);
  const std::string id = opening.stream->id().str();
  parts_.logger.info(
      fmt::format("channel of '{}' opened by {}", id, peer()),
      {.stream = id, .peer = peer_address_, .message_id = message_id::kChannelOpened});
  return {};
}

// --- turns

void DataCommunicator::work_soon() {
  turn_is_due_ = true;
  next_turn_.enable_in(Duration::zero());
}

void DataCommunicator::on_output_empty() { work_now(); }

// An exception that leaves a callback would end dssmd; one that goes through a feed's or another
// connection's work, that connection.
[[gnu::hot]] void DataCommunicator::work_now() {
  try {
    do_work();
  } catch (const std::bad_alloc&) {
    link_.close_with(no_memory_left());
  }
}

[[gnu::hot]] void DataCommunicator::do_work() {
  if (!link_.is_open()) return;
  if (std::exchange(turn_is_due_, false)) next_turn_.disable();
  served_ = 0;
  served_for_ = {};
  if (opening_) {
    const std::uint64_t serial = opening_->serial;
    if (Result<void> opened = go_on_opening(); !opened) send_failure(serial, opened.error());
  }
  if (waiting_ && can_serve(waiting_->request) && turn_.may_begin()) {
    const Waiting waiting = *std::exchange(waiting_, std::nullopt);
    serve(waiting.request);
    link_.resume();
  }
  if (channel_ && turn_.may_begin(TurnQueue::Reason::event)) {
    const TurnQueue::Work work(parts_.turns);
    link_.take_turn();
    if (!link_.is_open()) return;
    const Result<void> worked = channel_->work(waiting_.has_value());
    if (!worked) return link_.close_with(worked.error());
  }
  if (watch_ && watch_->has_more() && turn_.may_begin()) {
    const TurnQueue::Work work(parts_.turns);
    if (watch_->work()) turn_.wait();
  }
  if (waiting_ && can_serve(waiting_->request)) turn_.wait();
}

void DataCommunicator::check_peer_timeout() {
  const Duration silent = parts_.loop.now() - link_.last_heard();
  // While the link is paused, this side does not receive.
  if (silent < wire::kPeerTimeout || link_.is_paused()) {
    const Duration rest = wire::kPeerTimeout - silent;
    return peer_timeout_.enable_in(link_.is_paused() ? wire::kPeerTimeout : rest);
  }
  link_.close_with({Errc::unavailable, fmt::format("no bytes came from {} for {} ms", peer(),
                                                   silent / std::chrono::milliseconds(1))});
}

void DataCommunicator::check_idle() {
  const Duration silent = parts_.loop.now() - link_.last_heard();
  const bool is_busy = opening_ || waiting_ || !link_.output_empty();
  if (is_busy || silent < kIdleTimeout) {
    return idle_timeout_.enable_in(is_busy ? kIdleTimeout : kIdleTimeout - silent);
  }
  link_.close_with({Errc::unavailable,
                    fmt::format("{} has no channel, and sent neither heartbeats nor requests for "
                                "{} s",
                                peer(), kIdleTimeout / std::chrono::seconds(1))});
}

// --- what happens to streams

void DataCommunicator::on_stream_added(const Stream& stream) {
  if (watch_) watch_->on_stream_added(stream);
  if (waiting_) work_soon();  // perhaps for this one
}

void DataCommunicator::on_property_set(const Stream& stream) {
  if (watch_) watch_->on_property_set(stream);
}

void DataCommunicator::on_stream_removed(const Stream& stream) {
  if (watch_) watch_->on_stream_removed(stream);
  if (channel_ && &channel_->stream() == &stream) channel_->on_removed();
}

void DataCommunicator::on_recovered() {
  if (watch_ || waiting_) work_soon();
}

// --- the end

void DataCommunicator::on_closed(const Error& why) {
  turn_.stop();
  next_turn_.disable();
  greeting_timeout_.disable();
  idle_timeout_.disable();
  peer_timeout_.disable();
  // Removes a ring whose memory is not fully reserved, unless a program or peer has opened it
  // meanwhile.
  if (opening_ && opening_->created && opening_->stream->channels().empty() &&
      !opening_->stream->removed()) {
    const OpenTable::Counts counts = parts_.opens.counts(*opening_->stream);
    if (counts.writers + counts.readers == 0) {
      static_cast<void>(parts_.registry.remove(opening_->stream->id()));
    }
  }
  log_end(why);
  channel_.reset();
  watch_.reset();
  parts_.observer.on_ended(*this);
}

void DataCommunicator::log_end(const Error& why) {
  const std::string reason = their_failure_.message.empty() ? why.message : their_failure_.message;
  if (why.code != Errc::unavailable) {
    parts_.logger.warning(fmt::format("closed the connection of {}: {}", peer(), why.message),
                          {.peer = peer_address_, .message_id = message_id::kPeerRefused});
  }
  if (!channel_) {
    if (is_control_) {
      parts_.logger.info(fmt::format("control connection of {} ended: {}", peer(), reason),
                         {.peer = peer_address_});
    }
    return;
  }
  const std::string id = channel_->stream().id().str();
  parts_.logger.info(
      fmt::format("channel of '{}' of {} ended: {}", id, peer(), reason),
      {.stream = id, .peer = peer_address_, .message_id = message_id::kChannelClosed});
  const SampleSender::Counters& sent = channel_->counters();
  const wire::DecoderCounters& received = link_.counters();
  parts_.logger.debug(
      fmt::format("channel of '{}': {} samples sent ({} payload bytes copied, {} sent in place, {} "
                  "samples torn, {} lost), {} received ({} payload bytes copied, {} received in "
                  "place)",
                  id, sent.samples, sent.copied_payload_bytes, sent.in_place_payload_bytes,
                  sent.torn, channel_->lost(), received.samples, received.copied_payload_bytes,
                  received.direct_payload_bytes),
      {.stream = id, .peer = peer_address_});
}

// --- watching

StreamWatch::StreamWatch(const Registry& registry, const OpenTable& opens, FrameConnection& link,
                         Shows shows, std::uint64_t serial)
    : registry_(registry), opens_(opens), link_(link), shows_(std::move(shows)), serial_(serial) {
  for (const std::shared_ptr<Stream>& stream : registry.streams()) pending_.push_back({stream});
}

bool StreamWatch::work() {
  for (int sent = 0; !pending_.empty() && link_.output_empty(); ++sent) {
    if (sent == kStreamsPerTurn) return true;
    const std::shared_ptr<const Stream> stream = pending_.front().stream.lock();
    const std::optional<Tid> property_after = pending_.front().property_after;
    pending_.pop_front();
    if (stream && !stream->removed() && shows_(stream->id())) send_added(*stream, property_after);
  }
  if (!pending_.empty() || serial_ == 0 || registry_.may_miss_streams()) return false;
  net::Frame done;
  done.set_serial(serial_);
  done.mutable_done();
  serial_ = 0;
  link_.send(done);
  return false;
}

void StreamWatch::send_added(const Stream& stream, std::optional<Tid> property_after) {
  net::Frame frame;
  proto::StreamEvent& event = *frame.mutable_stream_event();
  event = added_event(stream, opens_, property_after.has_value());
  if (property_after) event.mutable_stream()->set_newest(*property_after);
  link_.send(frame);
}

void StreamWatch::on_stream_added(const Stream& stream) {
  if (!shows_(stream.id())) return;
  if (pending_.empty()) {
    send_added(stream);
  } else {
    pending_.push_back({stream.weak_from_this()});
  }
}

// A program may set properties faster than the link takes events: then one is sent for several.
void StreamWatch::on_property_set(const Stream& stream) {
  if (!shows_(stream.id())) return;
  const Tid newest = added_event(stream, opens_, true).stream().newest();
  if (pending_.empty() && link_.output_empty()) return send_added(stream, newest);
  const auto pending = std::find_if(pending_.begin(), pending_.end(), [&](const Pending& one) {
    return one.property_after && one.stream.lock().get() == &stream;
  });
  if (pending != pending_.end()) {
    pending->property_after = newest;
  } else {
    pending_.push_back({stream.weak_from_this(), newest});
  }
}

// Also for one whose addition was not sent yet: a receiver ignores the removal of an unknown
// stream.
void StreamWatch::on_stream_removed(const Stream& stream) {
  if (shows_(stream.id())) send_removed(stream);
}

void StreamWatch::on_new_rights(const Shows& showed) {
  for (const std::shared_ptr<Stream>& stream : registry_.streams()) {
    const bool is_shown = shows_(stream->id());
    if (is_shown == showed(stream->id())) continue;
    if (is_shown) {
      pending_.push_back({stream});
    } else {
      send_removed(*stream);
    }
  }
}

void StreamWatch::send_removed(const Stream& stream) {
  net::Frame frame;
  *frame.mutable_stream_event() = removed_event(stream.id(), stream.incarnation());
  link_.send(frame);
}

}  // namespace dssm::daemon
