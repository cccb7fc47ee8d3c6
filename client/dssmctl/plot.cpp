// SPDX-License-Identifier: Apache-2.0
//
// dssmctl plot: fields of streams as curves over time, on the terminal or in a file.
#include <fmt/format.h>
#include <langinfo.h>
#include <locale.h>
#include <sys/ioctl.h>
#include <unistd.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <filesystem>
#include <optional>

#include "client/dssmctl/chart.hpp"
#include "client/dssmctl/describe_stream.hpp"
#include "client/dssmctl/draw.hpp"
#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/keyboard.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

constexpr Duration kScreenPeriod = std::chrono::milliseconds(500);
constexpr Duration kRowPeriod = std::chrono::seconds(1);
// For a file: what another host sends of the past comes within that.
constexpr Duration kHistoryTime = std::chrono::seconds(3);
// Of one curve; more samples than that thin out.
constexpr std::size_t kMaxPoints = 200'000;

// A field of a stream, and what it was.
class Curve {
 public:
  // target: STREAM.FIELD; `opened` is that stream, and `field` the rest
  static Result<Curve> create(std::string target, OpenedStream opened, const std::string& field) {
    Curve curve(std::move(target), std::move(opened), field);
    curve.obvious_ = obvious_type(curve.opened_.session, curve.opened_.reader, "plot");
    DSSM_TRY(curve.find_field_again());
    curve.opened_.reader.seek(kNoTid);
    return curve;
  }

  const std::string& name() const { return target_; }
  const std::vector<ChartPoint>& points() const { return points_; }
  Time newest() const { return points_.empty() ? Time::min() : points_.back().time; }
  // Whether samples of the past are still to come from another host.
  bool is_arriving() const { return is_arriving_; }

  // Reads what has come, and forgets what is older than `span` before the newest.
  Result<void> read_new(Duration span) {
    RawReader& reader = opened_.reader;
    for (;;) {
      SampleInfo info;
      payload_.resize(reader.payload_bytes());
      const std::uint64_t lost = reader.lost_samples();
      const ReadStatus status = reader.read_next(payload_, info);
      if (status == ReadStatus::restarted) {
        DSSM_TRY(find_field_again());
        continue;
      }
      is_arriving_ = status == ReadStatus::not_yet && reader.newest_tid() > reader.cursor();
      if (status != ReadStatus::ok) break;
      // A recording that is played again or backwards: the curve begins again at that time.
      while (!points_.empty() && points_.back().time > info.time) points_.pop_back();
      if (reader.lost_samples() != lost && !points_.empty()) {
        points_.push_back({info.time, NAN});  // no line over what is missing
      }
      const auto value = element_number(std::span(payload_).first(info.payload_bytes), found_.field,
                                        found_.element.value_or(0));
      points_.push_back({info.time, value.value_or(NAN)});
      if (points_.size() > 2 * kMaxPoints) thin();
    }
    const Time oldest = saturating_add(newest(), -span);
    std::erase_if(points_, [&](const ChartPoint& point) { return point.time < oldest; });
    return {};
  }

 private:
  Curve(std::string target, OpenedStream opened, const std::string& field)
      : target_(std::move(target)), opened_(std::move(opened)), field_(field) {}

  Result<void> find_field_again() {
    const std::vector<Field> fields =
        readable_fields_untrusted(type_to_show(opened_.reader.type(), obvious_));
    const auto error = [&](const std::string& reason) {
      return Error{Errc::invalid_argument, fmt::format("draw '{}': {}", escaped(target_), reason)};
    };
    if (fields.empty()) {
      return error(
          fmt::format("'{}' is not described, so its fields are not known; `dssmctl "
                      "describe {}` may find them",
                      escaped(opened_.reader.id().str()), escaped(opened_.reader.id().str())));
    }
    const auto found = find_field(fields, field_);
    if (!found) {
      DSSM_TRY(select_fields(fields, {field_}), fmt::format("draw '{}'", escaped(target_)));
      return error(
          "that has several fields, of which one is needed; `dssmctl info STREAM` lists "
          "them");
    }
    if (is_text(found->field)) return error("that is text");
    if (found->field.count > 1 && !found->element) {
      return error(fmt::format("that has {} elements; name one of them, as {}[0]",
                               found->field.count, escaped(target_)));
    }
    found_ = *found;
    return {};
  }

  // Every second one goes, but for gaps.
  void thin() {
    std::size_t number = 0;
    std::erase_if(points_, [&](const ChartPoint& point) {
      return ++number % 2 == 0 && std::isfinite(point.value);
    });
  }

  std::string target_;
  OpenedStream opened_;
  std::string field_;
  TypeInfo obvious_;  // of its programs, if it is not described
  FieldElement found_;
  std::vector<ChartPoint> points_;
  std::vector<std::byte> payload_;
  bool is_arriving_ = false;
};

// Stream and field of "STREAM.FIELD": of the ways in which that can be read, the one whose stream
// is there, or else the first.
Result<std::pair<std::string, std::string>> stream_and_field(Session& session,
                                                             const std::string& target) {
  const auto splits = splits_at_dots(target);
  if (splits.empty()) {
    return Error{Errc::invalid_argument,
                 fmt::format("'{}' is not STREAM.FIELD, as odometry.x; `dssmctl info STREAM` lists "
                             "a stream's fields",
                             escaped(target))};
  }
  for (const auto& split : splits) {
    const Result<StreamId> id = StreamId::parse(split.first);
    if (id && session.stream_info(*id)) return split;
  }
  return splits.front();
}

std::string value_text(const Curve& curve) {
  return curve.points().empty() ? "-" : fmt::format("{:.9g}", curve.points().back().value);
}

// Whether the terminal's characters are Unicode's, by the locale of this process.
bool knows_braille() {
  const locale_t locale = ::newlocale(LC_CTYPE_MASK, "", nullptr);
  if (!locale) return false;
  const bool is_utf8 = std::strcmp(::nl_langinfo_l(CODESET, locale), "UTF-8") == 0;
  ::freelocale(locale);
  return is_utf8;
}

// All curves, one below the other, as high as the terminal has room, and the keys at the bottom.
void print_charts(const std::vector<Curve>& curves, Time end, Duration span, bool has_keys,
                  Output& out) {
  winsize window{};
  const bool is_known = ::ioctl(STDOUT_FILENO, TIOCGWINSZ, &window) == 0 && window.ws_row > 0;
  const std::size_t rows = is_known ? window.ws_row : 24, columns = is_known ? window.ws_col : 80;
  ChartSize size;
  size.columns = std::max<std::size_t>(columns, 32) - 12;
  // A title for each, the time axis, the keys, and the line in which the cursor stands.
  const std::size_t used = curves.size() + 3;
  size.rows = std::max<std::size_t>(rows > used ? (rows - used) / curves.size() : 0, 2);
  const bool plain = !knows_braille();
  for (const Curve& curve : curves) {
    out.add(fmt::format("{}  {}\n", out.bold(escaped(curve.name())), value_text(curve)));
    for (const std::string& line : draw_chart(curve.points(), end, span, size, plain)) {
      out.add(line + "\n");
    }
  }
  const std::string left = fmt::format("-{}", duration_text(span));
  const std::string right = end == Time::min() ? "nothing yet" : time_text(end, true);
  out.add(fmt::format("{:11}{:<{}}{}\n", "", left,
                      size.columns > right.size() ? size.columns - right.size() : 0, right));
  out.add(has_keys ? "q quit\n" : "Ctrl-C quit\n");
}

// Sleeps until `due`. False: it must stop, or q was pressed.
bool sleep_unless_quit(MonoTime due, Keyboard& keyboard, Output& out) {
  while (!out.must_stop()) {
    if (MonoClock::now() >= due) return true;
    const MonoTime check = std::min(due, deadline_in(kStopCheckPeriod));
    if (keyboard.wait(check) == Key::q) return false;
  }
  return false;
}

void print_row(const std::vector<Curve>& curves, Time end, bool json, bool iso, Output& out) {
  if (json) {
    Json values = Json::object();
    for (const Curve& curve : curves) {
      const bool has_value = !curve.points().empty() && std::isfinite(curve.points().back().value);
      values[curve.name()] = has_value ? Json(curve.points().back().value) : Json();
    }
    out.add(json_line({{"time_ns", end == Time::min() ? Json() : Json(to_ns(end))},
                       {"values", std::move(values)}}));
    return;
  }
  std::string line = end == Time::min() ? "-" : time_text(end, iso);
  for (const Curve& curve : curves) line += " " + value_text(curve);
  out.add(line + "\n");
}

Result<void> read_all(std::vector<Curve>& curves, Duration span) {
  for (Curve& curve : curves) DSSM_TRY(curve.read_new(span));
  return {};
}

Result<void> plot_file(std::vector<Curve>& curves, const PlotOptions& options, Output& out) {
  // Before it waits for samples; gnuplot would say it in many words.
  const std::filesystem::path folder = std::filesystem::path(options.out).parent_path();
  if (::access(folder.empty() ? "." : folder.c_str(), W_OK)) {
    return os_error(fmt::format("write '{}'", escaped(options.out)));
  }
  const MonoTime history_by = deadline_in(kHistoryTime);
  const MonoTime end = options.duration ? deadline_in(*options.duration) : MonoTime{};
  const auto is_complete = [&] {
    const bool arrives = std::any_of(curves.begin(), curves.end(),
                                     [](const Curve& curve) { return curve.is_arriving(); });
    const MonoTime now = MonoClock::now();
    return now >= end && (!arrives || now >= history_by);
  };
  do {
    DSSM_TRY(read_all(curves, options.span));
    // Ctrl-C ends the time of --for early: what there is then is drawn.
  } while (!is_complete() && out.sleep_until(deadline_in(std::chrono::milliseconds(50))));
  std::vector<NamedCurve> named;
  for (const Curve& curve : curves) {
    const bool has_value =
        std::any_of(curve.points().begin(), curve.points().end(),
                    [](const ChartPoint& point) { return std::isfinite(point.value); });
    if (!has_value) {
      return Error{
          Errc::not_found,
          fmt::format("draw '{}': {}; --for 10s waits for what comes", escaped(curve.name()),
                      curve.points().empty() ? "nothing was written to the stream yet"
                                             : "it was not a number at any time")};
    }
    named.push_back({curve.name(), curve.points()});
  }
  const std::string format = options.out.substr(options.out.rfind('.') + 1);
  // gnuplot would run what is after a '|'.
  const std::string file = options.out.starts_with('|') ? "./" + options.out : options.out;
  return draw(options.out, {"gnuplot"}, gnuplot_text(named, format, file),
              "install gnuplot (`sudo apt install gnuplot-nox`)");
}

}  // namespace

Result<void> run(const PlotOptions& options, Output& out) {
  std::vector<std::string> streams, fields;
  {
    Session session = DSSM_TRY(connect(options));
    for (const std::string& target : options.targets) {
      auto [stream, field] = DSSM_TRY(stream_and_field(session, target));
      streams.push_back(std::move(stream)), fields.push_back(std::move(field));
    }
  }
  std::vector<OpenedStream> opened =
      DSSM_TRY(open_streams(options, streams, FetchHistory::at_once));
  if (opened.empty()) return {};
  std::vector<Curve> curves;
  for (std::size_t i = 0; i < opened.size(); ++i) {
    curves.push_back(DSSM_TRY(Curve::create(options.targets[i], std::move(opened[i]), fields[i])));
  }
  if (!options.out.empty()) return plot_file(curves, options, out);
  const bool is_drawn = out.terminal() && !options.json;
  const MonoTime end = options.duration ? deadline_in(*options.duration) : kNever;
  const Duration period = is_drawn ? kScreenPeriod : kRowPeriod;
  std::optional<Keyboard> keyboard;  // rows may be in a pipe: the terminal's keys are not theirs
  if (is_drawn) keyboard.emplace();
  // After a pause of this program not for each period that it missed.
  for (MonoTime next = MonoClock::now();; next = std::max(next + period, MonoClock::now())) {
    const MonoTime due = std::min(next, end);
    if (!(keyboard ? sleep_unless_quit(due, *keyboard, out) : out.sleep_until(due))) return {};
    DSSM_TRY(read_all(curves, options.span));
    Time newest = Time::min();
    for (const Curve& curve : curves) newest = std::max(newest, curve.newest());
    if (is_drawn) {
      print_charts(curves, newest, options.span, keyboard->is_there(), out);
      if (!out.flush_screen()) return {};
    } else {
      print_row(curves, newest, options.json, options.iso, out);
      if (!out.flush()) return {};
    }
    if (MonoClock::now() >= end) return {};
  }
}

}  // namespace dssm::ctl
