// SPDX-License-Identifier: Apache-2.0
//
// dssmctl play: a recording into streams, at the pace of the PC's playback clock. Programs that use
// that clock live in the time of the recording; keys, and `dssmctl playback` of another terminal,
// change its speed and direction, pause it, and let it jump, and the player follows it. With --now
// the stamps are those of now, and the clock is left alone. With --lockstep the clock stands at the
// time of each sample until the programs have done with it.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <dssm/recording.hpp>
#include <functional>
#include <map>
#include <optional>
#include <string_view>
#include <utility>

#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/keyboard.hpp"
#include "client/dssmctl/lockstep.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/timeline.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

void print_notice(const std::string& text) {
  print_error(fmt::format("dssmctl: play: {}\n", text));
}

// The part of the recording that is played.
struct PlayedPart {
  Time from = Time::max(), to = Time::min();
};

Result<PlayedPart> played_part(const Recording& recording, const PlayOptions& options) {
  PlayedPart whole;
  for (const RecordedStreamInfo& stream : recording.streams()) {
    if (stream.samples == 0) continue;
    whole.from = std::min(whole.from, stream.first_time);
    whole.to = std::max(whole.to, stream.last_time);
  }
  if (whole.from > whole.to) {
    return Error{Errc::not_found, fmt::format("'{}' has no samples", escaped(options.file))};
  }
  const auto refused = [&](std::string_view problem) {
    return Error{Errc::invalid_argument,
                 fmt::format("{}; '{}' goes from {} to {} ({}). As offsets: +2s is 2 s after its "
                             "beginning, -3s is 3 s before its end",
                             problem, escaped(options.file), time_text(whole.from, options.iso),
                             time_text(whole.to, options.iso),
                             duration_text(saturating_sub(whole.to, whole.from)))};
  };
  // The last 10 s of a recording of 5 s are all of it. But a time outside of the recording is an
  // error: the clocks would be set to it, and nothing played.
  const auto moment = [&](const std::optional<Moment>& wanted, Time otherwise) {
    if (!wanted) return otherwise;
    if (wanted->back) return saturating_add(whole.to, *wanted->back);
    return wanted->after_start ? saturating_add(whole.from, *wanted->after_start) : wanted->time;
  };
  const auto is_outside = [&](const std::optional<Moment>& wanted) {
    return wanted && !wanted->back && !wanted->after_start &&
           (wanted->time < whole.from || wanted->time > whole.to);
  };
  if (is_outside(options.from)) return refused("--from: that is outside of the recording");
  if (is_outside(options.to)) return refused("--to: that is outside of the recording");
  const PlayedPart range{std::max(moment(options.from, whole.from), whole.from),
                         std::min(moment(options.to, whole.to), whole.to)};
  if (range.from > range.to) return refused("--from and --to: there is nothing between them");
  return range;
}

// The samples of the recording that are played, in both directions.
class Course {
 public:
  // wanted(): whether the stream with that index is played
  Course(const Recording& recording, PlayedPart range, std::function<bool(std::size_t)> wanted)
      : cursor_(recording.cursor()), range_(range), wanted_(std::move(wanted)) {}

  // The next one in that direction; it stays the next one until taken(). nullptr: there is none.
  const RecordedSample* peek(bool backwards) {
    if (has_sample_ && backwards_ == backwards) return &sample_;
    drop();
    backwards_ = backwards;
    do {
      if (!(backwards ? cursor_.previous(sample_) : cursor_.next(sample_))) return nullptr;
    } while (!wanted_(sample_.stream) || sample_.info.time < range_.from ||
             sample_.info.time > range_.to);
    has_sample_ = true;
    return &sample_;
  }
  void taken() { has_sample_ = false; }

  // Between the samples before `time` and the others.
  void seek(Time time) {
    cursor_.seek(time);
    has_sample_ = false;
  }

 private:
  // The cursor goes back to where it was before what peek() returned.
  void drop() {
    if (!std::exchange(has_sample_, false)) return;
    RecordedSample same;
    (void)(backwards_ ? cursor_.next(same) : cursor_.previous(same));
  }

  RecordingCursor cursor_;
  PlayedPart range_;
  std::function<bool(std::size_t)> wanted_;
  RecordedSample sample_;
  bool has_sample_ = false, backwards_ = false;
};

constexpr std::string_view kKeys =
    "Space: pause   Right, Left: next, previous sample   Up, Down: faster, slower   R: backwards\n"
    "PgUp, PgDn: 10 s back, on   Home: begin again   Q: end\n";

// Where the streams of the recording go.
class Player {
 public:
  Player(const PlayOptions& options, Session session, const Recording& recording, PlayedPart range,
         Output& out)
      : options_(options),
        session_(std::move(session)),
        recording_(recording),
        range_(range),
        out_(out),
        course_(recording, range,
                [this](std::size_t stream) { return target_of_[stream].has_value(); }) {}

  // Creates the streams, once all of them have been checked.
  Result<void> prepare() {
    if (!keyboard_.is_there() && options_.now && options_.start_paused) {
      return Error{Errc::invalid_argument,
                   "--start-paused --now: there is no terminal whose keys could let it run, and "
                   "--now has no playback clock"};
    }
    const DaemonInfo daemon = DSSM_TRY(session_.daemon_info());
    own_host_ = daemon.host;
    std::map<std::string, std::size_t> by_name;  // index in targets_
    const std::vector<RecordedStreamInfo>& streams = recording_.streams();
    target_of_.resize(streams.size());
    for (std::size_t i = 0; i < streams.size(); ++i) {
      const RecordedStreamInfo& stream = streams[i];
      if (!is_wanted(stream.id)) continue;
      StreamId id = DSSM_TRY(target_of(stream.id));
      const auto [entry, is_new] = by_name.emplace(id.str(), targets_.size());
      if (is_new) targets_.push_back({.id = std::move(id), .source = stream.id});
      const Target& target = targets_[entry->second];
      if (target.source != stream.id) {
        return Error{Errc::invalid_argument,
                     fmt::format("'{}' and '{}' are both to be played as '{}'; --map {}=OTHER "
                                 "renames one",
                                 escaped(target.source.str()), escaped(stream.id.str()),
                                 escaped(short_name(target.id)), escaped(stream.id.str()))};
      }
      target_of_[i] = entry->second;
      if (!stream.property_times.empty() && stream.property_times.back() != Time::min()) {
        changing_.push_back(i);
      }
    }
    if (targets_.empty()) return nothing_fits();
    DSSM_TRY(check_mappings());
    for (const Target& target : targets_) DSSM_TRY(check_writers(target.id));
    if (!options_.lockstep.empty()) {
      // All is the same each time, also what the rings hold at first.
      for (const Target& target : targets_) {
        if (session_.stream_info(target.id)) DSSM_TRY(session_.remove(target.id));
      }
    }
    return set_properties(options_.rate < 0 ? range_.to : range_.from);
  }

  // After a failure: of the streams that prepare() created none is left that nothing was written
  // to. A program that creates one with another type would be refused.
  void remove_empty_streams() {
    for (Target& target : targets_) {
      if (!target.is_created || target.has_samples) continue;
      const Result<StreamInfo> info = session_.stream_info(target.id);
      if (!info || info->newest != kNoTid || has_other_writers(target, *info)) continue;
      target.writer.reset();
      if (const Result<void> removed = session_.remove(target.id); !removed) {
        print_notice(
            fmt::format("an empty stream is left: {}", escaped_message(removed.error().message)));
      }
    }
  }

  // Says which other streams of this PC programs may find with samples of before.
  Result<void> check_leftovers() {
    for (const StreamInfo& stream : DSSM_TRY(session_.list_own_streams())) {
      const bool is_played = std::ranges::any_of(targets_, [&](const Target& target) {
        return target.id.name == stream.id.name && target.id.id == stream.id.id;
      });
      if (is_played || stream.writers > 0 || stream.newest == kNoTid) continue;
      const std::string name = escaped(short_name(stream.id));
      print_notice(
          fmt::format("'{0}' has samples of an earlier run, which a program may read; `dssmctl rm "
                      "{0}` removes it",
                      name));
    }
    return {};
  }

  // As the timeline runs, until its end or Ctrl-C. Keys and other programs may change it.
  Result<void> play_by(Timeline& timeline) {
    if (keyboard_.is_there()) {
      out_.add(kKeys);
      shows_now_ = true;
    }
    DSSM_TRY(begin(timeline, options_.rate, options_.start_paused));
    while (!out_.must_stop()) {
      show(timeline);
      const bool is_paused = timeline.is_paused(), backwards = timeline.speed() < 0;
      const Time paused_at = timeline.now();
      if (timeline.has_jumped()) {
        report_time_outside(timeline);
        DSSM_TRY(follow_jump(timeline.now(), timeline));
      } else if (is_paused) {
        DSSM_TRY(play_due(paused_at, backwards, timeline));
      }
      has_run_ = !is_paused;
      const RecordedSample* const next = course_.peek(backwards);
      if (!backwards) {
        const Time now = timeline.now();
        DSSM_TRY(set_late_properties(next ? std::min(now, next->info.time) : now));
      }
      const Time end = backwards ? range_.from : range_.to;
      const Duration rest =
          is_paused ? Duration::max() : timeline.until(next ? next->info.time : end);
      if (rest > Duration::zero()) {
        const Duration sleep = std::min(rest, kStopCheckPeriod);
        if (const auto key = keyboard_.wait(deadline_in(sleep))) {
          if (*key == Key::q) break;
          DSSM_TRY(follow(*key, timeline));
        }
      } else if (next) {
        DSSM_TRY(play(*next, timeline.stamp(next->info.time)));
        course_.taken();
      } else if (played_ == 0) {
        return Error{Errc::not_found, "no sample of these streams is in that part"};
      } else if (options_.loop) {
        DSSM_TRY(begin(timeline, timeline.speed(), timeline.is_paused()));
      } else {
        if (!backwards) DSSM_TRY(set_last_properties());
        break;
      }
    }
    return {};
  }

  // As fast as programs in lockstep can take it.
  Result<void> play_by(Lockstep& lockstep, PlaybackClock& clock) {
    const auto set_clock = [&](Time now) { clock.set_time(seconds_of(now)); };
    clock.set_speed(1);
    clock.set_paused(true);
    set_clock(range_.from);
    course_.seek(range_.from);
    rest_ = range_.to - range_.from;
    bool goes_on = DSSM_TRY(lockstep.await_start());
    while (const RecordedSample* const next = goes_on ? course_.peek(false) : nullptr) {
      const Time time = next->info.time;
      show(time);
      rest_ = range_.to - time;
      goes_on = DSSM_TRY(lockstep.advance(time, set_clock));
      if (!goes_on) break;
      DSSM_TRY(play(*next, time));
      course_.taken();
      goes_on = DSSM_TRY(lockstep.settle());
    }
    if (!goes_on) return {};
    rest_ = {};
    DSSM_TRY(set_last_properties());
    return lockstep.finish();
  }

  void print_summary() {
    out_.clear_line();
    if (options_.json) {
      out_.add(json_document({{"file", options_.file},
                              {"streams", targets_.size()},
                              {"samples", played_},
                              {"rest_ns", to_ns(rest_)}}));
    } else {
      out_.add(fmt::format(
          "{}: {} of {} played{}\n", escaped(options_.file), counted(played_, "sample", "samples"),
          counted(targets_.size(), "stream", "streams"),
          rest_ > Duration::zero() ? fmt::format("; ended {} before its end", duration_text(rest_))
                                   : ""));
    }
  }

 private:
  static constexpr Duration kPropertyWait = std::chrono::seconds(1);

  // What a stream here has: from which stream of the recording, and the index there; without an
  // index none from the recording.
  struct Property {
    std::size_t stream = SIZE_MAX;
    std::optional<std::size_t> index;

    friend bool operator==(const Property&, const Property&) = default;
  };

  // "'climate', 'pose'": of all streams of the recording.
  std::string streams_text() const {
    constexpr std::size_t kMaxNamed = 20;
    std::vector<std::string> names;
    for (const RecordedStreamInfo& stream : recording_.streams()) {
      std::string name = stream.id.str();
      if (std::ranges::find(names, name) == names.end()) names.push_back(std::move(name));
    }
    return list_text(names, kMaxNamed);
  }

  Error nothing_fits() const {
    const std::string there = streams_text();
    if (options_.patterns.empty()) {
      return {Errc::not_found,
              fmt::format("'{}' has only streams of the black box, {}; they are played if a "
                          "PATTERN names them",
                          escaped(options_.file), there)};
    }
    return {Errc::not_found,
            fmt::format("no stream of the recording fits {}; '{}' has {}",
                        list_text(options_.patterns), escaped(options_.file), there)};
  }

  // A stream here, which has the samples of one of the recording, of all its incarnations.
  struct Target {
    StreamId id;      // with a host
    StreamId source;  // its name in the recording
    std::optional<RawWriter> writer = {};
    std::size_t opened_for = SIZE_MAX;  // stream of the recording: the incarnation that it has
    bool is_created = false;            // by this program
    bool has_samples = false;           // of this program
    Property property = {};
  };

  Target& target(std::size_t stream) { return targets_[*target_of_[stream]]; }

  static bool has_other_writers(const Target& target, const StreamInfo& now) {
    return now.writers > (target.writer ? 1U : 0U);
  }

  // Requests to the black box that are in the recording would be requests to the one here.
  bool is_wanted(const StreamId& id) const {
    if (!StreamFilter({}, options_.patterns).takes(id)) return false;
    if (!is_of_black_box(id)) return true;
    const auto names_it = [&](const std::string& pattern) {
      return pattern.starts_with("dssm_") && StreamFilter({}, {pattern}).takes(id);
    };
    return std::ranges::any_of(options_.patterns, names_it) ||
           mapping_of(id) != options_.mappings.end();
  }

  static bool takes(const std::string& mapping, const StreamId& id) {
    return StreamFilter({}, {mapping.substr(0, mapping.find('='))}).takes(id);
  }
  // The --map that decides about that stream: the first one that takes it.
  std::vector<std::string>::const_iterator mapping_of(const StreamId& id) const {
    return std::ranges::find_if(options_.mappings,
                                [&](const std::string& mapping) { return takes(mapping, id); });
  }

  // Its name here, with a host.
  Result<StreamId> target_of(const StreamId& id) const {
    StreamId target = id;
    if (!options_.on_hosts) target.host = own_host_;
    if (const auto mapping = mapping_of(id); mapping != options_.mappings.end()) {
      target = DSSM_TRY(StreamId::parse(mapping->substr(mapping->find('=') + 1)));
      if (target.host.empty()) target.host = own_host_;
    }
    return target;
  }

  // A wrong name in one would have the stream that was meant played as itself.
  Result<void> check_mappings() const {
    for (auto mapping = options_.mappings.begin(); mapping != options_.mappings.end(); ++mapping) {
      if (std::ranges::any_of(targets_, [&](const Target& target) {
            return mapping_of(target.source) == mapping;
          })) {
        continue;
      }
      return Error{Errc::not_found,
                   fmt::format("--map {} applies to no stream that is played; '{}' has {}{}",
                               escaped(*mapping), escaped(options_.file), streams_text(),
                               options_.mappings.size() > 1 ? ", and of several --map that fit a "
                                                              "stream the first one counts"
                                                            : "")};
    }
    return {};
  }

  Result<void> check_writers(const StreamId& id) {
    const Result<StreamInfo> existing = session_.stream_info(id);
    if (!existing || existing->writers == 0 || options_.force) return {};
    return Error{Errc::conflict,
                 fmt::format("'{}' is written by another program; end that, give --map {}=OTHER, "
                             "or --force to write beside it",
                             escaped(existing->id.str()), escaped(short_name(id)))};
  }

  // Has the target of that stream of the recording take its samples. If it came again with another
  // type, the target is created again, as it was.
  Result<void> open(std::size_t from) {
    Target& target = this->target(from);
    if (target.opened_for == from) return {};
    const RecordedStreamInfo& stream = recording_.streams()[from];
    const bool is_open = target.writer && target.writer->type().check_usable_as(stream.type);
    if (!is_open || target.writer->type().is_less_described_than(stream.type)) {
      const Result<StreamInfo> existing = session_.stream_info(target.id);
      if (existing && is_of_other_incarnation(target, existing->type, stream.type)) {
        DSSM_TRY(remove_other_type(target, *existing, stream.type));
      }
      const History history{std::max(stream.depth, kMinDepth), stream.cycle};
      Result<RawWriter> writer =
          session_.create_raw(target.id, stream.type, history, {.keep_existing = true});
      if (!writer && writer.error().code == Errc::type_mismatch) {
        return Error{Errc::type_mismatch,
                     fmt::format("'{0}' is here already, with another type than in the recording "
                                 "({1}, not {2}); `dssmctl rm {0}` removes it, and --map {0}=OTHER "
                                 "plays into another stream",
                                 escaped(short_name(target.id)),
                                 existing ? escaped(existing->type.str()) : "?",
                                 escaped(stream.type.str()))};
      }
      target.writer = DSSM_TRY(std::move(writer));
      target.is_created |= !existing;
    }
    target.opened_for = from;
    return {};
  }

  // Whether the target has the type of another incarnation, from this program or an earlier one.
  bool is_of_other_incarnation(const Target& target, const TypeInfo& type,
                               const TypeInfo& wanted) const {
    if (type.check_usable_as(wanted)) return false;
    return std::ranges::any_of(recording_.streams(), [&](const RecordedStreamInfo& stream) {
      return stream.id == target.source && type.check_usable_as(stream.type);
    });
  }

  Result<void> remove_other_type(Target& target, const StreamInfo& existing,
                                 const TypeInfo& wanted) {
    if (has_other_writers(target, existing)) {
      return Error{Errc::conflict,
                   fmt::format("'{}' has another type in the recording from here on ({}, not {}), "
                               "but another program writes it, too; end that, or give --map "
                               "{}=OTHER",
                               escaped(existing.id.str()), escaped(wanted.str()),
                               escaped(existing.type.str()), escaped(short_name(target.id)))};
    }
    target.writer.reset();
    target.property = {};
    DSSM_TRY(session_.remove(existing.id));
    target.is_created = true;
    target.has_samples = false;
    return {};
  }

  // --- properties

  // Has the stream that is played from stream `from` of the recording get the type and the property
  // that it had at `t`. A property that it has from elsewhere stays until the recording has one.
  Result<void> set_property(std::size_t from, Time t) {
    DSSM_TRY(open(from));
    Target& target = this->target(from);
    Property& set = target.property;
    const Property wanted{from, recording_.streams()[from].property_at(t)};
    const bool is_new = wanted.index && wanted != set;
    if (is_new || (!wanted.index && set.index)) {
      std::vector<std::byte> property;
      if (is_new) property = DSSM_TRY(recording_.property(from, *wanted.index));
      const StreamId& id = target.writer->id();
      const Result<void> done = session_.set_property(id, property);
      // Its samples are played all the same: another host may be lost for a while.
      if (!done) {
        out_.clear_line();
        print_notice(fmt::format("the property of '{}' is not set: {}", escaped(id.str()),
                                 escaped_message(done.error().message)));
      }
    }
    set = wanted;
    return {};
  }

  // All streams get what they had at `t`.
  Result<void> set_properties(Time t) {
    for (const std::size_t i : incarnations_at(t)) DSSM_TRY(set_property(i, t));
    return {};
  }

  // For each target the stream of the recording from which it has its samples at `t`.
  std::vector<std::size_t> incarnations_at(Time t) const {
    std::map<std::size_t, std::size_t> streams;  // by target
    for (std::size_t i = 0; i < target_of_.size(); ++i) {
      if (!target_of_[i]) continue;
      const RecordedStreamInfo& stream = recording_.streams()[i];
      if (stream.samples > 0 && stream.first_time <= t) streams[*target_of_[i]] = i;
      streams.try_emplace(*target_of_[i], i);
    }
    std::vector<std::size_t> all;
    all.reserve(streams.size());
    for (const auto& [target, stream] : streams) all.push_back(stream);
    return all;
  }

  // At the end of what is played: also those that were set after the last sample.
  Result<void> set_last_properties() {
    return set_properties(options_.to ? range_.to : Time::max());
  }

  // A property comes with the first sample that has it. Where no sample of the stream comes for a
  // while, it comes without one; samples that were recorded late are not that late.
  //   now  at most the time of the next sample
  Result<void> set_late_properties(Time now) {
    const Time due = saturating_add(now, -kPropertyWait);
    for (const std::size_t i : changing_) {
      const Property& set = target(i).property;
      if (set.stream != i || recording_.streams()[i].property_at(due) <= set.index) continue;
      DSSM_TRY(set_property(i, due));
    }
    return {};
  }

  // Writes the sample, with the property that its stream had then.
  Result<void> play(const RecordedSample& sample, Time stamp) {
    DSSM_TRY(set_property(sample.stream, sample.info.time));
    return write(sample, stamp);
  }

  Result<void> write(const RecordedSample& sample, Time stamp) {
    Target& target = this->target(sample.stream);
    RawWriter& writer = *target.writer;
    const Tid tid = options_.now ? writer.write(sample.payload, stamp)
                                 : writer.write(sample.payload, stamp, sample.info.clock_error);
    if (tid == kNoTid) {
      return Error{Errc::unavailable,
                   fmt::format("another writer has held the lock of '{}' for 2 s; is a program "
                               "stopped that writes it? `dssmctl info` names them",
                               escaped(writer.id().str()))};
    }
    target.has_samples = true;
    ++played_;
    return {};
  }

  // --- by the timeline

  Result<void> begin(Timeline& timeline, double rate, bool paused) {
    const bool backwards = rate < 0;
    course_.seek(backwards ? saturating_add(range_.to, Duration(1)) : range_.from);
    last_stepped_.reset();
    has_run_ = false;
    const Time start = backwards ? range_.to : range_.from;
    timeline.start(start, rate, paused);
    return set_properties(start);
  }

  // As a player of SSM does when it begins. After the end nothing is left to play, which looks like
  // success.
  void report_time_outside(const Timeline& timeline) const {
    const Time now = timeline.now();
    constexpr Duration kTolerance = std::chrono::milliseconds(1);  // it has run on since
    if (now >= range_.from - kTolerance && now <= range_.to + kTolerance) return;
    out_.clear_line();
    print_notice(
        fmt::format("another program has set the playback clock to {}, where the recording "
                    "has nothing",
                    time_text(now, options_.iso)));
  }

  // The timeline has stopped or turned, at `now`. What is due until then is played, because other
  // programs may read by that time.
  Result<void> play_due(Time now, bool backwards, const Timeline& timeline) {
    if (!std::exchange(has_run_, false)) return {};
    while (const RecordedSample* const next = course_.peek(backwards)) {
      const Time time = next->info.time;
      if ((backwards ? time < now : time > now) || out_.must_stop()) break;
      DSSM_TRY(play(*next, timeline.stamp(time)));
      course_.taken();
    }
    return {};
  }

  // The time was set: programs get what the streams had then, as if all had been played so far.
  Result<void> follow_jump(Time time, const Timeline& timeline) {
    course_.seek(saturating_add(time, Duration(1)));
    last_stepped_.reset();
    has_run_ = false;
    DSSM_TRY(set_properties(time));
    std::vector<std::byte> payload;
    for (const std::size_t i : incarnations_at(time)) {
      const RecordedStreamInfo& stream = recording_.streams()[i];
      if (stream.samples == 0 || stream.first_time > time) continue;
      Result<RecordedRawReader> reader = recording_.open_raw_reader(stream.id);
      if (!reader) {  // its type changes
        DSSM_TRY(write_found(i, time, timeline));
        continue;
      }
      payload.resize(reader->payload_bytes());
      SampleInfo info;
      ReadStatus status = ReadStatus::restarted;
      while (status == ReadStatus::restarted) {
        status = reader->read_at(time, payload, info);
      }
      if (status != ReadStatus::ok || !is_in_range(info.time)) continue;
      DSSM_TRY(write({i, info, kUnknownClockError, std::span(payload).first(info.payload_bytes)},
                     timeline.stamp(info.time)));
    }
    return {};
  }

  bool is_in_range(Time time) const { return time >= range_.from && time <= range_.to; }

  // The sample that stream of the recording had at `time`, by going back to it.
  Result<void> write_found(std::size_t stream, Time time, const Timeline& timeline) {
    RecordingCursor cursor = recording_.cursor();
    cursor.seek(saturating_add(time, Duration(1)));
    RecordedSample sample;
    do {
      if (!cursor.previous(sample)) return {};
    } while (sample.stream != stream || sample.info.time > time);
    if (!is_in_range(sample.info.time)) return {};
    return write(sample, timeline.stamp(sample.info.time));
  }

  Result<void> jump_to(Timeline& timeline, Time time) {
    time = std::clamp(time, range_.from, range_.to);
    timeline.set_time(time);
    return follow_jump(time, timeline);
  }

  Result<void> follow(Key key, Timeline& timeline) {
    constexpr double kFaster = 1.1;  // as `ros2 bag play`
    constexpr double kMinRate = 1e-3, kMaxRate = 1e6;
    constexpr Duration kJump = std::chrono::seconds(10);
    const auto set_rate = [&](double rate) {
      timeline.set_speed(std::copysign(std::clamp(std::fabs(rate), kMinRate, kMaxRate), rate));
    };
    // Before the key changes the time: what lies between is not due.
    if (timeline.has_jumped()) DSSM_TRY(follow_jump(timeline.now(), timeline));
    switch (key) {
      case Key::space:
        timeline.set_paused(!timeline.is_paused());
        break;
      case Key::right:
        return step(timeline, false);
      case Key::left:
        return step(timeline, true);
      case Key::up:
        set_rate(timeline.speed() * kFaster);
        break;
      case Key::down:
        set_rate(timeline.speed() / kFaster);
        break;
      case Key::r: {
        const bool was_backwards = timeline.speed() < 0;
        set_rate(-timeline.speed());
        DSSM_TRY(play_due(timeline.changed_at(), was_backwards, timeline));
        break;
      }
      case Key::page_up:
        return jump_to(timeline, saturating_add(timeline.now(), -kJump));
      case Key::page_down:
        return jump_to(timeline, saturating_add(timeline.now(), kJump));
      case Key::home:
        return jump_to(timeline, range_.from);
      default:
        return {};
    }
    shows_now_ = true;
    return {};
  }

  // Pauses, and plays one sample.
  Result<void> step(Timeline& timeline, bool backwards) {
    if (!timeline.is_paused()) timeline.set_paused(true);
    DSSM_TRY(play_due(timeline.now(), timeline.speed() < 0, timeline));
    const RecordedSample* next = course_.peek(backwards);
    // After a step in the other direction it would be the one that was played last.
    if (next && last_stepped_ && last_stepped_->first != backwards &&
        last_stepped_->second == next->info.time) {
      course_.taken();
      next = course_.peek(backwards);
    }
    if (!next) return {};
    const Time time = next->info.time;
    timeline.start(time, timeline.speed(), true);
    DSSM_TRY(play(*next, timeline.stamp(time)));
    course_.taken();
    last_stepped_ = {backwards, time};
    shows_now_ = true;
    return {};
  }

  // --- for people

  void show(const Timeline& timeline) {
    show(timeline.now(), timeline.is_paused()    ? ", paused"
                         : timeline.speed() == 1 ? ""
                                                 : fmt::format(", x{:.3g}", timeline.speed()));
  }
  void show(Time time, const std::string& state = {}) {
    if (options_.json) return;
    const auto text = [&] {
      return fmt::format("{}: {}, {}{}", escaped(options_.file), time_text(time, options_.iso),
                         counted(played_, "sample", "samples"), state);
    };
    out_.redraw_line(text, std::exchange(shows_now_, false));
  }

  const PlayOptions& options_;
  Session session_;
  const Recording& recording_;
  const PlayedPart range_;
  Output& out_;
  Keyboard keyboard_;
  std::string own_host_;
  std::vector<Target> targets_;
  std::vector<std::optional<std::size_t>> target_of_;  // of each stream of the recording
  std::vector<std::size_t> changing_;                  // streams whose property changes
  Course course_;
  std::optional<std::pair<bool, Time>> last_stepped_;  // backwards, and to which time
  bool has_run_ = false;    // the timeline, since all that was due was played
  bool shows_now_ = false;  // what a key has changed
  std::uint64_t played_ = 0;
  Duration rest_{};  // of the recording, that programs in lockstep did not wait for
};

}  // namespace

Result<void> run(const PlayOptions& options, Output& out) {
  const Recording recording = DSSM_TRY(open_recording(options.file, options.more_files));
  std::size_t told = 0;
  // What is damaged in the midst of a file is found when that is read.
  const auto tell_warnings = [&] {
    const std::vector<std::string> warnings = recording.warnings();
    for (; told < warnings.size(); ++told) print_notice(escaped_message(warnings[told]));
  };
  tell_warnings();
  const PlayedPart range = DSSM_TRY(played_part(recording, options));
  Session session = DSSM_TRY(connect(options));
  std::optional<PlaybackClock> clock;
  if (!options.now) clock = DSSM_TRY(session.open_playback_clock());
  const Session sharing = session;
  Player player(options, std::move(session), recording, range, out);
  const auto play = [&]() -> Result<void> {
    std::unique_ptr<SharedPlayback> shared;
    if (clock) {
      auto taken = SharedPlayback::take(sharing, *clock, print_notice);
      if (!taken && taken.error().code == Errc::conflict) {
        return Error{Errc::conflict, taken.error().message +
                                         ". To play beside it: several files with one `dssmctl "
                                         "play`, or --now, which leaves the clock alone"};
      }
      shared = DSSM_TRY(std::move(taken));
    }
    DSSM_TRY(player.prepare());
    if (shared && !options.this_host) shared->share_with_all_hosts();
    catch_stop_signals();
    Result<void> played;
    if (options.lockstep.empty()) {
      Timeline timeline(std::move(clock),
                        options.this_host ? Duration::zero() : SharedPlayback::kLead);
      played = player.play_by(timeline);
    } else {
      DSSM_TRY(player.check_leftovers());
      const auto lockstep =
          DSSM_TRY(Lockstep::start(options.lockstep, options.socket_path, range.from, out));
      played = player.play_by(*lockstep, *clock);
      clock->reset();
    }
    player.print_summary();
    tell_warnings();
    return played;
  };
  Result<void> played = play();
  if (!played) player.remove_empty_streams();
  return played;
}

}  // namespace dssm::ctl
