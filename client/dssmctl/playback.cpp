// SPDX-License-Identifier: Apache-2.0
//
// dssmctl playback: the PC's shared playback clock (SSM time), which players of recordings turn and
// programs that live in log time follow.
#include <fmt/format.h>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Whether there was something to change.
bool change(PlaybackClock& clock, const PlaybackOptions& options) {
  if (options.reset) clock.reset();
  if (options.paused) clock.set_paused(*options.paused);
  // Speed first: it moves the offset to keep the clock continuous.
  if (options.speed) clock.set_speed(*options.speed);
  if (options.offset_s) clock.set_offset(*options.offset_s);
  if (options.time_s) clock.set_time(*options.time_s);
  return options.reset || options.paused || options.speed || options.offset_s || options.time_s;
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
  out.add(fmt::format("time:    {:.6f} s\noffset:  {:.6f} s\nspeed:   {:.3f}\npaused:  {}\n", now_s,
                      setting.offset_s, setting.speed, setting.paused ? "yes" : "no"));
}

}  // namespace

Result<void> run(const PlaybackOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  PlaybackClock clock = DSSM_TRY(session.open_playback_clock());
  const bool changed = change(clock, options);
  if (!changed || options.json) print(clock, options, out);
  return {};
}

}  // namespace dssm::ctl
