// SPDX-License-Identifier: Apache-2.0
//
// The facts of `dssmctl doctor`, from dssmd, the kernel, systemctl and chronyc.
#include <fcntl.h>
#include <fmt/format.h>
#include <grp.h>
#include <poll.h>
#include <pwd.h>
#include <signal.h>
#include <spawn.h>
#include <sys/stat.h>
#include <sys/statvfs.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <cstdlib>
#include <fstream>
#include <sstream>

#include "client/dssmctl/doctor.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

constexpr int kNotExecuted = 127;  // posix_spawn(3)

// Starts it with both outputs at `out_fd`; -1 when there is no such program.
pid_t spawn(std::vector<std::string>& argv, int out_fd) {
  std::vector<char*> words;
  words.reserve(argv.size() + 1);
  for (std::string& word : argv) words.push_back(word.data());
  words.push_back(nullptr);
  posix_spawn_file_actions_t actions;
  ::posix_spawn_file_actions_init(&actions);
  ::posix_spawn_file_actions_addopen(&actions, STDIN_FILENO, "/dev/null", O_RDONLY, 0);
  ::posix_spawn_file_actions_adddup2(&actions, out_fd, STDOUT_FILENO);
  ::posix_spawn_file_actions_adddup2(&actions, out_fd, STDERR_FILENO);
  pid_t pid = -1;
  const int failed = ::posix_spawnp(&pid, words[0], &actions, nullptr, words.data(), environ);
  ::posix_spawn_file_actions_destroy(&actions);
  return failed ? -1 : pid;
}

// Waits for something to read, or for a program's end. Whether that came before `deadline`.
bool await(int fd, MonoTime deadline) {
  while (true) {
    const auto left =
        std::chrono::ceil<std::chrono::milliseconds>(deadline - MonoClock::now()).count();
    if (left <= 0) return false;
    pollfd wanted{fd, POLLIN, 0};
    if (::poll(&wanted, 1, static_cast<int>(std::min<std::int64_t>(left, 60'000))) > 0) return true;
  }
}

// Reads until the program closes its outputs. Whether it did so before `deadline`.
bool read_all(int fd, MonoTime deadline, std::string& text) {
  std::array<char, 4096> buffer;
  while (await(fd, deadline)) {
    const ssize_t got = ::read(fd, buffer.data(), buffer.size());
    if (got == 0 || (got < 0 && errno != EINTR)) return true;
    if (got < 0) continue;
    const std::size_t rest = kMaxProgramOutput - text.size();
    text.append(buffer.data(), std::min(rest, static_cast<std::size_t>(got)));
  }
  return false;
}

}  // namespace

std::optional<ProgramEnd> run_program(std::vector<std::string> argv, Duration timeout) {
  std::array<int, 2> ends{};
  if (::pipe2(ends.data(), O_CLOEXEC)) return std::nullopt;
  const pid_t pid = spawn(argv, ends[1]);
  ::close(ends[1]);
  ProgramEnd end;
  if (pid > 0) {
    const MonoTime deadline = deadline_in(timeout);
    // A program closes its outputs before it has an exit status.
    // By number: glibc 2.36 declares pidfd_open() without C linkage.
    const int ended = static_cast<int>(::syscall(SYS_pidfd_open, pid, 0));
    end.in_time = read_all(ends[0], deadline, end.output) && await(ended, deadline);
    if (ended >= 0) ::close(ended);
    if (!end.in_time) ::kill(pid, SIGKILL);
    int status = 0;
    while (::waitpid(pid, &status, 0) < 0 && errno == EINTR) {
    }
    if (WIFEXITED(status)) end.exit_status = WEXITSTATUS(status);
  }
  ::close(ends[0]);
  // POSIX lets a spawn that cannot execute the program succeed, and end with that status.
  if (pid <= 0 || end.exit_status == kNotExecuted) return std::nullopt;
  return end;
}

namespace {

constexpr Duration kProgramTimeout = std::chrono::seconds(3);
constexpr std::size_t kMaxFileBytes = 64U << 10;   // of a file in /proc
constexpr std::size_t kMaxEntryBytes = 64U << 10;  // of a user or group in the system's lists
constexpr std::size_t kMaxChronyWords = 200;       // of what chronyc prints when something is wrong
constexpr const char* kDefaultSocket = "/run/dssm/dssmd.sock";

std::string user_name() {
  std::string buffer(kMaxEntryBytes, '\0');
  passwd entry{}, *found = nullptr;
  if (::getpwuid_r(::geteuid(), &entry, buffer.data(), buffer.size(), &found) || !found) {
    return std::to_string(::geteuid());
  }
  return found->pw_name;
}

std::string group_name(gid_t gid) {
  std::string buffer(kMaxEntryBytes, '\0');
  group entry{}, *found = nullptr;
  if (::getgrgid_r(gid, &entry, buffer.data(), buffer.size(), &found) || !found) {
    return std::to_string(gid);
  }
  return found->gr_name;
}

bool lists_group(const std::string& user, gid_t gid) {
  std::vector<gid_t> groups(1024);
  int count = static_cast<int>(groups.size());
  const bool complete = ::getgrouplist(user.c_str(), ::getegid(), groups.data(), &count) >= 0;
  groups.resize(complete ? static_cast<std::size_t>(count) : groups.size());
  return std::find(groups.begin(), groups.end(), gid) != groups.end();
}

bool process_has_group(gid_t gid) {
  if (::getegid() == gid) return true;
  std::vector<gid_t> groups(static_cast<std::size_t>(std::max(0, ::getgroups(0, nullptr))));
  const int count = ::getgroups(static_cast<int>(groups.size()), groups.data());
  groups.resize(static_cast<std::size_t>(std::max(0, count)));
  return std::find(groups.begin(), groups.end(), gid) != groups.end();
}

SocketFacts socket_facts(const CommonOptions& options, const std::string& user) {
  SocketFacts facts;
  const char* given = std::getenv("DSSM_SOCKET");  // NOLINT(concurrency-mt-unsafe): one thread
  facts.path = !options.socket_path.empty() ? options.socket_path
               : given && *given            ? given
                                            : kDefaultSocket;
  facts.chosen = facts.path != kDefaultSocket;
  struct stat status {};
  if (::stat(facts.path.c_str(), &status)) {
    facts.kind = errno == EACCES ? SocketFacts::Kind::hidden : SocketFacts::Kind::missing;
    return facts;
  }
  facts.kind =
      S_ISSOCK(status.st_mode) ? SocketFacts::Kind::socket : SocketFacts::Kind::something_else;
  facts.group = group_name(status.st_gid);
  facts.user_in_group = lists_group(user, status.st_gid);
  facts.process_in_group = process_has_group(status.st_gid);
  return facts;
}

std::string file_text(const std::string& path) {
  std::ifstream file(path);
  std::string text(kMaxFileBytes, '\0');
  file.read(text.data(), static_cast<std::streamsize>(text.size()));
  text.resize(static_cast<std::size_t>(std::max<std::streamsize>(0, file.gcount())));
  return text;
}

MemoryFacts memory_facts() {
  MemoryFacts facts;
  std::istringstream lines(file_text("/proc/meminfo"));
  for (std::string line; std::getline(lines, line);) {
    std::istringstream words(line);
    std::string key;
    std::uint64_t kibibytes = 0;
    if (!(words >> key >> kibibytes)) continue;
    if (key == "MemTotal:") facts.total_bytes = kibibytes << 10;
    if (key == "MemAvailable:") facts.available_bytes = kibibytes << 10;
  }
  return facts;
}

std::vector<DiskFacts> disk_facts() {
  std::vector<DiskFacts> disks;
  for (const char* path : {"/", "/run"}) {
    struct statvfs status {};
    if (::statvfs(path, &status)) continue;
    disks.push_back({path, static_cast<std::uint64_t>(status.f_blocks) * status.f_frsize,
                     static_cast<std::uint64_t>(status.f_bavail) * status.f_frsize});
  }
  return disks;
}

ClockFacts clock_facts() {
  const auto end = run_program({"chronyc", "-c", "tracking"}, kProgramTimeout);
  if (!end) return {};
  if (!end->in_time) return {ClockFacts::State::no_answer, "chronyc did not end", false};
  return clock_facts_untrusted(end->exit_status, end->output);
}

// "active", "inactive", "failed"; empty where there is no systemd to ask.
std::string service_state() {
  const auto end = run_program({"systemctl", "is-active", "dssmd"}, kProgramTimeout);
  if (!end || !end->in_time) return {};
  for (const char* known : {"active", "activating", "inactive", "failed"}) {
    if (end->output == fmt::format("{}\n", known)) return known;
  }
  return {};
}

bool exists(const char* path) {
  struct stat status {};
  return ::stat(path, &status) == 0;
}

template <class T>
bool take(Result<T> answer, T& into, std::optional<Error>& failed) {
  if (!answer) {
    failed = std::move(answer).error();
    return false;
  }
  into = *std::move(answer);
  return true;
}

void ask_dssmd(const CommonOptions& options, Facts& facts) {
  Result<Session> session = connect(options);
  if (!session) {
    facts.failed = std::move(session).error();
    return;
  }
  take(session->daemon_info(), facts.daemon, facts.failed) &&
      take(session->list_hosts(), facts.hosts, facts.failed) &&
      take(session->list_streams(), facts.streams, facts.failed);
}

}  // namespace

ClockFacts clock_facts_untrusted(int exit_status, const std::string& output) {
  // Address and name of the source, stratum, ten numbers, and whether it is synchronized.
  constexpr std::size_t kFields = 14, kName = 1, kLeap = 13;
  const std::string line = output.substr(0, output.find('\n'));
  std::vector<std::string> fields;
  std::istringstream stream(line);
  for (std::string field; std::getline(stream, field, ',');) fields.push_back(field);
  if (exit_status != 0 || fields.size() != kFields) {
    return {ClockFacts::State::no_answer, line.substr(0, kMaxChronyWords), false};
  }
  const std::string& leap = fields[kLeap];
  const bool synchronized = leap == "Normal" || leap == "Insert second" || leap == "Delete second";
  return {synchronized ? ClockFacts::State::synchronized : ClockFacts::State::unsynchronized,
          synchronized ? fields[kName] : leap, false};
}

std::uint64_t soft_limit_untrusted(const std::string& limits) {
  constexpr std::string_view kKey = "Max open files";
  const std::size_t at = limits.find(kKey);
  if (at == std::string::npos) return 0;
  std::istringstream words(limits.substr(at + kKey.size()));
  std::uint64_t limit = 0;
  return words >> limit ? limit : 0;
}

Facts collect_facts(const CommonOptions& options) {
  Facts facts;
  facts.user = user_name();
  facts.version = DSSM_VERSION;
  facts.systemd = exists("/run/systemd/system");
  facts.socket = socket_facts(options, facts.user);
  ask_dssmd(options, facts);
  if (facts.failed && !facts.socket.chosen) facts.service = service_state();
  if (!facts.failed) {
    facts.descriptors.soft_limit =
        soft_limit_untrusted(file_text(fmt::format("/proc/{}/limits", facts.daemon.pid)));
  }
  facts.memory = memory_facts();
  facts.avahi_installed = exists("/usr/sbin/avahi-daemon");
  facts.avahi_running = exists("/run/avahi-daemon/pid");
  facts.clock = clock_facts();
  facts.clock.serves = exists("/etc/systemd/system/dssm-clock-server.service");
  facts.disks = disk_facts();
  return facts;
}

}  // namespace dssm::ctl
