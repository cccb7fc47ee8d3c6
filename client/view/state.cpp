// SPDX-License-Identifier: Apache-2.0
#include "client/view/state.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/doctor.hpp"
#include "client/dssmctl/nodes.hpp"
#include "client/dssmctl/text.hpp"
#include "client/view/streams.hpp"
#include "core/base/try.hpp"

namespace dssm::view {
namespace {

using ctl::Json;

// The time of the oldest sample that the stream's ring holds, about: by its rate.
std::optional<Time> guessed_oldest(const StreamInfo& stream) {
  if (stream.newest == kNoTid) return std::nullopt;
  const double cycle_s =
      stream.rate_hz > 0 ? 1 / stream.rate_hz : std::chrono::duration<double>(stream.cycle).count();
  // Another host may report any numbers.
  const double samples = static_cast<double>(stream.newest) - static_cast<double>(stream.oldest);
  constexpr double kMaxSeconds = 1e9;
  const double length_s = std::clamp(samples * cycle_s, 0.0, kMaxSeconds);
  return ctl::saturating_add(stream.newest_time,
                             -Duration(static_cast<std::int64_t>(length_s * 1e9)));
}

void extend(std::optional<TimeRange>& range, Time first, Time last) {
  if (!range) range = {first, last};
  range->first = std::min(range->first, first);
  range->last = std::max(range->last, last);
}

Json range_json(const std::optional<TimeRange>& range) {
  if (!range) return {};
  return {{"oldest_ns", time_json(range->first)}, {"newest_ns", time_json(range->last)}};
}

// Whether times are of this day: those of a device's own clock, or of a recording, are not.
bool is_about_now(Time time) {
  constexpr Duration kDay = std::chrono::hours(24);
  return ctl::saturating_sub(time, WallClock::now()) < kDay &&
         ctl::saturating_sub(WallClock::now(), time) < kDay;
}

Json streams_json(const std::vector<StreamInfo>& streams) {
  Json list = Json::array();
  for (const StreamInfo& stream : streams) {
    Json json = ctl::stream_json(stream);
    json["mirror"] = stream.mirror ? ctl::mirror_json(stream) : Json();
    list.push_back(std::move(json));
  }
  return list;
}

// The stream of `incarnations`, which are at least one, as the page lists it.
Json recorded_stream_json(const std::vector<const RecordedStreamInfo*>& incarnations,
                          const StreamInfo& stream) {
  std::uint64_t samples = 0, lost_samples = 0;
  std::optional<TimeRange> range;
  for (const RecordedStreamInfo* one : incarnations) {
    samples += one->samples;
    lost_samples += one->lost_samples;
    if (one->samples > 0) extend(range, one->first_time, one->last_time);
  }
  Json json = ctl::stream_json(stream);
  json["state"] = "recorded";
  for (const char* unknown : {"age_ns", "writers", "readers", "remote_writers", "remote_readers"}) {
    json[unknown] = nullptr;
  }
  const double length_s =
      range ? std::chrono::duration<double>(ctl::saturating_sub(range->last, range->first)).count()
            : 0;
  json["rate_hz"] = length_s > 0 ? Json(static_cast<double>(samples - 1) / length_s) : Json();
  json["samples"] = samples;
  json["lost_samples"] = lost_samples;
  json["oldest_ns"] = range ? time_json(range->first) : Json();
  json["newest_ns"] = range ? time_json(range->last) : Json();
  json["mirror"] = nullptr;
  return json;
}

}  // namespace

VehicleState recorded_state(const Recording& recording) {
  VehicleState state;
  state.has_all = true;
  std::map<std::string, std::vector<const RecordedStreamInfo*>> streams;  // by their full names
  for (const RecordedStreamInfo& stream : recording.streams()) {
    streams[stream.id.str()].push_back(&stream);
    if (stream.samples > 0) extend(state.range, stream.first_time, stream.last_time);
  }
  Json& json = state.json;
  json["streams"] = Json::array();
  for (const auto& [name, incarnations] : streams) {
    const RecordedStreamInfo& newest = *incarnations.back();
    StreamInfo stream;
    stream.id = newest.id;
    stream.type = newest.type;
    stream.incarnation = newest.incarnation;
    stream.depth = newest.depth;
    stream.cycle = newest.cycle;
    stream.oldest = newest.first_tid;
    stream.newest = newest.last_tid;
    stream.newest_time = newest.last_time;
    json["streams"].push_back(recorded_stream_json(incarnations, stream));
    state.streams.push_back(std::move(stream));
  }
  json["range"] = range_json(state.range);
  json["recording"] = Json::array();
  for (const std::filesystem::path& file : recording.files()) {
    json["recording"].push_back(ctl::escaped(file.filename().string()));
  }
  state.host = json["recording"].empty() ? "" : json["recording"][0].get<std::string>();
  json["host"] = state.host;
  json["version"] = DSSM_VERSION;
  json["hosts"] = json["nodes"] = json["events"] = Json::array();
  for (const RecordedTrigger& trigger : recording.triggers()) {
    json["events"].push_back(
        {{"number", json["events"].size() + 1},
         {"time_ns", time_json(trigger.time)},
         {"severity", "warn"},
         {"text", fmt::format("{} on {}{}{}", trigger.name, trigger.host,
                              trigger.reason.empty() ? "" : ": ", trigger.reason)}});
  }
  json["error"] = "";
  show_warnings(recording, state);
  return state;
}

void show_oldest(VehicleState& state) {
  state.range.reset();
  std::optional<TimeRange> of_others;
  for (std::size_t i = 0; i < state.streams.size(); ++i) {
    const StreamInfo& stream = state.streams[i];
    const std::optional<Time> oldest = state.oldest[i];
    Json& json = state.json["streams"][i];
    json["oldest_ns"] = oldest ? time_json(*oldest) : Json();
    json["newest_ns"] = oldest ? time_json(stream.newest_time) : Json();
    // Samples of a black box may be hours older than all others.
    if (!oldest || ctl::is_of_black_box(stream.id)) continue;
    extend(is_about_now(stream.newest_time) ? state.range : of_others, *oldest, stream.newest_time);
  }
  if (!state.range) state.range = of_others;
  state.json["range"] = range_json(state.range);
}

void show_warnings(const Recording& recording, VehicleState& state) {
  std::vector<ctl::Finding> findings;
  for (const std::string& warning : recording.warnings()) {
    findings.push_back({"recording", ctl::Finding::Status::warn, warning});
  }
  state.json["findings"] = ctl::findings_json(findings);
}

void StateCollector::start(std::function<void(const VehicleState&)> on_state) {
  on_state_ = std::move(on_state);
  thread_ = std::thread([this] { run(); });
}

StateCollector::~StateCollector() {
  {
    const std::lock_guard lock(mutex_);
    is_ending_ = true;
  }
  changed_.notify_one();
  if (thread_.joinable()) thread_.join();
}

void StateCollector::want_all() {
  {
    const std::lock_guard lock(mutex_);
    const MonoTime now = MonoClock::now();
    if (now < wanted_until_ - kWantedTime + kPeriod) return;
    is_wanted_now_ = now >= wanted_until_;
    wanted_until_ = now + kWantedTime;
  }
  changed_.notify_one();
}

void StateCollector::run() {
  std::unique_lock lock(mutex_);
  while (!is_ending_) {
    const bool all = MonoClock::now() < wanted_until_;
    is_wanted_now_ = false;
    lock.unlock();
    const MonoTime next = deadline_in(kPeriod);
    const Result<void> collected = collect(all);
    state_.has_all = all;
    if (bool(collected) != is_connected_) {
      is_connected_ = bool(collected);
      events_.add(!is_connected_,
                  is_connected_ ? "dssmd answers again" : collected.error().message);
    }
    state_.json["now_ns"] = time_json(WallClock::now());
    state_.json["error"] = collected ? "" : collected.error().message;
    state_.json["events"] = events_.all();
    on_state_(state_);
    lock.lock();
    changed_.wait_until(lock, next, [&] { return is_ending_ || is_wanted_now_; });
  }
}

Result<void> StateCollector::collect(bool all) {
  const DaemonInfo daemon = DSSM_TRY(session_.daemon_info());
  const std::vector<HostInfo> hosts = DSSM_TRY(session_.list_hosts());
  state_.host = daemon.host;
  state_.streams = DSSM_TRY(session_.list_streams());
  events_.find(hosts, state_.streams);
  find_incidents();
  Json& json = state_.json;
  json["host"] = daemon.host;
  json["version"] = daemon.version;
  json["streams"] = streams_json(state_.streams);
  find_oldest(all);
  json["hosts"] = Json::array();
  for (const HostInfo& host : hosts) {
    // Another address of a host that is there already.
    if (host.reason != HostReason::spare_address) json["hosts"].push_back(ctl::host_json(host));
  }
  if (!all) return {};
  state_.nodes = DSSM_TRY(session_.list_nodes());
  json["nodes"] = Json::array();
  for (const NodeInfo& node : state_.nodes) json["nodes"].push_back(ctl::node_json(node));
  if (MonoClock::now() < next_findings_) return {};
  next_findings_ = deadline_in(kFindingsPeriod);
  json["clock_limit_ns"] = Json();
  if (const auto pairs = session_.list_clock_pairs(); pairs) {
    for (const ClockPair& pair : *pairs) {
      if (pair.reader == daemon.host && pair.limit > Duration()) {
        json["clock_limit_ns"] = to_ns(pair.limit);
      }
    }
  }
  ctl::CommonOptions options;
  options.socket_path = socket_path_;
  options.verb_name = "doctor";
  json["findings"] = ctl::findings_json(ctl::findings_of(ctl::collect_facts(options)));
  return {};
}

// One that could not be read, perhaps because this user may not, is not tried each second.
bool StateCollector::is_due(const Probe& probe, const StreamInfo& stream) {
  if (!probe.time) return MonoClock::now() - probe.at > kRefusedPause;
  return probe.oldest != stream.oldest;
}

void StateCollector::find_oldest(bool all) {
  state_.oldest.clear();
  std::vector<std::pair<MonoTime, std::size_t>> due;  // by the times of their last probes
  std::map<std::string, Probe> known;
  for (std::size_t i = 0; i < state_.streams.size(); ++i) {
    const StreamInfo& stream = state_.streams[i];
    state_.oldest.push_back(guessed_oldest(stream));
    if (stream.newest == kNoTid || stream.id.host != state_.host) continue;
    const auto probed = probes_.find(stream.id.str());
    const bool is_known =
        probed != probes_.end() && probed->second.incarnation == stream.incarnation;
    if (!is_known || is_due(probed->second, stream)) {
      due.emplace_back(is_known ? probed->second.at : MonoTime(), i);
    }
    if (is_known) known.insert(*probed);
  }
  probes_ = std::move(known);
  std::ranges::sort(due);
  if (due.size() > kMaxProbes) due.resize(kMaxProbes);
  for (const auto& [at, i] : due) {
    if (all) probe(state_.streams[i]);
  }
  for (std::size_t i = 0; i < state_.streams.size(); ++i) {
    const StreamInfo& stream = state_.streams[i];
    const auto probed = probes_.find(stream.id.str());
    if (probed == probes_.end() || !probed->second.time) continue;
    // A ring that was not probed now has lost about as much as has come since.
    const bool is_moving = probed->second.oldest < stream.oldest;
    const Duration since = is_moving ? MonoClock::now() - probed->second.at : Duration();
    state_.set_oldest(i, ctl::saturating_add(*probed->second.time, since));
  }
}

// Its reader is closed at once: the programs of a vehicle are not to see one more of each stream.
void StateCollector::probe(const StreamInfo& stream) {
  Probe& probe = probes_[stream.id.str()];
  probe = {stream.incarnation, stream.oldest, MonoClock::now(), std::nullopt};
  const Result<RawReader> reader = session_.open_raw_reader(stream.id);
  if (reader && reader->incarnation() == stream.incarnation) probe.time = oldest_time(*reader);
}

void StateCollector::find_incidents() {
  std::erase_if(incidents_, [&](const auto& named) {
    return named.second.restart_error() ||
           std::ranges::none_of(state_.streams, [&](const StreamInfo& stream) {
             return stream.id.str() == named.first;
           });
  });
  for (const StreamInfo& stream : state_.streams) {
    if (stream.id.name == ctl::kIncidentStream) find_incidents(stream);
  }
}

// Only those since dssm-view was started.
void StateCollector::find_incidents(const StreamInfo& stream) {
  const std::string name = stream.id.str();
  auto reader = incidents_.find(name);
  if (reader == incidents_.end()) {
    Result<Reader<ctl::RecordedIncident>> opened =
        session_.open_reader<ctl::RecordedIncident>(name);
    if (!opened) return;
    opened->seek(kNoTid);
    reader = incidents_.emplace(name, *std::move(opened)).first;
  }
  for (int i = 0; i < kMaxIncidents; ++i) {
    const auto incident = reader->second.read_next();
    if (incident.status() == ReadStatus::restarted) continue;
    if (!incident) return;
    if (incident->time() < started_) continue;
    const ctl::RecordedIncident& found = incident->value;
    const std::string reason = ctl::text_in(found.reason);
    events_.add(true, fmt::format("incident recorded on {}: {} of {}{}; {}", stream.id.host,
                                  ctl::text_in(found.trigger), ctl::text_in(found.host),
                                  reason.empty() ? "" : ": " + reason, ctl::text_in(found.file)));
  }
}

}  // namespace dssm::view
