// SPDX-License-Identifier: Apache-2.0
//
// dssmctl playback: the PC's shared playback clock (SSM time), which players of recordings turn and
// programs that live in log time follow.
#include "client/dssmctl/json.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

void turn(PlaybackClock& clock, const Options& options) {
  switch (options.verb) {
    case Verb::playback_pause:
      return clock.set_paused(true);
    case Verb::playback_resume:
      return clock.set_paused(false);
    case Verb::playback_reset:
      return clock.reset();
    case Verb::playback_set:
      // Speed first: it moves the offset to keep the clock continuous.
      if (options.playback_speed) clock.set_speed(*options.playback_speed);
      if (options.playback_offset_s) clock.set_offset(*options.playback_offset_s);
      if (options.playback_time_s) clock.set_time(*options.playback_time_s);
      return;
    default:
      return;
  }
}

void print(const PlaybackClock& clock, const Options& options, Output& out) {
  const PlaybackClock::Setting setting = clock.setting();
  const double now_s = clock.now_s();
  if (options.json) {
    return out.add(json_document({{"time_s", now_s},
                                  {"offset_s", setting.offset_s},
                                  {"speed", setting.speed},
                                  {"paused", setting.paused}}));
  }
  out.add("time:    " + fixed_text(now_s, 6) + " s\n");
  out.add("offset:  " + fixed_text(setting.offset_s, 6) + " s\n");
  out.add("speed:   " + fixed_text(setting.speed, 3) + "\n");
  out.add(std::string("paused:  ") + (setting.paused ? "yes" : "no") + "\n");
}

}  // namespace

Result<void> run_playback(const Options& options, Output& out) {
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  Result<PlaybackClock> clock = session->open_playback_clock();
  if (!clock) return std::move(clock).error();
  turn(*clock, options);
  const bool asked = options.verb == Verb::playback_show;
  if (asked || options.json) print(*clock, options, out);
  return {};
}

}  // namespace dssm::ctl
