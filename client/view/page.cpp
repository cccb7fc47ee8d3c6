// SPDX-License-Identifier: Apache-2.0
#include "client/view/page.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <limits>
#include <optional>
#include <utility>
#include <vector>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/text.hpp"
#include "client/view/curves.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

using ctl::Json;

constexpr std::size_t kMaxUnanswered = 16;
constexpr std::size_t kMaxStreams = 64;  // of one request
constexpr std::size_t kMaxSavedStreams = 1024;
constexpr std::size_t kMaxAskedFields = 64;
constexpr std::uint64_t kMaxPoints = 20'000;
constexpr std::uint64_t kMaxAllPoints = 400'000;      // of all fields of one request
constexpr std::uint64_t kMaxAnswerBytes = 32U << 20;  // of one answer
// For samples that are read for one answer, each as long as its stream's longest.
constexpr std::uint64_t kMaxReadBytes = 4 * kMaxAnswerBytes;
constexpr std::size_t kAlignment = 8;  // of data in an answer

Error bad_request(std::string text) { return {Errc::invalid_argument, std::move(text)}; }

// --- requests

std::string text_of(const Json& request, const char* key) {
  const auto found = request.find(key);
  return found != request.end() && found->is_string() ? found->get<std::string>() : std::string();
}

// Nanoseconds as a string; empty: null, or nothing is there.
Result<std::optional<Time>> time_of(const Json& request, const char* key) {
  const auto found = request.find(key);
  if (found == request.end() || found->is_null()) return std::optional<Time>();
  const std::string text = text_of(request, key);
  std::int64_t ns = 0;
  const auto end = text.data() + text.size();
  const auto read = std::from_chars(text.data(), end, ns);
  if (text.empty() || read.ptr != end || read.ec != std::errc()) {
    return bad_request(fmt::format("'{}' is to be a string of nanoseconds since 1970", key));
  }
  return std::optional(time_from_ns(ns));
}

Result<std::vector<std::string>> texts_of(const Json& request, const char* key, std::size_t most) {
  const auto found = request.find(key);
  std::vector<std::string> texts;
  if (found == request.end() || !found->is_array() || found->size() > most) {
    return bad_request(fmt::format("'{}' is to be a list of at most {} strings", key, most));
  }
  for (const Json& text : *found) {
    if (!text.is_string()) return bad_request(fmt::format("'{}' is to have strings only", key));
    texts.push_back(text.get<std::string>());
  }
  return texts;
}

// --- answers

std::span<const std::byte> bytes_of(const std::vector<double>& numbers) {
  return std::as_bytes(std::span(numbers));
}

// An answer with data. Its head names where they are.
class DataAnswer {
 public:
  explicit DataAnswer(std::uint32_t id) : id_(id) {}

  // Where the data will be; they must live until message().
  std::uint64_t add(std::span<const std::byte> data) {
    static constexpr std::array<std::byte, kAlignment> kPadding{};
    const std::uint64_t at = bytes_;
    const std::size_t padding = (kAlignment - data.size() % kAlignment) % kAlignment;
    parts_.push_back(data);
    parts_.push_back(std::span(kPadding).first(padding));
    bytes_ += data.size() + padding;
    return at;
  }

  Message message(const Json& head) const {
    std::string text = ctl::json_text(head);
    text.resize((text.size() + kAlignment - 1) / kAlignment * kAlignment, ' ');
    const std::array<std::uint32_t, 2> lengths = {id_, static_cast<std::uint32_t>(text.size())};
    std::vector<std::span<const std::byte>> all = {std::as_bytes(std::span(lengths)),
                                                   std::as_bytes(std::span(text))};
    all.insert(all.end(), parts_.begin(), parts_.end());
    return Message::binary(all);
  }

 private:
  std::uint32_t id_;
  std::uint64_t bytes_ = 0;
  std::vector<std::span<const std::byte>> parts_;
};

// What a request gets of a stream that is not open.
void add_missing(Json& json, const Streams::Found& found) {
  json["status"] = found.error.empty() ? "opening" : "unavailable";
  if (!found.error.empty()) json["error"] = found.error;
}

Result<Message> type_answer(Streams& streams, std::uint32_t id, const Json& request) {
  const Streams::Found found = streams.find(text_of(request, "stream"));
  Json json = {{"id", id}, {"stream", text_of(request, "stream")}};
  if (found.stream) {
    // Nothing else may read it now, and a reader notices only then that its stream began anew.
    if (auto* const live = std::get_if<RawReader>(&found.stream->reader)) {
      BorrowedSample newest;
      const ReadStatus status = live->borrow(live->newest_tid(), newest);
      if (status == ReadStatus::restarted) found.stream->follow_restart();
      json["incarnation"] = live->incarnation();
    }
    const TypeInfo& type = found.stream->type();
    TypeInfo readable = type;
    readable.fields = found.stream->fields;
    json["status"] = "ok";
    json["name"] = type.name;
    json["payload_bytes"] = type.payload_bytes;
    json["fields"] = ctl::fields_json(readable);
  } else {
    add_missing(json, found);
  }
  return Message::text(ctl::json_text(json));
}

Result<Message> signals_answer(Streams& streams, std::uint32_t id, const Json& request) {
  const std::vector<std::string> names = DSSM_TRY(texts_of(request, "fields", kMaxAskedFields));
  const std::optional<Time> wanted_from = DSSM_TRY(time_of(request, "from_ns"));
  const std::optional<Time> wanted_to = DSSM_TRY(time_of(request, "to_ns"));
  const std::optional<Time> span = DSSM_TRY(time_of(request, "span_ns"));
  if (!wanted_to != !wanted_from || !wanted_to == !span) {
    return bad_request("either 'from_ns' and 'to_ns' are needed, or 'span_ns'");
  }
  if (span ? *span <= Time() : *wanted_from >= *wanted_to) {
    return bad_request("'from_ns' is to be before 'to_ns', and 'span_ns' greater than 0");
  }
  const auto points = request.find("points");
  if (points == request.end() || !points->is_number_unsigned() ||
      points->get<std::uint64_t>() < 2 || points->get<std::uint64_t>() > kMaxPoints) {
    return bad_request(fmt::format("'points' is to be a number from 2 to {}", kMaxPoints));
  }
  if (names.size() * points->get<std::uint64_t>() > kMaxAllPoints) {
    return bad_request(
        fmt::format("'points' times the number of 'fields' is to be at most {}", kMaxAllPoints));
  }
  DataAnswer answer(id);
  Json head = Json::object();
  const Streams::Found found = streams.find(text_of(request, "stream"));
  if (!found.stream) {
    add_missing(head, found);
    return answer.message(head);
  }
  OpenStream& stream = *found.stream;
  std::vector<ctl::FieldElement> fields;
  for (const std::string& name : names) {
    const auto field = ctl::find_field(stream.fields, name);
    if (!field) return bad_request(fmt::format("the stream has no field '{}'", name));
    fields.push_back(*field);
  }
  Time to = wanted_to.value_or(Time()), from = wanted_from.value_or(Time());
  if (span) {
    const auto find_newest = [&](const auto& reader) {
      SampleInfo newest;
      if (reader.read_info(reader.newest_tid(), newest) == ReadStatus::ok) to = newest.time;
    };
    std::visit(find_newest, stream.reader);
    from = ctl::saturating_add(to, -span->time_since_epoch());
  }
  head["from_ns"] = time_json(from);
  head["to_ns"] = time_json(to);
  const auto read = [&](auto& reader) {
    return read_signals(reader, fields, from, to, points->get<std::size_t>());
  };
  SignalRange range = std::visit(read, stream.reader);
  if (range.status == ReadStatus::restarted) {
    stream.follow_restart();
    range = {};
    range.status = ReadStatus::restarted;
  }
  head["status"] = name_of(range.status);
  head["samples"] = range.samples;
  head["lost"] = range.lost;
  head["left_out"] = range.left_out;
  head["clock_error_s"] = range.clock_error >= kForeignClockError
                              ? Json()
                              : Json(std::chrono::duration<double>(range.clock_error).count());
  head["curves"] = Json::array();
  for (std::size_t i = 0; i < range.curves.size(); ++i) {
    const Curve& curve = range.curves[i];
    head["curves"].push_back({{"field", names[i]},
                              {"points", curve.values.size()},
                              {"times_at", answer.add(bytes_of(curve.times_s))},
                              {"values_at", answer.add(bytes_of(curve.values))},
                              {"tids_at", answer.add(bytes_of(curve.tids))}});
  }
  return answer.message(head);
}

// A stream's part in an answer to "at".
struct Part {
  std::string name;
  OpenStream* stream = nullptr;
  std::string missing_error;  // why it is not open; empty: it is being opened
  std::vector<std::byte> payload;
  ReadStatus status = ReadStatus::not_yet;
  SampleInfo info;
};

template <class Reader, class Sample>
JointRead read_joint(const std::vector<Part*>& parts, Time t) {
  std::vector<Sample> samples;
  samples.reserve(parts.size());
  for (Part* part : parts) {
    Reader& reader = std::get<Reader>(part->stream->reader);
    part->payload.resize(reader.payload_bytes());
    samples.push_back({&reader, part->payload, {}});
  }
  const JointRead read = read_joint_at(t, samples);
  for (std::size_t i = 0; i < parts.size(); ++i) parts[i]->info = samples[i].info;
  return read;
}

// Reads all of `parts` at `t` together. One that has no sample then is left out, with its status,
// and the others are read again.
void read_together(std::vector<Part*> parts, Time t) {
  while (!parts.empty()) {
    const bool is_live = std::holds_alternative<RawReader>(parts.front()->stream->reader);
    const JointRead read = is_live ? read_joint<RawReader, JointSample>(parts, t)
                                   : read_joint<RecordedRawReader, RecordedJointSample>(parts, t);
    if (read.status == ReadStatus::ok) {
      for (Part* part : parts) part->status = read.status;
      return;
    }
    if (read.status == ReadStatus::restarted && !is_live) continue;
    Part* const failed = parts[read.index];
    failed->status = read.status;
    if (read.status == ReadStatus::restarted) failed->stream->follow_restart();
    parts.erase(parts.begin() + static_cast<std::ptrdiff_t>(read.index));
  }
}

void read_newest(Part& part) {
  const auto read = [&](auto& reader) {
    part.payload.resize(reader.payload_bytes());
    return reader.read_newest(part.payload, part.info);
  };
  if (auto* const recorded = std::get_if<RecordedRawReader>(&part.stream->reader)) {
    part.status = past_restarts([&] { return read(*recorded); });
    return;
  }
  part.status = read(std::get<RawReader>(part.stream->reader));
  if (part.status == ReadStatus::restarted) part.stream->follow_restart();
}

Result<Message> at_answer(Streams& streams, std::uint32_t id, const Json& request) {
  const std::vector<std::string> names = DSSM_TRY(texts_of(request, "streams", kMaxStreams));
  const std::optional<Time> t = DSSM_TRY(time_of(request, "t_ns"));
  const auto payloads = request.find("payloads");
  const bool has_payloads = payloads == request.end() || *payloads != false;
  std::vector<Part> parts;
  std::uint64_t longest_bytes = 0;
  for (const std::string& name : names) {
    const Streams::Found found = streams.find(name);
    parts.push_back({name, found.stream, found.error, {}, ReadStatus::not_yet, {}});
    if (found.stream) longest_bytes += found.stream->type().payload_bytes;
  }
  if (longest_bytes > kMaxReadBytes) {
    return bad_request(
        fmt::format("samples of these streams may have {} bytes together; at most {} are "
                    "read at once",
                    longest_bytes, kMaxReadBytes));
  }
  std::vector<Part*> open;
  for (Part& part : parts) {
    if (!part.stream) continue;
    open.push_back(&part);
    if (!t) read_newest(part);
  }
  if (t) read_together(open, *t);
  std::uint64_t bytes = 0;
  for (const Part* part : open) {
    bytes += part->status == ReadStatus::ok ? part->info.payload_bytes : 0;
  }
  if (has_payloads && bytes > kMaxAnswerBytes) {
    return bad_request(
        fmt::format("samples of these streams have {} bytes together; at most {} are sent at once",
                    bytes, kMaxAnswerBytes));
  }

  DataAnswer answer(id);
  Json head = {{"t_ns", t ? time_json(*t) : Json()}, {"samples", Json::array()}};
  for (const Part& part : parts) {
    Json json = {{"stream", part.name}};
    if (!part.stream) {
      add_missing(json, {nullptr, part.missing_error});
    } else {
      json["status"] = name_of(part.status);
    }
    if (part.stream && part.status == ReadStatus::ok) {
      const Duration error = std::visit(
          [&](const auto& reader) { return reader.clock_error(part.info); }, part.stream->reader);
      json["tid"] = part.info.tid;
      json["time_ns"] = time_json(part.info.time);
      json["clock_error_ns"] =
          error >= kForeignClockError ? Json() : Json(std::to_string(to_ns(error)));
      if (has_payloads)
        json["payload_at"] = answer.add(std::span(part.payload).first(part.info.payload_bytes));
      json["payload_bytes"] = part.info.payload_bytes;
    }
    head["samples"].push_back(std::move(json));
  }
  return answer.message(head);
}

Result<WantedRange> wanted_range(const Json& request) {
  WantedRange range;
  if (request.contains("streams")) {
    range.streams = DSSM_TRY(texts_of(request, "streams", kMaxSavedStreams));
    if (range.streams.empty()) return bad_request("'streams' is to name some, or to be left out");
  }
  const std::optional<Time> from = DSSM_TRY(time_of(request, "from_ns"));
  const std::optional<Time> to = DSSM_TRY(time_of(request, "to_ns"));
  if (!from || (to && *from >= *to)) {
    return bad_request("'from_ns' is needed, and is to be before 'to_ns'");
  }
  range.first = *from;
  range.last = to.value_or(Time::max());
  return range;
}

Message saved_answer(std::uint32_t id, const SavedRange& saved) {
  return Message::text(ctl::json_text({{"id", id},
                                       {"path", saved.path},
                                       {"streams", saved.streams},
                                       {"samples", saved.progress.samples},
                                       {"lost_samples", saved.progress.lost_samples},
                                       {"file_bytes", saved.progress.file_bytes},
                                       {"notices", saved.notices}}));
}

Message property_answer(std::uint32_t id, const std::vector<std::byte>& property) {
  DataAnswer answer(id);
  const std::uint64_t at = answer.add(property);
  return answer.message({{"property_bytes", property.size()}, {"property_at", at}});
}

}  // namespace

// --- a page

class PageConnection : public Connection {
 public:
  PageConnection(Pages& pages, Peer& peer)
      : pages_(pages), peer_(peer), number_(++pages.last_connection_) {
    pages_.connections_[number_] = this;
  }
  PageConnection(const PageConnection&) = delete;
  PageConnection& operator=(const PageConnection&) = delete;
  ~PageConnection() override { pages_.connections_.erase(number_); }

  void on_text(std::string_view text) override {
    const Json request = Json::parse(text, nullptr, false);
    const auto id = request.is_object() ? request.find("id") : request.end();
    if (!request.is_object() || id == request.end() || !id->is_number_unsigned() ||
        id->get<std::uint64_t>() > std::numeric_limits<std::uint32_t>::max()) {
      return peer_.close("a request is to be a JSON object with a number 'id'");
    }
    if (peer_.waiting() + waiting_for_state_.size() + answers_under_way_ >= kMaxUnanswered) {
      return peer_.close("too many requests at once");
    }
    if (peer_.waiting_bytes() > kMaxAnswerBytes) {
      return peer_.close("answers are to be read before more is asked");
    }
    const auto number = id->get<std::uint32_t>();
    const std::string op = text_of(request, "op");
    if (op == "overview") {
      waiting_for_state_.push_back(number);
      pages_.want_all_();
      return send_state();
    }
    if (op == "save" || op == "property") {
      const Result<void> asked =
          op == "save" ? ask_to_save(number, request) : ask_property(number, request);
      if (!asked) send(number, asked.error());
      return;
    }
    const Result<Message> answer =
        op == "type"      ? type_answer(pages_.streams_, number, request)
        : op == "signals" ? signals_answer(pages_.streams_, number, request)
        : op == "at"      ? at_answer(pages_.streams_, number, request)
                          : bad_request(fmt::format("there is no operation '{}'", op));
    send(number, answer);
  }

  // Answers requests for a state that this page has not had.
  void send_state() {
    if (waiting_for_state_.empty() || pages_.state_.empty() ||
        state_number_ == pages_.state_number_) {
      return;
    }
    state_number_ = pages_.state_number_;
    for (const std::uint32_t id : std::exchange(waiting_for_state_, {})) {
      peer_.send(Message::text(fmt::format("{{\"id\":{},{}", id, pages_.state_.substr(1))));
    }
  }

 private:
  void send(std::uint32_t id, const Result<Message>& answer) {
    peer_.send(
        answer ? *answer
               : Message::text(ctl::json_text({{"id", id}, {"error", answer.error().message}})));
  }

  // To be called with the answer, later. The page may be closed by then.
  std::function<void(const Result<Message>&)> answer_later(std::uint32_t id) {
    ++answers_under_way_;
    return [&pages = pages_, page = number_, id](const Result<Message>& answer) {
      const auto found = pages.connections_.find(page);
      if (found == pages.connections_.end()) return;
      --found->second->answers_under_way_;
      found->second->send(id, answer);
    };
  }

  Result<void> ask_to_save(std::uint32_t id, const Json& request) {
    WantedRange range = DSSM_TRY(wanted_range(request));
    if (!pages_.saver_) return bad_request("a recording is shown, which is saved already");
    pages_.saver_->save(std::move(range),
                        [answer = answer_later(id), id](const Result<SavedRange>& saved) {
                          answer(saved ? Result<Message>(saved_answer(id, *saved)) : saved.error());
                        });
    return {};
  }

  Result<void> ask_property(std::uint32_t id, const Json& request) {
    const std::optional<Time> t = DSSM_TRY(time_of(request, "t_ns"));
    pages_.streams_.ask_property(
        text_of(request, "stream"), t,
        [answer = answer_later(id), id](const Result<std::vector<std::byte>>& property) {
          answer(property ? Result<Message>(property_answer(id, *property)) : property.error());
        });
    return {};
  }

  Pages& pages_;
  Peer& peer_;
  const std::uint64_t number_;
  std::size_t answers_under_way_ = 0;
  std::vector<std::uint32_t> waiting_for_state_;
  std::uint64_t state_number_ = 0;  // that it has
};

std::unique_ptr<Connection> Pages::connect(Peer& peer) {
  return std::make_unique<PageConnection>(*this, peer);
}

void Pages::on_state(const VehicleState& state) {
  // One without programs and findings is not for pages: their next request asks for all.
  state_ = state.has_all ? ctl::json_text(state.json) : "";
  ++state_number_;
  for (const auto& [number, connection] : connections_) connection->send_state();
}

}  // namespace dssm::view
