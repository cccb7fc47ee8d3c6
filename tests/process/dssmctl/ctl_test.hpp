// SPDX-License-Identifier: Apache-2.0
//
// What the tests of dssmctl share: a dssmd of their own, a session of this process to write with,
// and dssmctl run to its end or in the background.
#pragma once

#include <gtest/gtest.h>
#include <poll.h>

#include <dssm/dssm.hpp>
#include <nlohmann/json.hpp>
#include <string>
#include <string_view>
#include <thread>
#include <vector>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::test {

using Json = nlohmann::json;

constexpr std::int64_t kSecond = 1'000'000'000;  // ns

inline bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

inline std::string dssmctl_path() { return built("client/dssmctl/dssmctl"); }

// Both outputs of a program in the background, mixed, read as they come. Ends it if it still runs.
class Running {
 public:
  Running(std::vector<std::string> argv, const std::vector<std::string>& environment);
  Running(const Running&) = delete;
  Running& operator=(const Running&) = delete;
  ~Running();

  // The next line without its end; empty when there is none any more. Calls `meanwhile` over and
  // over until it comes.
  template <class Meanwhile>
  std::string line(Meanwhile meanwhile) {
    std::string line;
    while (!take_line(line)) {
      if (ended_) return {};
      meanwhile();
      read_some(1);
    }
    return line;
  }
  std::string line();
  std::string rest();  // all that comes until its end

  // Until there is output to read, and reads none of it: a program that prints more than a pipe
  // holds (64 KiB) stands still in the midst of that.
  void await_output();

  void close_output();  // our end of the pipe
  void signal(int number);
  void stop();   // SIGSTOP, and waits until it stands still
  int status();  // waits for its end
  pid_t pid() const { return pid_; }

 private:
  bool take_line(std::string& line);
  void read_some(int timeout_ms);  // -1: waits for ever
  void signal_again();             // if the one that was to end it seems lost
  pid_t pid_ = -1;
  int fd_ = -1;
  bool ended_ = false;
  int ending_ = 0;  // the signal that it was sent last to end it
  MonoTime signal_again_;
  std::string text_;
};

// Sends a signal that is to end a program of this process, and if ThreadSanitizer loses it, another
// one, until the end of this object.
class EndingSignal {
 public:
  EndingSignal(pid_t pid, int number);

 private:
  std::jthread again_;
};

// This process's session with a dssmd.
inline Session session_with(const DaemonProcess& daemon) {
  return Session::connect({.socket_path = daemon.socket_path(),
                           .program = "the test",
                           .request_timeout = std::chrono::seconds(60)})
      .value();
}

class CtlTest : public testing::Test {
 protected:
  explicit CtlTest(std::vector<std::string> dssmd_words = {})
      : daemon_(std::move(dssmd_words)), session_(session_with(daemon_)) {}

  Finished ctl(std::vector<std::string> words, const std::string& input = {});

  // What ctl() printed when it succeeds; otherwise the test fails.
  std::string output(std::vector<std::string> words);
  Json json(std::vector<std::string> words);  // with --json, one document

  // dssmctl in the background.
  std::vector<std::string> argv(std::vector<std::string> words) const;
  std::vector<std::string> environment() const { return {daemon_.environment()}; }

  DaemonProcess daemon_;
  Session session_;
};

std::vector<std::string> lines_of(const std::string& text);
std::vector<std::string> words_of(const std::string& line);
std::string text_of(const std::string& file);

// History of `depth` slots.
inline History depth_of(std::uint64_t depth) { return {depth, std::chrono::milliseconds(10)}; }

inline Time at_ns(std::int64_t ns) { return time_from_ns(ns); }

}  // namespace dssm::test
