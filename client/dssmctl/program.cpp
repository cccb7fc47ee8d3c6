// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/program.hpp"

#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <spawn.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>

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
    const std::size_t room = kMaxProgramOutput - text.size();
    text.append(buffer.data(), std::min(room, static_cast<std::size_t>(got)));
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

}  // namespace dssm::ctl
