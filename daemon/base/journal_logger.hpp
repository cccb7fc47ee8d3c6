// SPDX-License-Identifier: Apache-2.0
//
// The log as entries of systemd's journal, with fields that `journalctl` can search for:
//
//   MESSAGE MESSAGE_ID PRIORITY SYSLOG_IDENTIFIER   as in systemd.journal-fields(7)
//   DSSM_STREAM  the stream it is about, "lidar:0@pc1"
//   DSSM_PEER    the program or the host it is about
//
// Written to journald's datagram socket as systemd's JOURNAL_NATIVE_PROTOCOL describes, without
// waiting (sd_journal_send(3) waits for a journald that hangs). What the socket does not take goes
// to stderr, which leads to the journal by another way, without the fields.
#pragma once

#include <string>

#include "core/base/unique_fd.hpp"
#include "daemon/base/log.hpp"

namespace dssm::daemon {

class JournalLogger final : public LeveledLogger {
 public:
  static constexpr const char* kSocket = "/run/systemd/journal/socket";

  // socket: where journald listens; tests put their own in its place.
  explicit JournalLogger(LogLevel level, std::string socket = kSocket);

  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override;

 private:
  bool send(const std::string& entry) noexcept;

  std::string path_;
  UniqueFd socket_;
  StderrLogger stderr_;
};

}  // namespace dssm::daemon
