// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/log.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/stat.h>
#include <sys/un.h>
#include <unistd.h>

#include <algorithm>
#include <cstdlib>
#include <cstring>
#include <string>
#include <utility>

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

// An entry longer than the socket's buffer would have to go by a file; no message of dssmd is.
constexpr std::size_t kMaxFieldBytes = 16 << 10;

// printable(): a line break would begin another field.
void add_field(std::string& entry, std::string_view name, std::string_view value) {
  if (value.empty()) return;
  entry.append(name).append("=").append(printable(value.substr(0, kMaxFieldBytes))).append("\n");
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
  if (!fields.peer.empty()) line.append(" [peer ").append(printable(fields.peer)).append("]");
  if (left_out_ > 0) line += fmt::format(" ({} lines before this one are lost)", left_out_);
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
  return stream == fmt::format("{}:{}", file.st_dev, file.st_ino);
}

JournalLogger::JournalLogger(LogLevel level, std::string socket)
    : LeveledLogger(level), path_(std::move(socket)), stderr_(LogLevel::debug, true) {}

void JournalLogger::write(LogLevel level, std::string_view text, const LogFields& fields) noexcept {
  if (leaves_out(level)) return;
  std::string entry;
  add_field(entry, "MESSAGE", text);
  add_field(entry, "PRIORITY", std::to_string(static_cast<int>(level)));
  add_field(entry, "SYSLOG_IDENTIFIER", "dssmd");
  add_field(entry, "MESSAGE_ID", fields.message_id);
  add_field(entry, "DSSM_STREAM", fields.stream);
  add_field(entry, "DSSM_PEER", fields.peer);
  if (!send(entry)) stderr_.write(level, text, fields);
}

// Addressed each time: a journald that was restarted has another socket at the same place.
bool JournalLogger::send(const std::string& entry) noexcept {
  sockaddr_un address{};
  address.sun_family = AF_UNIX;
  if (path_.size() >= sizeof address.sun_path) return false;
  std::memcpy(address.sun_path, path_.data(), path_.size());
  if (!socket_) {
    socket_.reset(::socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC | SOCK_NONBLOCK, 0));
  }
  return ::sendto(socket_.get(), entry.data(), entry.size(), MSG_NOSIGNAL,
                  reinterpret_cast<const sockaddr*>(&address), sizeof address) >= 0;
}

void RateLimitedLogger::write(LogLevel level, std::string_view text,
                              const LogFields& fields) noexcept {
  const auto lines = limiters_[static_cast<std::size_t>(level)].admit(now_());
  if (!lines) return;
  if (*lines == 1) return to_.write(level, text, fields);
  to_.write(level,
            fmt::format("{} ({} such lines before this one were left out)", text, *lines - 1),
            fields);
}

}  // namespace dssm::daemon
