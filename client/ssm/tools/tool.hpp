// SPDX-License-Identifier: Apache-2.0
//
// What several of SSM's tools need. Their names, options, output and exit statuses are SSM's
// (docs/ssm.md "Tools"); they use libssm's public interface.
#pragma once

#include <libssm.h>

#include <cerrno>
#include <cmath>
#include <csignal>
#include <cstdarg>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <ctime>
#include <optional>
#include <string>
#include <vector>

namespace dssm::ssm_tools {

// Prints "ERROR : ...", SSM's way.
[[gnu::format(printf, 1, 2)]] inline void print_error(const char* format, ...) {
  std::fputs("ERROR : ", stderr);
  va_list values;
  va_start(values, format);
  std::vfprintf(stderr, format, values);
  va_end(values);
  std::fputc('\n', stderr);
}

// Whether -h or --help is among the arguments; prints the usage then. For tools without options,
// which ignore all other arguments, as SSM's do.
inline bool prints_help(int argc, char** argv, const char* what_it_does) {
  for (int i = 1; i < argc; ++i) {
    if (std::strcmp(argv[i], "-h") != 0 && std::strcmp(argv[i], "--help") != 0) continue;
    std::printf("usage: %s\n  %s\n", ::program_invocation_short_name, what_it_does);
    return true;
  }
  return false;
}

// Registers this program with dssmd; false, with a message, when there is none. libssm says why.
inline bool connect() {
  if (initSSM()) return true;
  print_error("cannot init ssm.");
  return false;
}

// The whole of `text` as a finite number; nothing, with a message, when it is not one.
inline std::optional<double> parse_number(const char* text, const char* what) {
  char* end = nullptr;
  const double value = std::strtod(text, &end);
  if (end != text && *end == '\0' && std::isfinite(value)) return value;
  print_error("%s is a number, not '%s'", what, text);
  return std::nullopt;
}

inline std::optional<int> parse_stream_id(const char* text) {
  const std::optional<double> id = parse_number(text, "a stream id");
  if (!id) return std::nullopt;
  if (*id >= 0 && *id <= 2147483647.0 && *id == std::floor(*id)) return static_cast<int>(*id);
  print_error("a stream id is 0 or more, not '%s'", text);
  return std::nullopt;
}

// "2026/11/27(Fri) 12:00:00 UTC"
inline std::string date_of(double time) {
  const double whole =
      std::fmax(-1e12, std::fmin(std::floor(time), 1e12));  // what std::tm can hold
  const auto seconds = static_cast<std::time_t>(whole);
  std::tm parts{};
  char text[96] = {};
  ::localtime_r(&seconds, &parts);
  std::strftime(text, sizeof text, "%Y/%m/%d(%a) %H:%M:%S %Z", &parts);
  return text;
}

// A number of bytes, scaled by 1024, and the letter of its unit: 16 and ' ', 1.5 and 'k'.
struct Scaled {
  double value;
  char unit;
};
inline Scaled scale(double bytes) {
  const char* unit = " kMGTPEZY";
  for (; bytes >= 1024 && unit[1]; ++unit) bytes /= 1024;
  return {bytes, *unit};
}

// The streams of this PC in the order of creation; nothing, with a message, when dssmd is gone.
struct StreamName {
  std::string name;
  int id;
  bool operator==(const StreamName&) const = default;
};
inline std::optional<std::vector<StreamName>> list_streams() {
  const int count = getSSM_num();
  if (count < 0) {
    print_error("cannot list the streams : dssmd does not answer");
    return std::nullopt;
  }
  std::vector<StreamName> streams;
  for (int i = 0; i < count; ++i) {
    char name[SSM_SNAME_MAX] = {};
    int id = 0;
    if (getSSM_name(i, name, &id, nullptr) < 0) break;  // one was removed meanwhile
    streams.push_back({name, id});
  }
  return streams;
}

// How many signals have asked the program to end, after end_on_signals(); they interrupt sleeps.
inline volatile std::sig_atomic_t end_requested = 0;
inline void end_on_signals() {
  struct sigaction action {};
  action.sa_handler = [](int) { end_requested = end_requested + 1; };
  for (const int signal : {SIGINT, SIGTERM, SIGHUP, SIGQUIT, SIGPIPE})
    ::sigaction(signal, &action, nullptr);
}

}  // namespace dssm::ssm_tools
