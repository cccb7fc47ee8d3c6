// SPDX-License-Identifier: Apache-2.0
//
// dssmctl playback: the PC's shared playback clock (SSM time), which players of recordings turn and
// programs that live in log time follow.
#include <fmt/format.h>

#include <cmath>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

double seconds_of(const Moment& moment) {
  const Time time = moment.back ? saturating_add(WallClock::now(), *moment.back) : moment.time;
  return static_cast<double>(to_ns(time)) / 1e9;
}

bool changes(const PlaybackOptions& options) {
  return options.reset || options.paused || options.speed || options.offset_s || options.time;
}

// Fails on a host whose clock follows another one: the next renewal would undo the change.
Result<void> check_is_own(Session& session) {
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  const std::string& driver = daemon.playback_driver;
  if (driver.empty()) return {};
  const std::size_t at = driver.rfind('@');  // the name may be cut before it
  const std::string where =
      at == std::string::npos ? "its host" : "'" + escaped(driver.substr(at + 1)) + "'";
  return Error{Errc::conflict,
               fmt::format("change the playback clock of '{}': it follows '{}', which would "
                           "undo the change within a second; use `dssmctl playback` on {}, or "
                           "end that program",
                           escaped(daemon.host), escaped(driver), where)};
}

void change(PlaybackClock& clock, const PlaybackOptions& options) {
  if (options.reset) clock.reset();
  if (options.paused) clock.set_paused(*options.paused);
  // Speed first: it moves the offset to keep the clock continuous.
  if (options.speed) clock.set_speed(*options.speed);
  if (options.offset_s) clock.set_offset(*options.offset_s);
  if (options.time) clock.set_time(seconds_of(*options.time));
}

void print(const PlaybackClock& clock, const PlaybackOptions& options, Output& out) {
  const PlaybackClock::Setting setting = clock.setting();
  const double now_s = clock.now_s();
  if (options.json) {
    return out.add(json_document({{"time_s", now_s},
                                  {"offset_s", setting.offset_s},
                                  {"speed", setting.speed},
                                  {"paused", setting.paused}}));
  }
  // The clock may show any number, but ISO 8601 has only some centuries.
  const bool as_iso = options.iso && std::fabs(now_s) < 9.2e9;
  const std::string time =
      as_iso ? iso_text(time_from_ns(std::llround(now_s * 1e9))) : fmt::format("{:.6f} s", now_s);
  out.add(fmt::format("time:    {}\noffset:  {:.6f} s\nspeed:   {:.3f}\npaused:  {}\n", time,
                      setting.offset_s, setting.speed, setting.paused ? "yes" : "no"));
}

}  // namespace

Result<void> run(const PlaybackOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  PlaybackClock clock = DSSM_TRY(session.open_playback_clock());
  if (changes(options)) DSSM_TRY(check_is_own(session));
  change(clock, options);
  print(clock, options, out);
  return {};
}

}  // namespace dssm::ctl
