// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/log.hpp"

#include <poll.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <string>

#include "core/base/text.hpp"

namespace dssm::daemon {
namespace {

std::string_view level_word(LogLevel level) noexcept {
  switch (level) {
    case LogLevel::error:
      return "error: ";
    case LogLevel::warning:
      return "warning: ";
    case LogLevel::debug:
      return "debug: ";
    case LogLevel::notice:
    case LogLevel::info:
      return "";
  }
  return "";
}

// A pipe or socket that polls writable takes up to PIPE_BUF bytes without waiting.
bool takes_a_line() noexcept {
  pollfd fd{STDERR_FILENO, POLLOUT, 0};
  return ::poll(&fd, 1, 0) == 1 && (fd.revents & POLLOUT);
}

}  // namespace

void StderrLogger::write(LogLevel level, std::string_view text, const LogFields& fields) noexcept {
  if (leaves_out(level)) return;
  constexpr std::size_t kMaxLineBytes = 4096;  // PIPE_BUF: such a line is written as a whole
  if (!takes_a_line()) {
    ++left_out_;
    return;
  }
  std::string line;
  if (journal_prefix_) {
    line.append("<").append(std::to_string(static_cast<int>(level))).append(">");
  } else {
    line.append("dssmd: ").append(level_word(level));
  }
  line += printable(text);
  if (!fields.peer.empty()) line.append(" [client ").append(printable(fields.peer)).append("]");
  if (left_out_ > 0) line += " (" + std::to_string(left_out_) + " lines before this one are lost)";
  left_out_ = 0;
  line.resize(std::min(line.size(), kMaxLineBytes - 1));
  line += '\n';
  // A failure of stderr itself cannot be reported anywhere.
  [[maybe_unused]] const ssize_t written = ::write(STDERR_FILENO, line.data(), line.size());
}

// Compared, because programs that a service starts inherit the variable, but not always stderr.
bool stderr_is_journal() noexcept {
  const char* stream = std::getenv("JOURNAL_STREAM");  // NOLINT(concurrency-mt-unsafe): one thread
  struct stat file {};
  if (!stream || ::fstat(STDERR_FILENO, &file)) return false;
  return stream == std::to_string(file.st_dev) + ":" + std::to_string(file.st_ino);
}

}  // namespace dssm::daemon
