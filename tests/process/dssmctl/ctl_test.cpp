// SPDX-License-Identifier: Apache-2.0
#include "tests/process/dssmctl/ctl_test.hpp"

#include <fcntl.h>
#include <signal.h>
#include <sys/wait.h>
#include <unistd.h>

#include <fstream>
#include <sstream>

namespace dssm::test {
namespace {

// ThreadSanitizer keeps a signal that comes between two functions that it knows, to pass it on in
// the next one, and now and then forgets to (one in some 300, g++ 12). It takes no further one of
// the same number then, but another one.
#ifdef __SANITIZE_THREAD__
constexpr bool kLosesSignals = true;
#else
constexpr bool kLosesSignals = false;
#endif
constexpr int kSignalAgainMs = 2000;

int other_signal(int number) { return number == SIGINT ? SIGTERM : SIGINT; }

// Whether the child exists and has not ended.
bool runs(pid_t pid) {
  siginfo_t end{};
  return ::waitid(P_PID, static_cast<id_t>(pid), &end, WEXITED | WNOHANG | WNOWAIT) == 0 &&
         end.si_pid == 0;
}

}  // namespace

EndingSignal::EndingSignal(pid_t pid, int number) {
  ::kill(pid, number);
  if (!kLosesSignals) return;
  again_ = std::jthread([pid, number](const std::stop_token& stop) {
    int next = number;
    for (MonoTime due = deadline_in(std::chrono::milliseconds(kSignalAgainMs));
         !stop.stop_requested() && runs(pid); std::this_thread::sleep_for(kPollPause)) {
      if (MonoClock::now() < due) continue;
      ::kill(pid, next = other_signal(next));
      due = deadline_in(std::chrono::milliseconds(kSignalAgainMs));
    }
  });
}

Running::Running(std::vector<std::string> argv, const std::vector<std::string>& environment) {
  int ends[2];
  if (::pipe2(ends, O_CLOEXEC)) std::abort();
  // The shell is replaced by the program at once, so its pid is the program's.
  argv.insert(argv.begin(), {"/bin/sh", "-c", "exec \"$@\" 2>&1", "sh"});
  pid_ = start(argv, environment, ends[1]);
  ::close(ends[1]);
  fd_ = ends[0];
}

Running::~Running() {
  if (pid_ > 0) {
    ::kill(pid_, SIGKILL);
    wait_for(pid_);
  }
  close_output();
}

bool Running::take_line(std::string& line) {
  const std::size_t end = text_.find('\n');
  if (end == std::string::npos) return false;
  line = text_.substr(0, end);
  text_.erase(0, end + 1);
  return true;
}

void Running::signal_again() {
  if (MonoClock::now() >= signal_again_) signal(other_signal(ending_));
}

void Running::read_some(int timeout_ms) {
  if (kLosesSignals && ending_ != 0) {
    signal_again();
    if (timeout_ms < 0) timeout_ms = kSignalAgainMs;
  }
  pollfd fd{fd_, POLLIN, 0};
  if (::poll(&fd, 1, timeout_ms) <= 0) return;
  char buffer[65536];
  const ssize_t got = ::read(fd_, buffer, sizeof buffer);
  if (got > 0) {
    text_.append(buffer, static_cast<std::size_t>(got));
  } else {
    ended_ = true;
  }
}

std::string Running::line() {
  std::string line;
  while (!take_line(line)) {
    if (ended_) return {};
    read_some(-1);
  }
  return line;
}

std::string Running::rest() {
  while (!ended_) read_some(-1);
  return std::exchange(text_, {});
}

void Running::await_output() {
  pollfd fd{fd_, POLLIN, 0};
  ASSERT_EQ(::poll(&fd, 1, -1), 1);
}

void Running::close_output() {
  if (fd_ >= 0) ::close(std::exchange(fd_, -1));
}

void Running::signal(int number) {
  if (number == SIGINT || number == SIGTERM) {
    ending_ = number;
    signal_again_ = deadline_in(std::chrono::milliseconds(kSignalAgainMs));
  }
  ::kill(pid_, number);
}

void Running::stop() {
  signal(SIGSTOP);
  int status = 0;
  ASSERT_EQ(::waitpid(pid_, &status, WUNTRACED), pid_);
  ASSERT_TRUE(WIFSTOPPED(status));
}

int Running::status() {
  while (kLosesSignals && ending_ != 0 && runs(pid_)) {
    signal_again();
    std::this_thread::sleep_for(kPollPause);
  }
  return wait_for(std::exchange(pid_, -1));
}

std::vector<std::string> CtlTest::argv(std::vector<std::string> words) const {
  words.insert(words.begin(), dssmctl_path());
  return words;
}

Finished CtlTest::ctl(std::vector<std::string> words, const std::string& input) {
  return run(argv(std::move(words)), environment(), input);
}

std::string CtlTest::output(std::vector<std::string> words) {
  const Finished finished = ctl(std::move(words));
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
  EXPECT_EQ(finished.err, "");
  return finished.out;
}

Json CtlTest::json(std::vector<std::string> words) {
  words.push_back("--json");
  const std::string text = output(std::move(words));
  Json parsed = Json::parse(text, nullptr, false);
  EXPECT_FALSE(parsed.is_discarded()) << text;
  return parsed;
}

std::vector<std::string> lines_of(const std::string& text) {
  std::vector<std::string> lines;
  std::istringstream stream(text);
  for (std::string line; std::getline(stream, line);) lines.push_back(line);
  return lines;
}

std::vector<std::string> words_of(const std::string& line) {
  std::istringstream stream(line);
  return {std::istream_iterator<std::string>(stream), {}};
}

std::string text_of(const std::string& file) {
  std::ostringstream text;
  text << std::ifstream(file).rdbuf();
  return text.str();
}

}  // namespace dssm::test
