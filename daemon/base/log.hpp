// SPDX-License-Identifier: Apache-2.0
//
// What dssmd reports to its operator. The rest of the daemon knows only Logger; where the entries
// go is decided in main(). A function either logs or returns a failure, so lines appear where dssmd
// gives something up.
#pragma once

#include <cstdint>
#include <dssm/time.hpp>
#include <functional>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "daemon/base/rate_limiter.hpp"

namespace dssm::daemon {

// Numbers as in syslog(3); each level includes the ones before it.
enum class LogLevel : std::uint8_t { error = 3, warning = 4, notice = 5, info = 6, debug = 7 };

// What an entry is about, for logs that can be searched by field. Empty: not about any.
struct LogFields {
  std::string_view stream = {};      // "lidar:0@pc1"
  std::string_view peer = {};        // "'mapper' (pid 12, uid 1000)"
  std::string_view message_id = {};  // one of daemon/base/message_ids.hpp
};

class Logger {
 public:
  virtual ~Logger() = default;
  virtual void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept = 0;

  void error(std::string_view text, const LogFields& f = {}) { write(LogLevel::error, text, f); }
  void warning(std::string_view text, const LogFields& f = {}) {
    write(LogLevel::warning, text, f);
  }
  void notice(std::string_view text, const LogFields& f = {}) { write(LogLevel::notice, text, f); }
  void info(std::string_view text, const LogFields& f = {}) { write(LogLevel::info, text, f); }
  void debug(std::string_view text, const LogFields& f = {}) { write(LogLevel::debug, text, f); }
};

// A logger that leaves out what is less important than its level, which may change at any time.
class LeveledLogger : public Logger {
 public:
  explicit LeveledLogger(LogLevel level) : level_(level) {}
  void set_level(LogLevel level) noexcept { level_ = level; }

 protected:
  bool leaves_out(LogLevel level) const noexcept { return level > level_; }

 private:
  LogLevel level_;
};

// One line per entry to stderr: "dssmd: warning: text", or "<4>text" where systemd collects stderr
// and cuts such prefixes off itself. Never waits: a line that stderr does not take at once is left
// out and counted, and the next line says how many are missing.
class StderrLogger final : public LeveledLogger {
 public:
  // journal_prefix: write "<4>" and the like; see stderr_is_journal().
  StderrLogger(LogLevel level, bool journal_prefix)
      : LeveledLogger(level), journal_prefix_(journal_prefix) {}

  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override;

 private:
  bool journal_prefix_;
  std::uint64_t left_out_ = 0;
};

// Whether this process's stderr goes to the journal ($JOURNAL_STREAM names it).
bool stderr_is_journal() noexcept;

// The log as entries of systemd's journal, with fields that `journalctl` can search for:
//
//   MESSAGE MESSAGE_ID PRIORITY SYSLOG_IDENTIFIER   as in systemd.journal-fields(7)
//   DSSM_STREAM  the stream it is about, "lidar:0@pc1"
//   DSSM_PEER    the program or the host it is about
//
// Written to journald's datagram socket as systemd's JOURNAL_NATIVE_PROTOCOL describes, without
// waiting (sd_journal_send(3) waits for a journald that hangs). What the socket does not take goes
// to stderr, which leads to the journal by another way, without the fields.
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

// A logger that peers cannot use to fill the log. Of each level it passes at most kLinesPerPeriod
// lines on at once and in each period on average; the next line gives the number of lines that were
// left out.
class RateLimitedLogger final : public Logger {
 public:
  static constexpr int kLinesPerPeriod = 50;
  static constexpr Duration kPeriod = std::chrono::seconds(10);

  // `to` outlives this object. `now` is the clock; tests pass their own.
  explicit RateLimitedLogger(Logger& to, std::function<MonoTime()> now = MonoClock::now)
      : to_(to), now_(std::move(now)) {}

  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override;

 private:
  Logger& to_;
  std::function<MonoTime()> now_;
  std::vector<RateLimiter> limiters_{// by level
                                     static_cast<std::size_t>(LogLevel::debug) + 1,
                                     RateLimiter(kLinesPerPeriod, kPeriod / kLinesPerPeriod)};
};

}  // namespace dssm::daemon
