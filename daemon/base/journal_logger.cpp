// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/journal_logger.hpp"

#include <sys/socket.h>
#include <sys/un.h>

#include <cstring>
#include <utility>

#include "core/base/text.hpp"

namespace dssm::daemon {
namespace {

// An entry longer than the socket's buffer would have to go by a file; no message of dssmd is.
constexpr std::size_t kMaxMessageBytes = 16 << 10;

// printable(): a line break would begin another field.
void add_field(std::string& entry, std::string_view name, std::string_view value) {
  if (value.empty()) return;
  entry.append(name).append("=").append(printable(value.substr(0, kMaxMessageBytes))).append("\n");
}

}  // namespace

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

}  // namespace dssm::daemon
