// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/lockstep.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <linux/futex.h>
#include <poll.h>
#include <signal.h>
#include <spawn.h>
#include <sys/eventfd.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <climits>
#include <cstdlib>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <optional>
#include <set>
#include <string_view>

#include "client/dssmctl/text.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// What programs that poll have to call instead.
constexpr std::string_view kWaysToWait =
    "a read that waits (in SSM: setBlocking(true) before readNext()), usleepSSM() or "
    "PlaybackClock::sleep_until(), in place of usleep()";

using clock::LockstepPage;
using clock::LockstepPlace;

// How often the thread went to sleep, if it sleeps now, or has ended (0). Empty: it runs, or waits
// for a disk, or is stopped.
std::optional<std::uint64_t> sleep_count(pid_t process, const std::string& thread) {
  std::ifstream file(fmt::format("/proc/{}/task/{}/status", process, thread));
  constexpr std::string_view kState = "State:\t", kSwitches = "voluntary_ctxt_switches:\t";
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with(kState)) {
      const char state = line.size() > kState.size() ? line[kState.size()] : 'X';
      if (state == 'Z' || state == 'X') return 0;
      if (state != 'S' && state != 'I') return std::nullopt;
    } else if (line.starts_with(kSwitches)) {
      return std::strtoull(line.c_str() + kSwitches.size(), nullptr, 10);
    }
  }
  return 0;
}

// The sum for all threads of `processes` but `except`; empty: one of them does not sleep.
std::optional<std::uint64_t> sleep_count_of_all(const std::set<pid_t>& processes,
                                                const std::set<pid_t>& except) {
  std::uint64_t sum = 0;
  for (const pid_t process : processes) {
    std::error_code error;
    for (const auto& entry :
         std::filesystem::directory_iterator(fmt::format("/proc/{}/task", process), error)) {
      const std::string thread = entry.path().filename();
      if (except.contains(std::atoi(thread.c_str()))) continue;
      const auto count = sleep_count(process, thread);
      if (!count) return std::nullopt;
      sum += *count;
    }
  }
  return sum;
}

// Whether there is a moment at which all these threads sleep. One that is asked early may be woken
// by one that is asked late: none may have slept again, or ended, until it is asked again.
bool are_all_asleep(const std::set<pid_t>& processes, const std::set<pid_t>& except) {
  const auto count = sleep_count_of_all(processes, except);
  return count && sleep_count_of_all(processes, except) == count;
}

// What a shell started, without an interactive one's jobs.
std::set<pid_t> processes_of_group(pid_t group) {
  std::set<pid_t> processes;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator("/proc", error)) {
    const pid_t process = std::atoi(entry.path().filename().c_str());
    if (process > 0 && ::getpgid(process) == group) processes.insert(process);
  }
  return processes;
}

std::string end_text(int status) {
  if (WIFSIGNALED(status)) {
    return fmt::format("was ended by signal {} ({})", WTERMSIG(status),
                       ::sigdescr_np(WTERMSIG(status)));
  }
  return fmt::format("ended with status {}", WEXITSTATUS(status));
}

// As programs end by SIGINT: with or without a handler, or as a shell says it.
bool is_end_by_interrupt(int status) {
  return (WIFSIGNALED(status) && WTERMSIG(status) == SIGINT) ||
         (WIFEXITED(status) && (WEXITSTATUS(status) == 0 || WEXITSTATUS(status) == 128 + SIGINT));
}

void wake(LockstepPlace& place) {
  ::syscall(SYS_futex, &place.state, FUTEX_WAKE, INT_MAX, nullptr, nullptr, 0);
}

}  // namespace

Result<std::unique_ptr<Lockstep>> Lockstep::start(const std::vector<std::string>& commands,
                                                  const std::string& socket_path, Time begin,
                                                  Output& out) {
  std::unique_ptr<Lockstep> lockstep(new Lockstep(out));
  lockstep->bell_.reset(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
  if (!lockstep->bell_) return os_error("create an eventfd for programs in lockstep");
  for (const std::string& command : commands) {
    DSSM_TRY(lockstep->start_program(command, socket_path, begin));
  }
  return lockstep;
}

Result<void> Lockstep::start_program(const std::string& command, const std::string& socket_path,
                                     Time begin) {
  auto program = std::make_unique<Program>();
  program->command = command;
  program->memory = DSSM_TRY(create_sealed_memory("dssm-lockstep", LockstepPage::kBytes, 0600));
  program->mapping = DSSM_TRY(SharedMapping::map_sealed_untrusted(
      program->memory.get(), LockstepPage::kBytes, "lockstep page"));
  LockstepPage& page = program->page();
  page.player = ::getpid();
  page.now_ns = to_ns(begin);
  page.layout_version = LockstepPage::kLayoutVersion;
  page.magic = LockstepPage::kMagic;

  std::vector<std::string> variables;
  const std::string lockstep = fmt::format("{}=", LockstepPage::kVariable);
  for (char** variable = environ; *variable; ++variable) {
    const bool is_replaced =
        std::string_view(*variable).starts_with(lockstep) ||
        (!socket_path.empty() && std::string_view(*variable).starts_with("DSSM_SOCKET="));
    if (!is_replaced) variables.emplace_back(*variable);
  }
  variables.push_back(fmt::format("{}{},{}", lockstep, program->memory.get(), bell_.get()));
  if (!socket_path.empty()) variables.push_back("DSSM_SOCKET=" + socket_path);
  std::vector<char*> environment;
  environment.reserve(variables.size() + 1);
  for (std::string& variable : variables) environment.push_back(variable.data());
  environment.push_back(nullptr);

  posix_spawn_file_actions_t actions;
  ::posix_spawn_file_actions_init(&actions);
  ::posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  // To itself: the new program keeps it.
  ::posix_spawn_file_actions_adddup2(&actions, program->memory.get(), program->memory.get());
  ::posix_spawn_file_actions_adddup2(&actions, bell_.get(), bell_.get());
  posix_spawnattr_t attributes;
  ::posix_spawnattr_init(&attributes);
  // A group of its own: a shell's programs get the signals, too, and Ctrl-C ends them in order.
  ::posix_spawnattr_setflags(&attributes, POSIX_SPAWN_SETPGROUP);
  std::string shell = "sh", option = "-c", text = command;
  char* const words[] = {shell.data(), option.data(), text.data(), nullptr};
  const int failed =
      ::posix_spawn(&program->process, "/bin/sh", &actions, &attributes, words, environment.data());
  ::posix_spawnattr_destroy(&attributes);
  ::posix_spawn_file_actions_destroy(&actions);
  if (failed) return os_error(fmt::format("start '{}'", escaped(command)), failed);
  program->runs = true;
  programs_.push_back(std::move(program));
  return {};
}

Lockstep::~Lockstep() {
  for (const int number : {SIGINT, SIGTERM, SIGKILL}) {
    signal_all(number);
    if (await_ends()) return;
  }
}

void Lockstep::signal_all(int number) {
  for (const auto& program : programs_) {
    program->page().ended = 1;
    for (LockstepPlace& place : program->page().places) {
      std::uint32_t waiting = LockstepPlace::waiting;
      if (place.state.compare_exchange_strong(waiting, LockstepPlace::running)) wake(place);
    }
    if (program->runs) ::kill(-program->process, number);
  }
}

bool Lockstep::await_ends() {
  const MonoTime deadline = deadline_in(kEndTime);
  for (;;) {
    bool is_any = false;
    for (const auto& program : programs_) {
      if (program->runs && ::waitpid(program->process, &program->status, WNOHANG) != 0) {
        program->runs = false;
        // What a shell has left: its programs in the background ignore SIGINT.
        ::kill(-program->process, SIGTERM);
      }
      is_any |= program->runs;
    }
    if (!is_any) return true;
    if (MonoClock::now() >= deadline) return false;
    const timespec pause = timespec_of(std::chrono::milliseconds(5));
    ::nanosleep(&pause, nullptr);
  }
}

Result<void> Lockstep::finish() {
  DSSM_TRY(check_ends());
  std::vector<Program*> running;
  for (const auto& program : programs_) {
    if (program->runs) running.push_back(program.get());
  }
  signal_all(SIGINT);
  const bool ended = await_ends();
  for (Program* const program : running) {
    if (program->runs || is_end_by_interrupt(program->status)) continue;
    return Error{Errc::unavailable,
                 fmt::format("'{}' {}", escaped(program->command), end_text(program->status))};
  }
  if (!ended) {
    out_.clear_line();
    print_error("dssmctl: play: a program does not end by SIGINT, and is ended by SIGTERM\n");
  }
  return {};
}

Result<bool> Lockstep::check_ends() {
  bool is_any = false;
  for (const auto& program : programs_) {
    if (program->runs && ::waitpid(program->process, &program->status, WNOHANG) != 0) {
      program->runs = false;
      if (program->status != 0) {
        return Error{Errc::unavailable,
                     fmt::format("'{}' {}", escaped(program->command), end_text(program->status))};
      }
    }
    is_any |= program->runs;
  }
  return is_any;
}

bool Lockstep::pause(Duration time) {
  pollfd ring{bell_.get(), POLLIN, 0};
  const timespec timeout = timespec_of(time);
  if (::ppoll(&ring, 1, &timeout, nullptr) > 0) {
    std::uint64_t rings = 0;
    [[maybe_unused]] const ssize_t got = ::read(bell_.get(), &rings, sizeof rings);
  }
  return !stop_requested();
}

std::uint64_t Lockstep::turns_taken(const Program& program) noexcept {
  std::uint64_t turns = 0;
  for (const LockstepPlace& place : program.page().places) turns += place.taken.load();
  return turns;
}

bool Lockstep::is_waiting(Program& program, bool with_all_threads, bool accept_elsewhere) {
  LockstepPage& page = program.page();
  const std::uint64_t turns = turns_taken(program);
  const std::uint32_t begun = page.requests_begun.load();
  const std::uint32_t open_requests = begun - page.requests_ended.load();
  if (accept_elsewhere) program.lost_requests = open_requests;  // of a process that was killed
  if (open_requests != program.lost_requests) return false;
  std::set<pid_t> processes, waiting;
  for (LockstepPlace& place : page.places) {
    const std::uint32_t state = place.state.load();
    if (state == LockstepPlace::unused) continue;
    const pid_t process = place.process.load(), thread = place.thread.load();
    processes.insert(process);
    if (state == LockstepPlace::waiting) {
      program.elsewhere.erase(thread);
      waiting.insert(thread);
      continue;
    }
    const bool counts = accept_elsewhere || program.elsewhere.contains(thread);
    if (!counts || !sleep_count(process, std::to_string(thread))) return false;
    if (place.state.load() == LockstepPlace::waiting) continue;  // by now
    if (::kill(process, 0) != 0 && errno == ESRCH) {
      place.state = LockstepPlace::unused;  // it was killed
    } else {
      program.elsewhere.insert(thread);
      if (!std::exchange(noticed_elsewhere_, true)) {
        out_.clear_line();
        print_error(fmt::format(
            "dssmctl: play: '{}' has a thread that sleeps outside of DSSM for {} s: what it does "
            "is not in a fixed order\n",
            escaped(program.command),
            std::chrono::duration_cast<std::chrono::seconds>(kElsewhere).count()));
      }
    }
  }
  program.processes.insert(processes.begin(), processes.end());
  if (processes.empty()) {
    // It has closed its streams, and may be about to end, or to open others. A shell ends after
    // all that it started.
    std::set<pid_t> all = processes_of_group(program.process);
    all.insert(program.processes.begin(), program.processes.end());
    return are_all_asleep(all, {});
  }
  if (!with_all_threads) return true;
  if (!are_all_asleep(processes, waiting)) return false;
  // None of them did anything while the others were asked.
  const auto is_there = [&](const LockstepPlace& place) {
    return place.state.load() == LockstepPlace::waiting || !waiting.contains(place.thread.load());
  };
  return std::all_of(std::begin(page.places), std::end(page.places), is_there) &&
         turns_taken(program) == turns && (accept_elsewhere || page.requests_begun.load() == begun);
}

Result<bool> Lockstep::await(Program& program, bool with_all_threads) {
  const MonoTime begin = MonoClock::now();
  std::uint64_t turns = turns_taken(program);
  MonoTime unchanged_since = begin;
  while (program.runs) {
    const MonoTime now = MonoClock::now();
    if (const std::uint64_t taken = turns_taken(program); taken != turns) {
      turns = taken;
      unchanged_since = now;
    }
    if (is_waiting(program, with_all_threads, now - unchanged_since >= kElsewhere)) {
      if (!program.page().too_many.load()) return true;
      return Error{Errc::limit_exceeded,
                   fmt::format("'{}' waits in more than {} threads", escaped(program.command),
                               LockstepPage::kPlaces)};
    }
    // Threads without a place ring no bell when they fall asleep.
    const Duration waited = now - begin;
    constexpr Duration kShort = std::chrono::microseconds(50);
    if (!pause(std::clamp<Duration>(waited / 4, kShort, std::chrono::milliseconds(20)))) {
      return false;
    }
    if (waited > std::chrono::milliseconds(1)) DSSM_TRY(check_ends());
  }
  return true;
}

Result<bool> Lockstep::await_start() {
  const MonoTime begin = MonoClock::now();
  bool noticed = false;
  for (const auto& program : programs_) {
    // Until it has waited for a while, and nothing has changed.
    MonoTime quiet_since = kNever, unchanged_since = MonoClock::now();
    std::uint64_t turns = 0;
    while (program->runs) {
      if (!DSSM_TRY(check_ends())) return false;
      const MonoTime now = MonoClock::now();
      const bool waits =
          std::any_of(std::begin(program->page().places), std::end(program->page().places),
                      [](const LockstepPlace& place) {
                        return place.state.load() == LockstepPlace::waiting;
                      }) &&
          is_waiting(*program, true, now - unchanged_since > kElsewhere + kStartQuiet);
      const std::uint64_t taken = turns_taken(*program);
      if (taken != turns) unchanged_since = now;
      if (!waits || taken != turns) {
        quiet_since = kNever;
        turns = taken;
      }
      if (waits && quiet_since == kNever) quiet_since = now;
      if (waits && now - quiet_since >= kStartQuiet) break;
      if (now - begin > kMaxStartTime) {
        return Error{Errc::unavailable,
                     fmt::format("'{}' waits neither for a sample nor by the playback clock; "
                                 "lockstep needs that: {}",
                                 escaped(program->command), kWaysToWait)};
      }
      if (!noticed && now - begin > kStartNotice) {
        noticed = true;
        out_.clear_line();
        print_error(fmt::format("dssmctl: play: waiting until '{}' waits for samples: {}\n",
                                escaped(program->command), kWaysToWait));
      }
      if (!pause(std::chrono::milliseconds(20))) return false;
    }
  }
  return settle();
}

Result<bool> Lockstep::settle() {
  for (bool is_any_taken = true; is_any_taken;) {
    is_any_taken = false;
    for (const auto& program : programs_) {
      if (!program->runs) continue;
      for (LockstepPlace& place : program->page().places) {
        const std::uint32_t taken = place.taken.load();
        std::uint32_t waiting = LockstepPlace::waiting;
        if (!place.state.compare_exchange_strong(waiting, LockstepPlace::running)) continue;
        wake(place);
        if (!DSSM_TRY(await(*program, false))) return false;
        if (place.taken.load() == taken) continue;
        is_any_taken = true;
        // It may have given work to other threads.
        if (!DSSM_TRY(await(*program, true))) return false;
      }
      if (!program->runs && !DSSM_TRY(check_ends())) return false;
    }
  }
  return check_ends();
}

Result<bool> Lockstep::advance(Time time, const std::function<void(Time)>& set_clock) {
  for (;;) {
    std::int64_t next_ns = to_ns(time);
    bool is_late = false;  // a thread wakes up before that
    for (const auto& program : programs_) {
      if (!program->runs) continue;
      for (const LockstepPlace& place : program->page().places) {
        if (place.state.load() != LockstepPlace::waiting) continue;
        const std::int64_t until_ns = place.until_ns.load();
        if (until_ns > next_ns) continue;
        next_ns = until_ns;
        is_late = true;
      }
    }
    bool is_new = false;
    for (const auto& program : programs_) {
      const std::int64_t now_ns = program->page().now_ns.load();
      is_new |= next_ns > now_ns;
      program->page().now_ns.store(std::max(next_ns, now_ns));
    }
    if (is_new) set_clock(time_from_ns(next_ns));
    if (!is_late) return true;
    if (!DSSM_TRY(settle())) return false;
  }
}

}  // namespace dssm::ctl
