// SPDX-License-Identifier: Apache-2.0
#include "client/view/foxglove.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <chrono>
#include <cstring>
#include <limits>
#include <optional>
#include <span>
#include <string_view>
#include <utility>

#include "client/dssmctl/nodes.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "client/recording/ros2_schema.hpp"
#include "client/recording/stream_channel.hpp"

namespace dssm::view {
namespace {

using ctl::Json;

// What may wait for one client. A single sample may be larger.
constexpr std::size_t kMaxWaitingBytes = 1U << 20;
// With so much more, of answers and lists, the connection is ended.
constexpr std::size_t kMaxUnread = 64U << 20;
constexpr std::size_t kMaxSubscriptions = 4096;
// Of one stream in one turn, so that no other waits long.
constexpr int kMaxTurnSamples = 200;
constexpr Duration kTimePeriod = std::chrono::milliseconds(50);
constexpr Duration kLossReportPeriod = std::chrono::seconds(2);
// A client gets samples in their order. For one that is still to come although newer ones are here,
// it waits so long: after that the present is worth more.
constexpr Duration kMaxArriving = std::chrono::seconds(1);

// The first byte of a binary message.
constexpr unsigned char kMessageData = 1;
constexpr unsigned char kTime = 2;
constexpr unsigned char kPlaybackState = 5;
// Of a client.
constexpr unsigned char kPlaybackControl = 3;

// Of a recording, or of all rings, in one turn.
constexpr int kMaxPlayedSamples = 2000;
constexpr float kMaxSpeed = 1000;

template <class Number>
void put(std::vector<std::byte>& out, Number number) {
  const auto bytes = std::as_bytes(std::span(&number, 1));
  out.insert(out.end(), bytes.begin(), bytes.end());
}

// A sample as CDR, as a recording has it but without the trailer.
Message sample_message(std::uint32_t id, const TypeInfo& type, const SampleInfo& info,
                       std::span<const std::byte> payload) {
  std::vector<std::byte> head;
  head.reserve(32);
  put(head, kMessageData);
  put(head, id);
  put(head, recording::log_time_of(info.time));
  put(head, recording::kCdrHead);
  const bool is_sequence = recording::is_sequence(type);
  if (is_sequence) put(head, static_cast<std::uint32_t>(payload.size()));
  // One that is shorter than its type has zeros in its place.
  const std::vector<std::byte> rest(is_sequence ? 0 : type.payload_bytes - payload.size());
  return Message::binary({head, payload, rest});
}

}  // namespace

class FoxgloveConnection : public Connection {
 public:
  FoxgloveConnection(FoxgloveClients& clients, Peer& peer) : clients_(clients), peer_(peer) {
    clients_.connections_.insert(this);
    Json info = {{"op", "serverInfo"},
                 {"name", fmt::format("dssm-view on {}", clients_.name_)},
                 {"capabilities", {"time", "connectionGraph"}},
                 {"supportedEncodings", Json::array()},
                 {"metadata", {{"host", clients_.name_}}},
                 {"sessionId", clients_.session_id_}};
    if (const auto* recording = std::get_if<Recording>(&clients_.played_)) {
      playback_.emplace(clients_.range_.value_or(TimeRange{}), recording);
    } else if (peer_.path() == FoxgloveClients::kHoldPath) {
      if (!clients_.range_) {
        peer_.close("the rings hold nothing, or that is not known yet: connect again");
        return;
      }
      playback_.emplace(*clients_.range_, nullptr);
    }
    if (playback_) {
      info["capabilities"] = {"time", "playbackControl"};
      info["dataStartTime"] = seconds_json(playback_->begin);
      info["dataEndTime"] = seconds_json(playback_->end);
    }
    send(info);
    advertise();
  }
  FoxgloveConnection(const FoxgloveConnection&) = delete;
  FoxgloveConnection& operator=(const FoxgloveConnection&) = delete;
  ~FoxgloveConnection() override { clients_.connections_.erase(this); }

  void on_text(std::string_view text) override {
    if (peer_.waiting_bytes() > kMaxUnread) return peer_.close("messages are not read");
    const Json request = Json::parse(text, nullptr, false);
    const auto op = request.is_object() ? request.find("op") : request.end();
    if (!request.is_object() || op == request.end() || !op->is_string()) {
      return report(2, "a message is to be a JSON object with a text 'op'");
    }
    if (*op == "subscribe") return subscribe(request);
    if (*op == "unsubscribe") return unsubscribe(request);
    if (*op == "subscribeConnectionGraph") {
      if (std::exchange(wants_graph_, true)) return;
      clients_.want_all_();
      return send_graph();
    }
    if (*op == "unsubscribeConnectionGraph") {
      wants_graph_ = false;
      return;
    }
    report(1, fmt::format("this server does not offer '{}'", op->get<std::string>()));
  }

  // Tells the client of channels that it does not know, and of those that are gone.
  void advertise() {
    Json gone = Json::array();
    for (const std::uint32_t id : advertised_) {
      if (!clients_.channels_.contains(id)) gone.push_back(id);
    }
    if (!gone.empty()) {
      for (const Json& id : gone) {
        advertised_.erase(id.get<std::uint32_t>());
        std::erase_if(subscriptions_, [&](const auto& subscription) {
          return subscription.second.channel == id.get<std::uint32_t>();
        });
      }
      send({{"op", "unadvertise"}, {"channelIds", gone}});
    }
    std::string added;
    for (const auto& [id, channel] : clients_.channels_) {
      if (!advertised_.insert(id).second) continue;
      if (!added.empty()) added += ',';
      added += channel.advertisement;
    }
    if (!added.empty()) {
      peer_.send(Message::text(fmt::format(R"({{"op":"advertise","channels":[{}]}})", added)));
    }
  }

  bool wants_graph() const { return wants_graph_; }
  void send_graph() {
    if (wants_graph_ && !clients_.graph_.empty()) peer_.send(Message::text(clients_.graph_));
  }

  // Playback control: a command (0 play, 1 pause), a speed, whether and where to seek, and the text
  // by which the client knows the answer.
  void on_binary(std::string_view bytes) override {
    if (peer_.waiting_bytes() > kMaxUnread) return peer_.close("messages are not read");
    const auto code = take<std::uint8_t>(bytes);
    if (!playback_ || code != kPlaybackControl) return;
    const auto command = take<std::uint8_t>(bytes);
    const auto speed = take<float>(bytes);
    const auto has_seek = take<std::uint8_t>(bytes);
    const auto seek_ns = take<std::uint64_t>(bytes);
    const auto id_bytes = take<std::uint32_t>(bytes);
    if (!id_bytes || *id_bytes != bytes.size() || *command > 1 || !(*speed > 0) ||
        *speed > kMaxSpeed) {
      return report(2, fmt::format("playback control is to play or to pause, with a speed up to {}",
                                   kMaxSpeed));
    }
    const MonoTime now = MonoClock::now();
    if (*has_seek != 0) seek(time_of(*seek_ns));
    if (*command == 0 && playback_->is_ended()) seek(playback_->begin);
    playback_->speed = *speed;
    playback_->is_playing = *command == 0;
    playback_->moved = now;
    send_playback_state(*has_seek != 0, bytes);
  }

  void send_samples(MonoTime now) {
    if (playback_) {
      play(now);
    } else {
      for (auto& [id, subscription] : subscriptions_) send_samples(id, subscription, now);
    }
    if (now >= next_time_ && peer_.waiting_bytes() < kMaxWaitingBytes) {
      next_time_ = now + kTimePeriod;
      std::vector<std::byte> message;
      put(message, kTime);
      if (playback_) {
        put(message, recording::log_time_of(playback_->position));
      } else {
        const double now_s = std::get<PlaybackClock>(clients_.played_).now_s();
        put(message, static_cast<std::uint64_t>(std::max(now_s, 0.0) * 1e9));
      }
      peer_.send(Message::binary({message}));
    }
    if (left_out_ > 0 && now >= next_report_ && peer_.waiting_bytes() < kMaxWaitingBytes) {
      next_report_ = now + kLossReportPeriod;
      report(1,
             fmt::format("{} samples were left out: {}", std::exchange(left_out_, 0),
                         playback_ ? "they were overwritten, came too late, or are of another type"
                                   : "this client or a network is slower than the streams"));
    }
  }

 private:
  struct Subscription {
    std::uint32_t channel = 0;
    Tid next = kNoTid;  // kNoTid: from the newest on
    std::uint64_t incarnation = 0;
    std::optional<MonoTime> arriving_since;  // sample `next`
    bool wants_present = true;  // of a playback: it has not got a sample of the position yet
  };

  // Where this client is in the recording, or in what the rings held when it connected.
  struct Playback {
    Playback(TimeRange range, const Recording* recording)
        : begin(range.first), end(range.last), position(range.first) {
      if (!recording) return;
      cursor = recording->cursor();
      for (const RecordedStreamInfo& stream : recording->streams()) {
        streams.emplace_back(stream.id.str(), stream.type);
      }
    }
    bool is_ended() const { return position >= end; }

    std::optional<RecordingCursor> cursor;  // none: of the rings
    // Names and types of the streams, by their indices in the recording.
    std::vector<std::pair<std::string, TypeInfo>> streams;
    Time begin{}, end{};
    Time position{};                     // what is before it was sent
    std::optional<RecordedSample> next;  // the cursor's, which is not due yet
    float speed = 1;
    bool is_playing = false;
    MonoTime moved{};  // when `position` was set
  };

  static Time time_of(std::uint64_t log_time) {
    constexpr std::uint64_t kGreatest = std::numeric_limits<std::int64_t>::max();
    return time_from_ns(static_cast<std::int64_t>(std::min(log_time, kGreatest)));
  }

  static Json seconds_json(Time time) {
    const std::uint64_t ns = recording::log_time_of(time);
    return {{"sec", ns / 1'000'000'000}, {"nsec", ns % 1'000'000'000}};
  }

  template <class Number>
  static std::optional<Number> take(std::string_view& bytes) {
    Number number;
    if (bytes.size() < sizeof number) {
      bytes = {};
      return std::nullopt;
    }
    std::memcpy(&number, bytes.data(), sizeof number);
    bytes.remove_prefix(sizeof number);
    return number;
  }

  void send_playback_state(bool did_seek, std::string_view request_id) {
    const std::uint8_t status = playback_->is_ended() ? 3 : playback_->is_playing ? 0 : 1;
    std::vector<std::byte> message;
    put(message, kPlaybackState);
    put(message, status);
    put(message, recording::log_time_of(playback_->position));
    put(message, playback_->speed);
    put(message, static_cast<std::uint8_t>(did_seek));
    put(message, static_cast<std::uint32_t>(request_id.size()));
    const auto id = std::as_bytes(std::span(request_id));
    message.insert(message.end(), id.begin(), id.end());
    peer_.send(Message::binary({message}));
  }

  // Every subscription gets the sample of that time, too, so that what is paused is shown.
  void seek(Time time) {
    playback_->position = std::clamp(time, playback_->begin, playback_->end);
    if (playback_->cursor) playback_->cursor->seek(playback_->position);
    playback_->next.reset();
    for (auto& [id, subscription] : subscriptions_) {
      subscription.wants_present = true;
      subscription.next = kNoTid;
    }
  }

  void play(MonoTime now) {
    for (auto& [id, subscription] : subscriptions_) {
      if (peer_.waiting_bytes() >= kMaxWaitingBytes) return;
      if (subscription.wants_present) send_present(id, subscription);
    }
    Playback& playback = *playback_;
    if (!playback.is_playing) return;
    const auto passed = std::chrono::duration<double>(now - playback.moved) * playback.speed;
    const Time until = std::min(
        ctl::saturating_add(playback.position, std::chrono::duration_cast<Duration>(passed)),
        playback.end);
    const Time sent_until = playback.cursor ? play_recording(until) : play_rings(until);
    // A client that is slower than its speed gets all, later.
    playback.position = std::clamp(sent_until, playback.position, until);
    playback.moved = now;
    if (playback.is_ended()) {
      playback.is_playing = false;
      send_playback_state(false, {});
    }
  }

  // Sends what comes until that time, and returns it; or a time before what is sent later.
  Time play_recording(Time until) {
    Playback& playback = *playback_;
    std::map<std::string, std::uint32_t> subscriptions;  // by the streams
    for (const auto& [id, subscription] : subscriptions_) {
      const auto channel = clients_.channels_.find(subscription.channel);
      if (channel != clients_.channels_.end()) subscriptions[channel->second.stream] = id;
    }
    for (int i = 0;; ++i) {
      if (!playback.next) {
        RecordedSample sample;
        if (!playback.cursor->next(sample)) break;
        playback.next = sample;
      }
      const RecordedSample& sample = *playback.next;
      if (sample.info.time > until) break;
      if (i == kMaxPlayedSamples || peer_.waiting_bytes() >= kMaxWaitingBytes) {
        return ctl::saturating_add(sample.info.time, -Duration(1));
      }
      const auto& [name, type] = playback.streams[sample.stream];
      if (const auto found = subscriptions.find(name); found != subscriptions.end()) {
        const auto& channel = clients_.channels_.at(subscriptions_.at(found->second).channel);
        // An earlier incarnation may have another type than the channel.
        if (type == channel.type) {
          send_sample(found->second, channel, sample.info, sample.payload);
        } else {
          ++left_out_;
        }
      }
      playback.next.reset();
    }
    return until;
  }

  // A sample of a ring that is to be sent.
  struct Due {
    Time time;
    std::uint32_t subscription;
    Tid tid;
  };

  // The reader of the stream, if it is open and of the type of the channel.
  RawReader* reader_of(const FoxgloveClients::Channel& channel) {
    OpenStream* const stream = clients_.streams_.find(channel.stream).stream;
    if (!stream) return nullptr;
    auto& reader = std::get<RawReader>(stream->reader);
    return is_of(channel, reader) ? &reader : nullptr;
  }

  // Whether the channel was made for what is read now: else the next state brings a new one. What
  // another host lists of a stream and what it then sends need not agree.
  static bool is_of(const FoxgloveClients::Channel& channel, const RawReader& reader) {
    return reader.incarnation() == channel.incarnation &&
           reader.payload_bytes() == channel.type.payload_bytes;
  }

  void leave_out_before(Subscription& subscription, Tid tid) {
    if (tid <= subscription.next) return;
    left_out_ += static_cast<std::uint64_t>(tid - subscription.next);
    subscription.next = tid;
    subscription.arriving_since.reset();
  }

  // Of each subscription the samples after the last one sent, until `until`, or until there are
  // many; then `until` is before the others.
  std::vector<Due> due_of_rings(Time& until) {
    std::vector<Due> due;
    const std::size_t share = std::max<std::size_t>(
        kMaxPlayedSamples / std::max<std::size_t>(subscriptions_.size(), 1), 8);
    for (auto& [id, subscription] : subscriptions_) {
      const auto channel = clients_.channels_.find(subscription.channel);
      if (channel == clients_.channels_.end()) continue;
      RawReader* const reader = reader_of(channel->second);
      if (!reader) continue;
      SampleInfo info;
      if (subscription.next == kNoTid) {
        const ReadStatus found = reader->find(playback_->position, info);
        // Else it is still on its way, or may not be read by time.
        if (found != ReadStatus::ok && found != ReadStatus::too_old) continue;
        subscription.next = found == ReadStatus::ok ? info.tid + 1 : reader->oldest_tid();
      }
      leave_out_before(subscription, reader->oldest_tid());  // it was overwritten meanwhile
      const Tid end = reader->newest_tid() + 1;
      std::size_t taken = 0;
      for (Tid tid = subscription.next; tid < end && taken < share; ++tid) {
        const ReadStatus status = reader->read_info(tid, info);
        if (status == ReadStatus::arriving || (status == ReadStatus::ok && info.time > until))
          break;
        if (status != ReadStatus::ok) {  // it was lost
          if (taken == 0) leave_out_before(subscription, tid + 1);
          continue;
        }
        due.push_back({info.time, id, tid});
        if (++taken == share) until = info.time;
      }
    }
    std::erase_if(due, [&](const Due& one) { return one.time > until; });
    std::ranges::stable_sort(due, {}, &Due::time);
    return due;
  }

  Time play_rings(Time until) {
    for (const Due& due : due_of_rings(until)) {
      if (peer_.waiting_bytes() >= kMaxWaitingBytes) {
        return ctl::saturating_add(due.time, -Duration(1));
      }
      Subscription& subscription = subscriptions_.at(due.subscription);
      const FoxgloveClients::Channel& channel = clients_.channels_.at(subscription.channel);
      subscription.next = due.tid + 1;
      // What it had arrived late, or it restarts.
      RawReader* const reader = due.time <= playback_->position ? nullptr : reader_of(channel);
      BorrowedSample sample;
      if (!reader || reader->borrow(due.tid, sample) != ReadStatus::ok) {
        ++left_out_;
        continue;
      }
      Message message =
          sample_message(due.subscription, channel.type, sample.info(), sample.payload());
      if (sample.still_valid()) {
        peer_.send(std::move(message));
      } else {
        ++left_out_;
      }
    }
    return until;
  }

  // The sample that the stream had at the position.
  void send_present(std::uint32_t id, Subscription& subscription) {
    const auto channel = clients_.channels_.find(subscription.channel);
    if (channel == clients_.channels_.end()) return;
    const Streams::Found found = clients_.streams_.find(channel->second.stream);
    if (!found.stream) return;  // it is being opened
    std::vector<std::byte> payload;
    SampleInfo info;
    const auto read = [&](auto& reader) {
      payload.resize(reader.payload_bytes());
      return reader.read_at(playback_->position, payload, info);
    };
    auto* const recorded = std::get_if<RecordedRawReader>(&found.stream->reader);
    const ReadStatus status = recorded ? past_restarts([&] { return read(*recorded); })
                                       : read(std::get<RawReader>(found.stream->reader));
    if (status == ReadStatus::arriving || status == ReadStatus::restarted) return;  // soon
    subscription.wants_present = false;
    if (status == ReadStatus::ok && found.stream->type() == channel->second.type) {
      send_sample(id, channel->second, info, std::span(payload).first(info.payload_bytes));
    }
  }

  void send_sample(std::uint32_t id, const FoxgloveClients::Channel& channel,
                   const SampleInfo& info, std::span<const std::byte> payload) {
    peer_.send(sample_message(id, channel.type, info, payload));
  }

  void send(const Json& message) { peer_.send(Message::text(ctl::json_text(message))); }
  // level: 0 info, 1 warning, 2 error
  void report(int level, const std::string& text) {
    if (peer_.waiting_bytes() >= kMaxWaitingBytes) return;
    send({{"op", "status"}, {"level", level}, {"message", text}});
  }

  static std::optional<std::uint32_t> id_of(const Json& json) {
    if (!json.is_number_unsigned() ||
        json.get<std::uint64_t>() > std::numeric_limits<std::uint32_t>::max()) {
      return std::nullopt;
    }
    return json.get<std::uint32_t>();
  }

  void subscribe(const Json& request) {
    const auto list = request.find("subscriptions");
    if (list == request.end() || !list->is_array()) return;
    for (const Json& entry : *list) {
      const auto number = [&](const char* key) -> std::optional<std::uint32_t> {
        if (!entry.is_object() || !entry.contains(key)) return std::nullopt;
        return id_of(entry[key]);
      };
      const auto id = number("id"), channel = number("channelId");
      if (!id || !channel || !clients_.channels_.contains(*channel)) {
        report(2, "a subscription names a channel that does not exist");
      } else if (subscriptions_.size() >= kMaxSubscriptions) {
        report(2, "too many subscriptions");
      } else if (std::ranges::any_of(subscriptions_, [&](const auto& numbered) {
                   return numbered.first == *id || numbered.second.channel == *channel;
                 })) {
        report(1, fmt::format("there is a subscription {}, or one to channel {}, already", *id,
                              *channel));
      } else {
        subscriptions_.emplace(*id, Subscription{.channel = *channel});
      }
    }
  }

  void unsubscribe(const Json& request) {
    const auto list = request.find("subscriptionIds");
    if (list == request.end() || !list->is_array()) return;
    for (const Json& id : *list) {
      if (const auto number = id_of(id)) subscriptions_.erase(*number);
    }
  }

  void send_samples(std::uint32_t id, Subscription& subscription, MonoTime now) {
    const auto channel = clients_.channels_.find(subscription.channel);
    if (channel == clients_.channels_.end()) return;
    OpenStream* const stream = clients_.streams_.find(channel->second.stream).stream;
    if (!stream) return;
    RawReader& reader = std::get<RawReader>(stream->reader);
    if (subscription.incarnation != reader.incarnation()) {
      subscription.incarnation = reader.incarnation();
      subscription.next = kNoTid;
      subscription.arriving_since.reset();
    }
    if (!is_of(channel->second, reader)) return;
    const Tid newest = reader.newest_tid();
    if (newest == kNoTid) return;
    if (subscription.next == kNoTid) subscription.next = newest;
    leave_out_before(subscription, reader.oldest_tid());
    for (int i = 0; i < kMaxTurnSamples && subscription.next <= newest; ++i) {
      if (peer_.waiting_bytes() >= kMaxWaitingBytes) {
        return leave_out_before(subscription, newest + 1);
      }
      BorrowedSample sample;
      const ReadStatus status = reader.borrow(subscription.next, sample);
      if (status == ReadStatus::restarted) return stream->follow_restart();
      if (status == ReadStatus::not_yet) return;
      if (status == ReadStatus::arriving) {
        if (!subscription.arriving_since) subscription.arriving_since = now;
        if (now - *subscription.arriving_since < kMaxArriving) return;
        leave_out_before(subscription, newest);
        continue;
      }
      subscription.arriving_since.reset();
      ++subscription.next;
      if (status != ReadStatus::ok) {
        ++left_out_;
        continue;
      }
      Message message = sample_message(id, channel->second.type, sample.info(), sample.payload());
      if (sample.still_valid()) {
        peer_.send(std::move(message));
      } else {
        ++left_out_;
      }
    }
  }

  FoxgloveClients& clients_;
  Peer& peer_;
  std::set<std::uint32_t> advertised_;                   // channels
  std::map<std::uint32_t, Subscription> subscriptions_;  // by the client's ids
  std::optional<Playback> playback_;                     // of a recording, or at kHoldPath
  bool wants_graph_ = false;
  std::uint64_t left_out_ = 0;  // samples, since the last report
  MonoTime next_time_{}, next_report_{};
};

FoxgloveClients::FoxgloveClients(std::string name, Streams& streams, std::function<void()> want_all,
                                 std::variant<PlaybackClock, Recording> played)
    : name_(std::move(name)),
      streams_(streams),
      want_all_(std::move(want_all)),
      played_(std::move(played)),
      session_id_(std::to_string(to_ns(WallClock::now()))) {}

std::unique_ptr<Connection> FoxgloveClients::connect(Peer& peer) {
  return std::make_unique<FoxgloveConnection>(*this, peer);
}

void FoxgloveClients::on_state(const VehicleState& state) {
  range_ = state.range;
  std::set<std::pair<std::string, std::uint64_t>> there;
  for (const StreamInfo& stream : state.streams) {
    const std::string name = stream.id.str();
    there.emplace(name, stream.incarnation);
    const auto known = std::ranges::find_if(channels_, [&](const auto& numbered) {
      return numbered.second.stream == name && numbered.second.incarnation == stream.incarnation &&
             numbered.second.type == stream.type;
    });
    if (known != channels_.end()) continue;
    std::erase_if(channels_, [&](const auto& numbered) { return numbered.second.stream == name; });
    const recording::Ros2Schema schema = recording::ros2_schema(stream.type);
    const std::uint32_t id = ++last_channel_;
    const Json advertisement = {{"id", id},
                                {"topic", recording::topic_of(stream.id)},
                                {"encoding", "cdr"},
                                {"schemaName", schema.name},
                                {"schema", schema.text},
                                {"schemaEncoding", "ros2msg"}};
    channels_[id] = {name, recording::topic_of(stream.id), stream.incarnation, stream.type,
                     ctl::json_text(advertisement)};
  }
  std::erase_if(channels_, [&](const auto& numbered) {
    return !there.contains({numbered.second.stream, numbered.second.incarnation});
  });

  // Writers and readers of each topic, also of those that have none: a client keeps what it knows
  // of a topic that is not named.
  std::map<std::string, std::pair<Json, Json>> users;
  for (const auto& [id, channel] : channels_) {
    users[channel.topic] = {Json::array(), Json::array()};
  }
  for (const NodeInfo& node : state.nodes) {
    const std::string program = fmt::format("{}@{} ({})", node.program, node.host, node.pid);
    for (const NodeStream& used : node.streams) {
      const auto topic = users.find(recording::topic_of(used.stream));
      if (topic == users.end()) continue;
      auto& [writers, readers] = topic->second;
      (used.role == Role::writer ? writers : readers).push_back(program);
    }
  }
  Json published = Json::array(), subscribed = Json::array();
  for (const auto& [topic, programs] : users) {
    const auto& [writers, readers] = programs;
    published.push_back({{"name", topic}, {"publisherIds", writers}});
    subscribed.push_back({{"name", topic}, {"subscriberIds", readers}});
  }
  // A whole graph each time it changes: clients replace what they know of each topic.
  const std::string graph = ctl::json_text({{"op", "connectionGraphUpdate"},
                                            {"publishedTopics", published},
                                            {"subscribedTopics", subscribed},
                                            {"advertisedServices", Json::array()},
                                            {"removedTopics", Json::array()},
                                            {"removedServices", Json::array()}});
  const bool is_new_graph = graph != graph_;
  graph_ = graph;
  for (FoxgloveConnection* connection : connections_) {
    connection->advertise();
    if (connection->wants_graph()) want_all_();  // that is, the next one, too
    if (is_new_graph) connection->send_graph();
  }
}

void FoxgloveClients::send_samples() {
  const MonoTime now = MonoClock::now();
  for (FoxgloveConnection* connection : connections_) connection->send_samples(now);
}

}  // namespace dssm::view
