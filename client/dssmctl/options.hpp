// SPDX-License-Identifier: Apache-2.0
//
// The command line: what it may say, checked as far as that is possible without asking anybody.
#pragma once

#include <cstdint>
#include <dssm/stream.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>
#include <vector>

namespace dssm::ctl {

enum class Verb : unsigned char {
  ls,
  hosts,
  clock,
  doctor,
  ping,
  info,
  echo,
  hz,
  bw,
  delay,
  create,
  rm,
  property_get,
  property_set,
  playback_show,
  playback_set,
  playback_pause,
  playback_resume,
  playback_reset
};

struct Options {
  Verb verb = Verb::ls;
  std::string verb_name;  // as typed, "property get": for messages

  // for all verbs
  std::string socket_path;
  bool json = false;

  // most: which stream; empty for `info` about dssmd itself
  std::string stream;
  std::vector<std::string> streams;  // rm
  Duration wait{};                   // echo, hz, bw, delay: how long for the stream to appear

  // ls
  bool own = false;                // only this host's
  std::vector<std::string> hosts;  // only theirs; empty: of all
  std::string pattern;             // only streams whose names fit; empty: all
  bool watch = false;              // also for clock
  bool names = false;              // also for hosts
  std::string sort = "created";
  bool reverse = false;

  // clock
  std::optional<std::uint64_t> table;  // readings
  std::optional<Duration> clock_wait;

  // ping
  std::string host;

  // echo; `count` also for hz, bw, delay (reports) and ping (questions)
  std::optional<std::uint64_t> count;
  std::optional<Duration> at;
  bool at_counts_back = false;  // from the newest sample; `at` is then 0 or less
  bool last = false;
  bool csv = false;
  bool full = false;
  std::vector<std::string> fields;

  // hz, bw, delay; `interval` also for ping
  std::uint64_t window = 10'000;
  Duration interval = std::chrono::seconds(1);

  // create
  std::uint64_t payload_bytes = 0;
  std::uint32_t alignment_bytes = 0;  // 0: the greatest that a type of this size may have
  std::uint64_t depth = 0;
  std::optional<Duration> life, cycle;
  std::string type;

  // property
  std::string file = "-";

  // playback set
  std::optional<double> playback_offset_s, playback_speed, playback_time_s;
};

// Either options to work with, or a text that ends the program at once: help and version on
// standard output, a complaint on standard error.
struct CommandLine {
  std::optional<Options> options;
  std::string text;
  bool ok = true;  // text is what was asked for
};

CommandLine parse_command_line(int argc, const char* const* argv);

}  // namespace dssm::ctl
