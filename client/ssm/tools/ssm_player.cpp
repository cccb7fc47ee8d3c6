// SPDX-License-Identifier: Apache-2.0
//
// ssm-player: writes logs of ssm-logger into streams of their names, each record with its own time
// when the clock that SSM programs share reaches it, and sets that clock to the time of the logs.
//
// Each Track has one record in its buffer that is to be written next: the first one whose time the
// clock has not reached yet, in the direction of play. The records of all tracks are written in the
// order of their times. The clock may be changed by others at any moment (ssm-date, dssmctl
// playback), so it is asked again at least every 10 ms. Records with a time that no sample can have
// are left out: the clock would never reach them.
//
// All is opened before the clock is touched, and the clock is reset however the player ends, except
// by SIGKILL. Standard input is read only where poll(2) has something; its flags stay as they are.
//
// Exit status: 0; 1 for help, bad options, without dssmd, and when no log can be played.
#include <getopt.h>
#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <limits>
#include <memory>
#include <ssm-log.hpp>
#include <sstream>

#include "core/base/seconds.hpp"
#include "tool.hpp"

using namespace dssm::ssm_tools;

namespace {

constexpr double kInfinity = std::numeric_limits<double>::infinity();

void print_help() {
  std::fprintf(stderr,
               "SSM-PLAYER\n"
               "  plays logs back\n"
               "USAGE\n"
               "  ssm-player [options] LOG...\n"
               "OPTIONS\n"
               "  -x | --speed SPEED       : times as fast as recorded; negative: backwards\n"
               "  -s | --start-time SEC    : begin so long after the start of the earliest log\n"
               "  -e | --end-time SEC      : end so long after the start of the earliest log\n"
               "  -S | --start-ssmtime T   : begin at this time; with -s that much later\n"
               "  -E | --end-ssmtime T     : end at this time; with -e that much later\n"
               "  -l | --loop              : begin again at the end\n"
               "  -v | --verbose           : more messages\n"
               "  -q | --quiet             : no output but errors\n"
               "  -h | --help              : print this help\n"
               "COMMANDS, a line each on standard input\n"
               "  speed V, x V  skip D  seek D  pause, p  start, s  reverse, r  quit, q\n"
               "  + faster   - slower   > a step of 0.1 s\n");
}

struct Options {
  double speed = 1;
  double start_offset = 0, end_offset = 0, start_time = 0, end_time = 0;  // <= 0: not given
  bool loop = false, verbose = false, quiet = false;
  std::vector<const char*> logs;
};

bool parse(int argc, char** argv, Options& options) {
  const option known[] = {{"speed", required_argument, nullptr, 'x'},
                          {"start-time", required_argument, nullptr, 's'},
                          {"end-time", required_argument, nullptr, 'e'},
                          {"start-ssmtime", required_argument, nullptr, 'S'},
                          {"end-ssmtime", required_argument, nullptr, 'E'},
                          {"loop", no_argument, nullptr, 'l'},
                          {"verbose", no_argument, nullptr, 'v'},
                          {"quiet", no_argument, nullptr, 'q'},
                          {"help", no_argument, nullptr, 'h'},
                          {nullptr, 0, nullptr, 0}};
  // NOLINTNEXTLINE(concurrency-mt-unsafe): one thread
  for (int option; (option = ::getopt_long(argc, argv, "x:s:e:S:E:lvqh", known, nullptr)) != -1;) {
    double* const number = option == 'x'   ? &options.speed
                           : option == 's' ? &options.start_offset
                           : option == 'e' ? &options.end_offset
                           : option == 'S' ? &options.start_time
                           : option == 'E' ? &options.end_time
                                           : nullptr;
    if (number) {
      const std::optional<double> value = parse_number(optarg, "this option's value");
      if (!value) return false;
      *number = *value;
    } else if (option == 'l') {
      options.loop = true;
    } else if (option == 'v') {
      options.verbose = true;
    } else if (option == 'q') {
      options.quiet = true;
    } else {
      return print_help(), false;
    }
  }
  options.logs.assign(argv + optind, argv + argc);
  if (!options.logs.empty()) return true;
  print_error("give the logs to play: ssm-player [options] LOG...");
  return false;
}

// One log, and the stream that it is played into.
class Track {
 public:
  // Opens the log; false, with a message, when it cannot be played.
  bool open(const char* file_name) {
    file_name_ = file_name;
    if (!log_.open(file_name)) return false;
    data_.resize(log_.dataSize() + 1);  // an address also for samples of 0 bytes
    property_.resize(log_.propertySize() + 1);
    log_.setBuffer(data_.data(), log_.dataSize(), property_.data(), log_.propertySize());
    return log_.propertySize() == 0 || log_.readProperty();
  }

  // Creates the stream with as many slots as the recorded one had.
  bool create() {
    constexpr double kTiny = 2.5e-7;  // a log says 0 for a cycle of less than half a microsecond
    const double cycle = log_.getCycle() > 0 ? log_.getCycle() : kTiny;
    const double life = std::max(calcSSM_life(log_.getBufferNum(), cycle), cycle);
    stream_.setBuffer(data_.data(), log_.dataSize(), property_.data(), log_.propertySize());
    return stream_.create(log_.getStreamName(), log_.getStreamId(), life, cycle) &&
           (log_.propertySize() == 0 || stream_.setProperty());
  }

  std::string name() const {
    return "'" + std::string(log_.getStreamName()) + "' [" + std::to_string(log_.getStreamId()) +
           "]";
  }
  double start_time() const { return log_.getStartTime(); }

  // The time of the record to write next in the direction of play, after all others when there is
  // none.
  double next_time(bool reverse) {
    turn(reverse);
    return has_next_ ? log_.time() : reverse ? -kInfinity : kInfinity;
  }

  // Writes that record and takes the next one. False: the stream cannot be written.
  bool write() {
    const bool written = stream_.write(log_.time());
    take(reverse_);
    return written;
  }

  // The first record of the log becomes the next one.
  void begin() {
    reverse_ = false;
    has_next_ = skip_unusable(log_.readTime(-kInfinity), false);
  }

  // Continues at `time`: writes the newest record before it at once, so that readers have one.
  bool seek(double time, bool reverse) {
    reverse_ = reverse;
    has_next_ = skip_unusable(log_.readTime(time), true);
    // Before a record that is left out may be some of later times.
    while (has_next_ && log_.time() >= time) take(true);
    if (has_next_) return write();
    has_next_ = skip_unusable(log_.readTime(-kInfinity), false);  // all are later
    return true;
  }

  // The time of the last record.
  double end_time() {
    return skip_unusable(log_.readTime(kInfinity), true) ? log_.time() : log_.getStartTime();
  }

 private:
  bool read(bool reverse) { return reverse ? log_.readBack() : log_.readNext(); }
  void take(bool reverse) { has_next_ = skip_unusable(read(reverse), reverse); }

  // From the record in the buffer, if there is one, to the first whose time a sample can have;
  // false when there is none.
  bool skip_unusable(bool has_record, bool reverse) {
    while (has_record && !dssm::is_sample_time(log_.time())) {
      if (!warned_) {
        std::fprintf(stderr,
                     "WARNING : records of '%s' are left out : their times are not between the "
                     "years 1678 and 2261\n",
                     file_name_);
      }
      warned_ = true;
      has_record = read(reverse);
    }
    return has_record;
  }

  // After a change of direction the buffered record is on the wrong side of the clock.
  void turn(bool reverse) {
    if (reverse == reverse_) return;
    reverse_ = reverse;
    take(reverse);
  }

  const char* file_name_ = "";
  SSMLogBase log_;
  SSMApiBase stream_;
  std::vector<char> data_, property_;
  bool has_next_ = false;
  bool warned_ = false;  // of records that are left out
  bool reverse_ = false;
};

class Player {
 public:
  explicit Player(const Options& options) : options_(options) {}

  // Opens all that can be played; false when there is nothing.
  bool open() {
    for (const char* file : options_.logs) {
      auto track = std::make_unique<Track>();
      if (!track->open(file) || !track->create()) {
        std::fprintf(stderr, "skip log '%s'.\n", file);
        continue;
      }
      if (options_.verbose) std::printf("open log '%s' of %s.\n", file, track->name().c_str());
      tracks_.push_back(std::move(track));
    }
    if (tracks_.empty()) return print_error("there is no log to play"), false;
    log_start_ = kInfinity;
    for (const auto& track : tracks_) log_start_ = std::min(log_start_, track->start_time());
    start_ = options_.start_time > 0 ? options_.start_time : log_start_;
    if (options_.start_offset > 0) start_ += options_.start_offset;
    has_start_ = options_.start_time > 0 || options_.start_offset > 0;
    end_ = kInfinity;
    if (options_.end_time > 0) end_ = options_.end_time;
    if (options_.end_offset > 0) {
      end_ = (options_.end_time > 0 ? options_.end_time : log_start_) + options_.end_offset;
    }
    return true;
  }

  // Until the end of the logs, the end time, `quit` or a signal. False: a stream could not be
  // written.
  bool play() {
    begin();
    settimeSSM_is_pause(1);
    settimeSSM_speed(options_.speed);
    settimeSSM(start_);
    settimeSSM_is_pause(0);
    if (!options_.quiet) std::puts(is_terminal_ ? "\n\n\n\n\n  start" : "  start"), prompt();
    while (!end_requested && !quit_ && !failed_) {
      const bool reverse = gettimeSSM_is_reverse() != 0;
      const double now = gettimeSSM();
      write_due(now, reverse);
      if (is_at_end(now, reverse)) {
        if (!options_.loop) break;
        restart(reverse);
      }
      show_status(now);
      wait(now, reverse);
    }
    return !failed_;
  }

 private:
  void begin() {
    for (const auto& track : tracks_) {
      if (!has_start_) {
        track->begin();
      } else if (!track->seek(start_, options_.speed < 0)) {
        failed_ = true;
      }
    }
  }

  // The track whose record is to be written next.
  Track& first(bool reverse) {
    return **std::min_element(tracks_.begin(), tracks_.end(), [&](const auto& a, const auto& b) {
      return reverse ? a->next_time(true) > b->next_time(true)
                     : a->next_time(false) < b->next_time(false);
    });
  }

  // Writes what the clock has reached, in the order of time. Stops in between at the end time, and
  // for a signal.
  void write_due(double now, bool reverse) {
    const double until = reverse ? now : std::min(now, end_);
    while (!end_requested && !failed_) {
      Track& track = first(reverse);
      const double time = track.next_time(reverse);
      if (std::isinf(time) || (reverse ? time < until : time > until)) return;
      if (track.write()) continue;
      print_error("cannot write to stream %s", track.name().c_str());
      failed_ = true;
    }
  }

  bool is_at_end(double now, bool reverse) {
    if (!reverse && now > end_) return true;
    return std::isinf(first(reverse).next_time(reverse));
  }

  // Loops: from the start again, or backwards from the end.
  void restart(bool reverse) {
    double time = start_;
    if (reverse) {
      time = -kInfinity;
      for (const auto& track : tracks_) time = std::max(time, track->end_time());
      time = std::min(time, end_);
    }
    if (reverse || has_start_) {
      seek_to(time, reverse);
    } else {
      begin();
      settimeSSM(time);
    }
  }

  void seek_to(double time, bool reverse) {
    const int was_paused = gettimeSSM_is_pause();
    settimeSSM_is_pause(1);
    for (const auto& track : tracks_) {
      if (!track->seek(time, reverse)) failed_ = true;
    }
    settimeSSM(time);
    settimeSSM_is_pause(was_paused);
  }

  // Sleeps until the next record is due, at most 10 ms, or until a command comes.
  void wait(double now, bool reverse) {
    constexpr double kMaxSleepSeconds = 0.01;
    const double speed = std::fabs(gettimeSSM_speed());
    double seconds = std::fabs(first(reverse).next_time(reverse) - now) / speed;
    if (!(seconds < kMaxSleepSeconds) || gettimeSSM_is_pause()) seconds = kMaxSleepSeconds;
    const timespec sleep{0, static_cast<long>(seconds * 1e9)};
    pollfd input{STDIN_FILENO, POLLIN, 0};
    // In the background of a terminal, reading would stop the program.
    const bool reads =
        has_input_ && (!::isatty(STDIN_FILENO) || ::tcgetpgrp(STDIN_FILENO) == ::getpgrp());
    if (::ppoll(&input, reads ? 1 : 0, &sleep, nullptr) <= 0) return;
    char text[512];
    const ssize_t n = ::read(STDIN_FILENO, text, sizeof text);
    if (n <= 0) {
      has_input_ = n < 0 && errno == EINTR;
      return;
    }
    input_.append(text, static_cast<std::size_t>(n));
    for (std::size_t end; (end = input_.find('\n')) != std::string::npos && !quit_;) {
      command(input_.substr(0, end));
      input_.erase(0, end + 1);
      if (!options_.quiet && is_terminal_) std::fputs("\033[A\r\033[K", stdout);
      prompt();
    }
    if (input_.size() > sizeof text) input_.clear();  // no command is that long
  }

  void command(const std::string& line) {
    std::istringstream words(line);
    std::string verb;
    if (!(words >> verb)) return;
    double value = 0;
    const bool has_value = static_cast<bool>(words >> value) && std::isfinite(value);
    if (verb == "speed" || verb == "x") {
      if (has_value)
        settimeSSM_speed(value);
      else
        std::fprintf(stderr, "speed wants a number: speed 2\n");
    } else if (verb == "skip") {
      settimeSSM(gettimeSSM() + (has_value ? value : kStepSeconds));
    } else if (verb == "seek") {
      if (has_value)
        seek_to(gettimeSSM() + value, gettimeSSM_is_reverse() != 0);
      else
        std::fprintf(stderr, "seek wants a number of seconds: seek -5\n");
    } else if (verb == "pause" || verb == "p") {
      settimeSSM_is_pause(1);
    } else if (verb == "start" || verb == "s") {
      settimeSSM_is_pause(0);
    } else if (verb == "reverse" || verb == "r") {
      settimeSSM_is_reverse(!gettimeSSM_is_reverse());
    } else if (verb == "quit" || verb == "q") {
      quit_ = true;
    } else {
      for (const char c : line) keystroke(c);
    }
  }

  static void keystroke(char c) {
    if (c == '+') settimeSSM_speed(gettimeSSM_speed() * 1.2);
    if (c == '-') settimeSSM_speed(gettimeSSM_speed() / 1.2);
    if (c == '>') settimeSSM_is_pause(1), settimeSSM(gettimeSSM() + kStepSeconds);
  }

  void prompt() const {
    if (!options_.quiet && is_terminal_) std::fputs("> ", stdout);
    std::fflush(stdout);
  }

  // Once per second; on a terminal always in the same place, above the prompt.
  void show_status(double now) {
    const double real = gettimeSSM_real();
    if (options_.quiet || real < next_status_) return;
    next_status_ = std::floor(real) + 1;
    if (is_terminal_) std::fputs("\033[s\033[6A\r", stdout);
    const char* const erase = is_terminal_ ? "\033[K" : "";
    std::printf(
        "%s------[ %s ]-------------\n%sssm time  : %.3f\n%slog time  : %.3f\n"
        "%sspeed rate: %.3f\n",
        erase, date_of(now).c_str(), erase, now, erase, now - log_start_, erase,
        gettimeSSM_speed());
    if (is_terminal_) std::fputs("\033[u", stdout);
    std::fflush(stdout);
  }

  static constexpr double kStepSeconds = 0.1;

  const Options& options_;
  std::vector<std::unique_ptr<Track>> tracks_;
  double log_start_ = 0, start_ = 0, end_ = 0;
  bool has_start_ = false, failed_ = false, quit_ = false;
  bool has_input_ = true;
  std::string input_;
  const bool is_terminal_ = ::isatty(STDOUT_FILENO) != 0;
  double next_status_ = 0;
};

}  // namespace

int main(int argc, char** argv) {
  Options options;
  if (!parse(argc, argv, options)) return 1;
  end_on_signals();
  if (!connect()) return 1;
  Player player(options);
  if (!player.open()) return endSSM(), 1;
  const bool played = player.play();
  if (!options.quiet) std::puts("finalize log data\nssm time init");
  inittimeSSM();
  endSSM();
  if (!options.quiet) std::puts("end");
  return played ? 0 : 1;
}
