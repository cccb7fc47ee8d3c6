// SPDX-License-Identifier: Apache-2.0
//
// dssmctl play: a recording into streams, at the pace of the PC's playback clock. Programs that use
// that clock live in the time of the recording, and `dssmctl playback` changes its speed or pauses
// it meanwhile. With --now the stamps are those of now, and the clock is left alone.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <dssm/recording.hpp>
#include <map>
#include <optional>

#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

double seconds_of(Time time) { return static_cast<double>(to_ns(time)) / 1e9; }

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
  const auto moment = [&](const std::optional<Moment>& wanted, Time otherwise) {
    if (!wanted) return otherwise;
    return wanted->back ? saturating_add(whole.to, *wanted->back) : wanted->time;
  };
  const PlayedPart range{moment(options.from, whole.from), moment(options.to, whole.to)};
  if (range.from > whole.to || range.to < whole.from || range.from > range.to) {
    return Error{Errc::invalid_argument,
                 fmt::format("--from and --to: there is nothing between them; '{}' goes from {} to "
                             "{}",
                             escaped(options.file), time_text(whole.from, options.iso),
                             time_text(whole.to, options.iso))};
  }
  return range;
}

// When samples are due.
class Pace {
 public:
  // With a clock: the samples' own times, by which it is turned. Without: times from now on.
  Pace(std::optional<PlaybackClock> clock, double rate) : clock_(std::move(clock)), rate_(rate) {}
  Pace(const Pace&) = delete;
  Pace& operator=(const Pace&) = delete;
  ~Pace() {
    if (clock_) clock_->reset();
  }

  // The recording begins now, at time `from`.
  void start(Time from) {
    from_ = from;
    started_ = WallClock::now();
    if (!clock_) return;
    clock_->set_paused(true);
    clock_->set_speed(rate_);
    clock_->set_time(seconds_of(from));
    clock_->set_paused(false);
  }

  // The stamp that a sample with this time gets.
  Time stamp(Time time) const {
    if (clock_) return time;
    const double since_ns = static_cast<double>(to_ns(saturating_sub(time, from_))) / rate_;
    return saturating_add(started_, Duration(std::llround(since_ns)));
  }

  // Waits until a sample with this time is due. False: it must stop.
  bool await(Time time, Output& out) const {
    while (!out.must_stop()) {
      const Duration rest = until(time);
      if (rest <= Duration::zero()) return true;
      if (!out.sleep_until(deadline_in(std::min(rest, kStopCheckPeriod)))) return false;
    }
    return false;
  }

 private:
  // How long until then, if nobody changes the clock.
  Duration until(Time time) const {
    if (!clock_) return saturating_sub(stamp(time), WallClock::now());
    const double missing_s = seconds_of(time) - clock_->now_s();
    if (missing_s <= 0) return {};
    const PlaybackClock::Setting setting = clock_->setting();
    if (setting.paused || setting.speed <= 0) return kStopCheckPeriod;
    return std::chrono::duration_cast<Duration>(
        std::chrono::duration<double>(std::min(missing_s / setting.speed, 1.0)));
  }

  std::optional<PlaybackClock> clock_;
  double rate_;
  Time from_{}, started_{};
};

// Where the streams of the recording go.
class Player {
 public:
  Player(const PlayOptions& options, Session session, const Recording& recording, Output& out)
      : options_(options), session_(std::move(session)), recording_(recording), out_(out) {}

  // Creates the streams.
  Result<void> prepare() {
    const DaemonInfo daemon = DSSM_TRY(session_.daemon_info());
    own_host_ = daemon.host;
    const StreamFilter filter({}, options_.patterns);
    std::map<std::string, std::string> sources;  // by the name here
    for (const RecordedStreamInfo& stream : recording_.streams()) {
      writers_.emplace_back();
      if (!filter.takes(stream.id)) continue;
      const StreamId id = DSSM_TRY(target_of(stream.id));
      const auto [entry, is_new] = sources.emplace(id.str(), stream.id.str());
      if (!is_new && entry->second != stream.id.str()) {
        return Error{Errc::invalid_argument,
                     fmt::format("'{}' and '{}' are both to be played as '{}'; --map {}=OTHER "
                                 "renames one",
                                 escaped(entry->second), escaped(stream.id.str()),
                                 escaped(short_name(id)), escaped(stream.id.str()))};
      }
      writers_.back() = DSSM_TRY(writer_for(id, stream, is_new));
      is_any_ = true;
    }
    if (!is_any_) return Error{Errc::not_found, "no stream of the recording fits"};
    return {};
  }

  Result<void> play(const PlayedPart& range, Pace& pace) {
    std::uint64_t played_before = 0;
    do {
      played_before = played_;
      pace.start(range.from);
      RecordingCursor cursor = recording_.cursor();
      cursor.seek(range.from);
      for (RecordedSample sample; cursor.next(sample);) {
        // Samples of a slow host may have been recorded late: to the very end.
        if (!writers_[sample.stream] || sample.info.time < range.from ||
            sample.info.time > range.to) {
          continue;
        }
        show(sample.info.time);
        if (!pace.await(sample.info.time, out_)) return {};
        DSSM_TRY(write(sample, pace));
      }
      if (played_ == played_before) {
        return Error{Errc::not_found, "no sample of these streams is in that part"};
      }
    } while (options_.loop && pace.await(range.to, out_));
    return {};
  }

  void print_summary() {
    out_.clear_line();
    const std::size_t streams = static_cast<std::size_t>(std::count_if(
        writers_.begin(), writers_.end(), [](const auto& writer) { return writer.has_value(); }));
    if (options_.json) {
      out_.add(
          json_document({{"file", options_.file}, {"streams", streams}, {"samples", played_}}));
    } else {
      out_.add(fmt::format("{}: {} of {} played\n", escaped(options_.file),
                           counted(played_, "sample", "samples"),
                           counted(streams, "stream", "streams")));
    }
  }

 private:
  // Its name here, with a host.
  Result<StreamId> target_of(const StreamId& id) const {
    StreamId target = id;
    if (!options_.on_hosts) target.host = own_host_;
    for (const std::string& mapping : options_.mappings) {
      const std::size_t equals = mapping.find('=');
      if (!StreamFilter({}, {mapping.substr(0, equals)}).takes(id)) continue;
      target = DSSM_TRY(StreamId::parse(mapping.substr(equals + 1)));
      if (target.host.empty()) target.host = own_host_;
      break;
    }
    return target;
  }

  Result<RawWriter> writer_for(const StreamId& id, const RecordedStreamInfo& stream,
                               bool is_first) {
    const Result<StreamInfo> existing = session_.stream_info(id);
    if (is_first && existing && existing->writers > 0 && !options_.force) {
      return Error{Errc::conflict,
                   fmt::format("'{}' is written by another program; end that, give --map {}=OTHER, "
                               "or --force to write beside it",
                               escaped(existing->id.str()), escaped(short_name(id)))};
    }
    const History history{std::max(stream.depth, kMinDepth), stream.cycle};
    RawWriter writer =
        DSSM_TRY(session_.create_raw(id, stream.type, history, {.keep_existing = true}));
    if (!stream.property.empty()) DSSM_TRY(session_.set_property(writer.id(), stream.property));
    return writer;
  }

  Result<void> write(const RecordedSample& sample, const Pace& pace) {
    RawWriter& writer = *writers_[sample.stream];
    const Time stamp = pace.stamp(sample.info.time);
    const Tid tid = options_.now ? writer.write(sample.payload, stamp)
                                 : writer.write(sample.payload, stamp, sample.info.clock_error);
    if (tid == kNoTid) {
      return Error{Errc::unavailable,
                   fmt::format("another writer has held the lock of '{}' for 2 s; is a program "
                               "stopped that writes it? `dssmctl info` names them",
                               escaped(writer.id().str()))};
    }
    ++played_;
    return {};
  }

  void show(Time time) {
    if (options_.json) return;
    out_.redraw_line([&] {
      return fmt::format("{}: {}, {}", escaped(options_.file), time_text(time, options_.iso),
                         counted(played_, "sample", "samples"));
    });
  }

  const PlayOptions& options_;
  Session session_;
  const Recording& recording_;
  Output& out_;
  std::string own_host_;
  std::vector<std::optional<RawWriter>> writers_;  // of each stream of the recording
  bool is_any_ = false;
  std::uint64_t played_ = 0;
};

}  // namespace

Result<void> run(const PlayOptions& options, Output& out) {
  const Recording recording = DSSM_TRY(open_recording(options.file, options.more_files));
  for (const std::string& warning : recording.warnings()) {
    print_error(fmt::format("dssmctl: play: {}\n", escaped_message(warning)));
  }
  const PlayedPart range = DSSM_TRY(played_part(recording, options));
  Session session = DSSM_TRY(connect(options));
  std::optional<PlaybackClock> clock;
  if (!options.now) clock = DSSM_TRY(session.open_playback_clock());
  Player player(options, std::move(session), recording, out);
  DSSM_TRY(player.prepare());
  catch_stop_signals();
  Pace pace(std::move(clock), options.rate);
  Result<void> played = player.play(range, pace);
  player.print_summary();
  return played;
}

}  // namespace dssm::ctl
