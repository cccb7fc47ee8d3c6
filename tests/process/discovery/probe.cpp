// SPDX-License-Identifier: Apache-2.0
#include "tests/process/discovery/probe.hpp"

#include <fcntl.h>
#include <poll.h>
#include <signal.h>
#include <sys/syscall.h>
#include <unistd.h>

#include <algorithm>
#include <chrono>
#include <cstdio>
#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <sstream>
#include <utility>

#include "tests/support/daemon_process.hpp"

namespace dssm::test {
namespace {

// Far beyond what anything takes here. D-Bus's own patience is 25 s, and a record that Avahi has
// taken for the wrong host's stays for its time to live, 120 s (RFC 6762 section 10).
constexpr auto kFarTooLong = std::chrono::seconds(180);

}  // namespace

Probe::Probe(const AvahiHost& pc, int id, const std::string& name, std::vector<std::string> extra)
    : pc_(pc) {
  int in[2], out[2];
  if (::pipe2(in, O_CLOEXEC) != 0 || ::pipe2(out, O_CLOEXEC) != 0) std::abort();
  commands_.reset(in[1]);
  output_.reset(out[0]);
  std::vector<std::string> argv = {built("tests/process/discovery/mdns-probe"),
                                   std::to_string(in[0]), std::to_string(id), name, "7000"};
  argv.insert(argv.end(), extra.begin(), extra.end());
  const Inside in_pc = pc.inside();
  ::fcntl(in[0], F_SETFD, 0);  // for this child only: nothing else is started meanwhile
  pid_ = start(argv, {pc.environment()}, out[1]);
  ::close(in[0]);
  ::close(out[1]);
}

Probe::~Probe() { kill_hard(); }

void Probe::command(const std::string& line) {
  const std::string text = line + "\n";
  if (::write(commands_.get(), text.data(), text.size()) < 0) std::perror("test harness: write");
}

void Probe::finish() { commands_.reset(); }

void Probe::wait_for_end() {
  if (pid_ > 0) wait_for(std::exchange(pid_, -1));
}

void Probe::kill_hard() {
  if (pid_ > 0) ::kill(pid_, SIGKILL);
  wait_for_end();
}

bool Probe::read_line(int timeout_ms) {
  for (;;) {
    const std::size_t end = input_.find('\n');
    if (end != input_.npos) {
      const std::string line = input_.substr(0, end);
      input_.erase(0, end + 1);
      lines_.push_back(line);
      std::istringstream words(line);
      std::string kind, rest;
      int id = 0;
      words >> kind;
      if (kind == "found") {
        words >> id;
        std::getline(words >> std::ws, hosts_[id]);
      } else if (kind == "lost") {
        words >> id;
        hosts_.erase(id);
      } else if (kind == "state") {
        std::getline(words >> std::ws, state_);
      }
      return true;
    }
    pollfd fd{output_.get(), POLLIN, 0};
    if (::poll(&fd, 1, timeout_ms) <= 0) return false;
    char buffer[4096];
    const ssize_t n = ::read(output_.get(), buffer, sizeof buffer);
    if (n <= 0) return false;
    input_.append(buffer, static_cast<std::size_t>(n));
  }
}

bool Probe::until(const std::function<bool()>& so) {
  const auto deadline = std::chrono::steady_clock::now() + kFarTooLong;
  while (!so()) {
    const auto left = std::chrono::duration_cast<std::chrono::milliseconds>(
        deadline - std::chrono::steady_clock::now());
    if (left.count() > 0 && read_line(static_cast<int>(left.count()))) continue;
    std::fprintf(stderr, "what it printed:\n");
    for (const std::string& line : lines_) std::fprintf(stderr, "  %s\n", line.c_str());
    std::fprintf(stderr, "%s\n", pc_.account().c_str());
    return false;
  }
  return true;
}

bool Probe::until_state(const std::vector<std::string>& words) {
  return until([&] {
    return std::all_of(words.begin(), words.end(),
                       [this](const std::string& word) { return state_has(word); });
  });
}

bool Probe::until_found(int id, const std::string& text) {
  return until([&] { return hosts_.contains(id) && hosts_[id] == text; });
}

bool Probe::until_lost(int id) {
  return until([&] { return !hosts_.contains(id); });
}

bool Probe::until_it_waits_for_an_answer() const {
  const std::string tasks = "/proc/" + std::to_string(pid_) + "/task";
  for (int tries = 0; tries < 3000; ++tries) {
    std::error_code gone;
    for (const auto& task : std::filesystem::directory_iterator(tasks, gone)) {
      long number = -1;
      std::ifstream(task.path() / "syscall") >> number;
      if (number == SYS_poll || number == SYS_ppoll) return true;
    }
    ::usleep(10'000);
  }
  return false;
}

int Probe::most_heard() const {
  constexpr std::string_view kKey = " heard=";
  int most = 0;
  for (const std::string& line : lines_) {
    const std::size_t at = line.find(kKey);
    if (at != line.npos) most = std::max(most, std::atoi(line.c_str() + at + kKey.size()));
  }
  return most;
}

int Probe::count(const std::string& beginning) const {
  return static_cast<int>(std::count_if(lines_.begin(), lines_.end(), [&](const std::string& line) {
    return line.starts_with(beginning);
  }));
}

RawService::RawService(const AvahiHost& pc, const std::vector<std::string>& arguments) {
  int out[2];
  if (::pipe2(out, O_CLOEXEC) != 0) std::abort();
  std::vector<std::string> argv = {built("tests/process/discovery/raw-avahi")};
  argv.insert(argv.end(), arguments.begin(), arguments.end());
  {
    const Inside in_pc = pc.inside();
    pid_ = start(argv, {pc.environment()}, out[1]);
  }
  ::close(out[1]);
  pollfd fd{out[0], POLLIN, 0};
  char byte;
  constexpr int kFarTooLongMs = std::chrono::milliseconds(kFarTooLong).count();
  published_ = ::poll(&fd, 1, kFarTooLongMs) > 0 && ::read(out[0], &byte, 1) == 1;
  ::close(out[0]);
}

RawService::~RawService() {
  ::kill(pid_, SIGKILL);
  wait_for(pid_);
}

std::string raw_ask(const AvahiHost& pc, const std::string& what, const std::string& name,
                    const std::string& type) {
  const Inside in_pc = pc.inside();
  const Finished finished =
      run({"timeout", "60", built("tests/process/discovery/raw-avahi"), what, name, type},
          {pc.environment()});
  return finished.out + finished.err;
}

}  // namespace dssm::test
