// SPDX-License-Identifier: Apache-2.0
//
// Shows a program's progress on stderr: on a terminal in one line that is updated in place,
// otherwise in separate lines, for a log file.
#pragma once

#include <unistd.h>

#include <chrono>
#include <cstdio>
#include <dssm/time.hpp>
#include <string>

namespace vehicle {

class Progress {
 public:
  // Each line begins with `program`.
  explicit Progress(const char* program)
      : program_(program), on_terminal_(::isatty(STDERR_FILENO) == 1) {}

  // Shows the result of text() at most a few times per second; cheap enough to call for each
  // sample.
  template <class Text>
  void update(Text text) {
    const dssm::MonoTime now = dssm::MonoClock::now();
    if (now < next_) return;
    next_ = now + (on_terminal_ ? std::chrono::milliseconds(200) : std::chrono::milliseconds(500));
    std::fprintf(stderr, on_terminal_ ? "\r\033[K%s: %s" : "%s: %s\n", program_, text().c_str());
    line_open_ = on_terminal_;
  }

  // Prints a line that update() does not overwrite.
  void print(const std::string& text) {
    std::fprintf(stderr, "%s%s: %s\n", line_open_ ? "\r\033[K" : "", program_, text.c_str());
    line_open_ = false;
  }

 private:
  const char* program_;
  bool on_terminal_;
  bool line_open_ = false;
  dssm::MonoTime next_{};
};

}  // namespace vehicle
