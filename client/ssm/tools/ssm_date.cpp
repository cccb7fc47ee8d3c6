// SPDX-License-Identifier: Apache-2.0
//
// ssm-date: shows and sets the clock that SSM programs share. Options act in their order.
//
// Exit status: 0; 1 for help, bad options, and without dssmd.
#include <getopt.h>
#include <unistd.h>

#include "tool.hpp"

using namespace dssm::ssm_tools;

namespace {

bool is_quiet = false;

void print_help(bool is_long) {
  std::fprintf(stderr,
               "SSM-DATE\n"
               "  shows and sets the clock that SSM programs share\n"
               "USAGE\n"
               "  ssm-date [options]    options act in their order; without any: --get-all\n"
               "OPTIONS\n"
               "  -a | --get-all         : date, time, speed, pause\n"
               "  -A | --get-full        : these, the real date and time, and the direction\n"
               "  -I | --init            : real time, speed 1, not paused\n"
               "  -T | --set-time TIME   : seconds since 1970\n"
               "  -X | --set-speed SPEED\n"
               "  -P | --set-pause 0|1\n"
               "  -q | --quiet           : values without their names\n"
               "  -h | --help            : print this help\n"
               "  -H | --long-help       : print all options\n");
  if (!is_long) return;
  std::fprintf(stderr,
               "  -d | --get-date        : SSM date\n"
               "  -t | --get-time        : SSM time\n"
               "  -u | --get-date-real   : real date\n"
               "  -U | --get-time-real   : real time\n"
               "  -x | --get-speed\n"
               "  -s | --increase-speed  : 1.1 times as fast\n"
               "  -S | --decrease-speed  : 1.1 times as slow\n"
               "  -p | --get-pause\n"
               "  -g | --toggle-pause\n"
               "  -r | --get-reverse\n"
               "  -R | --set-reverse 0|1\n"
               "  -G | --toggle-reverse\n"
               "       --sleep SEC       : sleep for a span of SSM time\n"
               "       --usleep USEC     : the same in microseconds\n"
               "  -v | --verbose         : accepted\n");
}

// A line of the output; its name is padded as SSM pads it.
void print(const char* name, const std::string& value) {
  if (is_quiet) {
    std::puts(value.c_str());
  } else {
    std::printf("%-10s : %s\n", name, value.c_str());
  }
}

void print_date() { print("SSM DATE", date_of(gettimeSSM())); }
void print_time() { print("SSM TIME", std::to_string(gettimeSSM())); }
void print_real_date() { print("REAL DATE", date_of(gettimeSSM_real())); }
void print_real_time() { print("REAL TIME", std::to_string(gettimeSSM_real())); }
void print_speed() { print("SSM SPEED", std::to_string(gettimeSSM_speed())); }
void print_pause() {
  const int is_pause = gettimeSSM_is_pause();
  print("IS_PAUSE", is_quiet ? std::to_string(is_pause) : is_pause ? "PAUSE" : "PLAY");
}
void print_reverse() {
  const int is_reverse = gettimeSSM_is_reverse();
  print("IS_REVERSE", is_quiet ? std::to_string(is_reverse) : is_reverse ? "REVERSE" : "FORWARD");
}
void print_all() { print_date(), print_time(), print_speed(), print_pause(); }
void print_full() {
  print_date(), print_time(), print_real_date(), print_real_time();
  print_speed(), print_pause(), print_reverse();
}

std::optional<bool> parse_flag(const char* text) {
  if (std::strcmp(text, "0") == 0 || std::strcmp(text, "1") == 0) return *text == '1';
  print_error("this option's value is 0 or 1, not '%s'", text);
  return std::nullopt;
}

enum : int { sleep_seconds = 256, sleep_microseconds };

// Does what one option says; false when its value is wrong or nothing could be set.
bool act(int option, const char* value) {
  const auto with_number = [&](const char* what, auto use) {
    const std::optional<double> number = parse_number(value, what);
    return number && use(*number);
  };
  const auto with_flag = [&](auto use) {
    const std::optional<bool> flag = parse_flag(value);
    return flag && use(*flag ? 1 : 0) != 0;
  };
  switch (option) {
    case 'a':
      return print_all(), true;
    case 'A':
      return print_full(), true;
    case 'd':
      return print_date(), true;
    case 't':
      return print_time(), true;
    case 'u':
      return print_real_date(), true;
    case 'U':
      return print_real_time(), true;
    case 'x':
      return print_speed(), true;
    case 'p':
      return print_pause(), true;
    case 'r':
      return print_reverse(), true;
    case 'I':
      return inittimeSSM(), true;
    case 'T':
      return with_number("a time", [](double time) { return settimeSSM(time) != 0; });
    case 'X':
      return with_number("a speed", [](double speed) { return settimeSSM_speed(speed) != 0; });
    case 's':
      return settimeSSM_speed(gettimeSSM_speed() * 1.1) != 0;
    case 'S':
      return settimeSSM_speed(gettimeSSM_speed() / 1.1) != 0;
    case 'P':
      return with_flag(settimeSSM_is_pause);
    case 'g':
      return settimeSSM_is_pause(!gettimeSSM_is_pause()) != 0;
    case 'R':
      return with_flag(settimeSSM_is_reverse);
    case 'G':
      return settimeSSM_is_reverse(!gettimeSSM_is_reverse()) != 0;
    case sleep_seconds:
      return with_number("a span", [](double s) { return std::fflush(stdout), sleepSSM(s) == 0; });
    default:
      return with_number("a span",
                         [](double us) { return std::fflush(stdout), sleepSSM(us * 1e-6) == 0; });
  }
}

}  // namespace

int main(int argc, char** argv) {
  const option known[] = {{"get-all", no_argument, nullptr, 'a'},
                          {"get-full", no_argument, nullptr, 'A'},
                          {"init", no_argument, nullptr, 'I'},
                          {"get-date", no_argument, nullptr, 'd'},
                          {"get-time", no_argument, nullptr, 't'},
                          {"set-time", required_argument, nullptr, 'T'},
                          {"get-date-real", no_argument, nullptr, 'u'},
                          {"get-time-real", no_argument, nullptr, 'U'},
                          {"get-speed", no_argument, nullptr, 'x'},
                          {"set-speed", required_argument, nullptr, 'X'},
                          {"increase-speed", no_argument, nullptr, 's'},
                          {"decrease-speed", no_argument, nullptr, 'S'},
                          {"get-pause", no_argument, nullptr, 'p'},
                          {"set-pause", required_argument, nullptr, 'P'},
                          {"get-reverse", no_argument, nullptr, 'r'},
                          {"set-reverse", required_argument, nullptr, 'R'},
                          {"toggle-pause", no_argument, nullptr, 'g'},
                          {"toggle-reverse", no_argument, nullptr, 'G'},
                          {"sleep", required_argument, nullptr, sleep_seconds},
                          {"usleep", required_argument, nullptr, sleep_microseconds},
                          {"quiet", no_argument, nullptr, 'q'},
                          {"verbose", no_argument, nullptr, 'v'},
                          {"help", no_argument, nullptr, 'h'},
                          {"long-help", no_argument, nullptr, 'H'},
                          {nullptr, 0, nullptr, 0}};
  bool is_connected = false, has_acted = false;
  constexpr const char* kShort = "aAIdtT:uUxX:sSpP:rR:gGqvhH";
  // NOLINTNEXTLINE(concurrency-mt-unsafe): one thread
  for (int option; (option = ::getopt_long(argc, argv, kShort, known, nullptr)) != -1;) {
    if (option == 'v') continue;
    if (option == 'q') {
      is_quiet = true;
      continue;
    }
    if (option == 'h' || option == 'H' || option == '?') {
      print_help(option == 'H');
      return 1;
    }
    if (!is_connected && !(is_connected = connect())) return 1;
    if (!act(option, optarg)) return 1;
    has_acted = true;
  }
  if (optind < argc) {
    print_error("'%s' is not an option; see --help", argv[optind]);
    return 1;
  }
  if (!has_acted) {
    if (!connect()) return 1;
    print_all();
  }
  endSSM();
  return 0;
}
