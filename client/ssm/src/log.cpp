// SPDX-License-Identifier: Apache-2.0
//
// <ssm-log.hpp>: the file of a log, in the format of SSM (docs/ssm.md "Logs"): a line of text, the
// property, and records of 8 bytes of time and the data, without padding. Nothing in a file is
// trusted: sizes are bounded, and compared with the caller's buffer before each copy.
//
// Records are found by their number, with 64-bit places. A file that is still being written grows
// under its reader, so its number of records is asked again where it matters.
#include <fcntl.h>
#include <fmt/format.h>
#include <sys/stat.h>
#include <sys/uio.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cmath>
#include <cstdio>
#include <cstring>
#include <limits>
#include <string>
#include <string_view>
#include <vector>

#include "../include/ssm-log.hpp"
#include "core/base/ssm_log.hpp"
#include "core/base/try.hpp"
#include "messages.hpp"

using dssm::Result;
using dssm::ssm::report_error;

struct dssm_ssm_log {
  dssm_ssm_log(std::FILE* open, std::string path) : file(open), file_name(std::move(path)) {}
  dssm_ssm_log(const dssm_ssm_log&) = delete;
  dssm_ssm_log& operator=(const dssm_ssm_log&) = delete;

  std::uint64_t record_bytes() const { return sizeof(double) + head.data_size; }
  std::uint64_t offset_of(std::uint64_t record) const { return data_at + record * record_bytes(); }

  std::FILE* const file;
  const std::string file_name;  // for messages
  std::string stream_name;
  dssm_ssm_log_head head{};  // its name is stream_name's
  std::uint64_t data_at = 0;
  std::atomic<int> users{1};

  bool failed = false;     // writing
  std::uint64_t next = 0;  // reading: the number of the next record
  bool at_end = false;     // the last read found no record
  // What find() knows of the times of the first `scanned` records: they rise, but for these places.
  // A NaN is a run of its own.
  std::vector<std::uint64_t> runs = {0};
  std::uint64_t scanned = 0;
  double last_scanned = -std::numeric_limits<double>::infinity();
};

namespace {

constexpr std::size_t kScanBytes = 1 << 20;

void report(const dssm_ssm_log& log, std::string_view what) {
  report_error(fmt::format("log '{}' : {}", log.file_name, what));
}

void report_os_error(std::string_view what, const char* file_name, int error) {
  // NOLINTNEXTLINE(concurrency-mt-unsafe): glibc's is
  report_error(fmt::format("{} '{}' : {}", what, file_name, std::strerror(error)));
}

// Bytes of the file from `at` on, into all of `parts`; false when it does not have as many.
bool read_at(const dssm_ssm_log& log, std::uint64_t at, std::vector<iovec> parts) {
  for (std::size_t first = 0; first < parts.size();) {
    const ssize_t n = ::preadv(::fileno(log.file), &parts[first],
                               static_cast<int>(parts.size() - first), static_cast<off_t>(at));
    if (n < 0 && errno == EINTR) continue;
    if (n < 0) report(log, fmt::format("cannot read : {}", std::strerror(errno)));  // NOLINT
    std::size_t left = n > 0 ? static_cast<std::size_t>(n) : 0;
    while (first < parts.size() && parts[first].iov_len <= left) left -= parts[first++].iov_len;
    if (first == parts.size()) return true;
    if (n <= 0) return false;
    parts[first].iov_base = static_cast<std::byte*>(parts[first].iov_base) + left;
    parts[first].iov_len -= left;
    at += static_cast<std::uint64_t>(n);
  }
  return true;
}

std::uint64_t file_bytes(const dssm_ssm_log& log) {
  struct stat file {};
  return ::fstat(::fileno(log.file), &file) == 0 ? static_cast<std::uint64_t>(file.st_size) : 0;
}

// Whole records; a part of one at the end is not counted.
std::uint64_t records(const dssm_ssm_log& log) {
  const std::uint64_t bytes = file_bytes(log);
  return bytes < log.data_at ? 0 : (bytes - log.data_at) / log.record_bytes();
}

// Fills log.head from the file.
//   fails  with what is wrong with it
Result<void> read_head(dssm_ssm_log& log) {
  const std::uint64_t bytes = file_bytes(log);
  std::string text(std::min<std::uint64_t>(bytes, dssm::kMaxSsmLogLineBytes), '\0');
  if (!read_at(log, 0, {{text.data(), text.size()}})) {
    return dssm::Error{dssm::Errc::system, "it cannot be read"};
  }
  const dssm::SsmLogHead head = DSSM_TRY(dssm::ssm_log_head_untrusted(text, bytes));
  log.stream_name = head.stream_name;
  log.head = {log.stream_name.c_str(), head.stream_id, head.buffer_num,  head.data_bytes,
              head.property_bytes,     head.cycle_s,   head.start_time_s};
  log.data_at = head.records_at();
  return {};
}

// --- search by time

double time_of(const dssm_ssm_log& log, std::uint64_t record) {
  double time = 0;
  return read_at(log, log.offset_of(record), {{&time, sizeof time}}) ? time : 0;
}

// Extends what is known of the times to the first `count` records: one pass over them, each once in
// the life of the log.
void scan_times(dssm_ssm_log& log, std::uint64_t count) {
  const std::uint64_t step = log.record_bytes();
  // Of long records the times alone are read, of short ones many at once.
  const std::uint64_t at_once = step > 4096 ? 1 : kScanBytes / step;
  std::vector<std::byte> block;
  while (log.scanned < count) {
    const std::uint64_t n = std::min(at_once, count - log.scanned);
    block.resize((n - 1) * step + sizeof(double));
    if (!read_at(log, log.offset_of(log.scanned), {{block.data(), block.size()}})) return;
    for (std::uint64_t i = 0; i < n; ++i) {
      double time = 0;
      std::memcpy(&time, &block[i * step], sizeof time);
      if (!(time >= log.last_scanned)) log.runs.push_back(log.scanned + i);
      log.last_scanned = time;
    }
    log.scanned += n;
  }
}

// The newest of the first `count` > 0 records with a time before `time`, else the first one. Each
// run of rising times is searched by bisection, from the last run on.
std::uint64_t newest_before(dssm_ssm_log& log, double time, std::uint64_t count) {
  if (std::isinf(time)) return time < 0 ? 0 : count - 1;  // beginning and end need no search
  scan_times(log, count);
  std::uint64_t end = std::min(count, log.scanned);
  for (std::size_t run = log.runs.size(); run-- > 0; end = std::min(end, log.runs[run])) {
    std::uint64_t low = log.runs[run], high = end;
    if (low >= end || !(time_of(log, low) < time)) continue;
    while (high - low > 1) {  // record `low` is before `time`, `high` is not, or is the end
      const std::uint64_t middle = low + (high - low) / 2;
      (time_of(log, middle) < time ? low : high) = middle;
    }
    return low;
  }
  return 0;
}

bool fits(const dssm_ssm_log& log, const void* data, std::size_t size) {
  if (size == log.head.data_size && (data || size == 0)) return true;
  report(log, fmt::format("its records have {} bytes, the program's buffer {}; give it one of that "
                          "size",
                          log.head.data_size, data ? size : 0));
  return false;
}

bool write_all(dssm_ssm_log& log, const void* bytes, std::size_t size) {
  if (size == 0 || std::fwrite(bytes, size, 1, log.file) == 1) return true;
  // The rest of a record must not follow a part of one.
  log.failed = true;
  report(log, fmt::format("cannot write : {}; what follows is not recorded",
                          std::strerror(errno)));  // NOLINT(concurrency-mt-unsafe): glibc's is
  return false;
}

}  // namespace

extern "C" {

dssm_ssm_log* dssm_ssm_log_open(const char* file_name) {
  if (!file_name) return report_error("cannot open log file : no file name"), nullptr;
  std::FILE* const file = std::fopen(file_name, "rbe");
  if (!file) return report_os_error("cannot open log file", file_name, errno), nullptr;
  auto* const log = new dssm_ssm_log(file, file_name);
  const Result<void> head = read_head(*log);
  if (head) return log;
  report_error(fmt::format("'{}' is NOT ssm-log file : {}", file_name, head.error().message));
  dssm_ssm_log_close(log);
  return nullptr;
}

dssm_ssm_log* dssm_ssm_log_create(const dssm_ssm_log_head* head, const void* property,
                                  const char* file_name) {
  const std::string_view name = head->stream_name;
  if (!file_name || !dssm::is_ssm_log_name(name)) {
    report_error(
        fmt::format("cannot create log file '{}' of stream '{}' : the names of both must "
                    "be given, and a log holds no stream name with blanks",
                    file_name ? file_name : "", name));
    return nullptr;
  }
  std::FILE* const file = std::fopen(file_name, "wbe");
  if (!file) return report_os_error("cannot create log file", file_name, errno), nullptr;
  auto* const log = new dssm_ssm_log(file, file_name);
  log->stream_name = name;
  log->head = *head;
  log->head.stream_name = log->stream_name.c_str();
  const std::string line =
      dssm::ssm_log_line({log->stream_name, head->stream_id, head->buffer_num, head->data_size,
                          head->property_size, head->cycle, head->start_time});
  log->data_at = line.size() + head->property_size;
  if (write_all(*log, line.data(), line.size()) && write_all(*log, property, head->property_size)) {
    return log;
  }
  dssm_ssm_log_close(log);
  return nullptr;
}

dssm_ssm_log* dssm_ssm_log_share(dssm_ssm_log* log) {
  if (log) log->users.fetch_add(1);
  return log;
}

int dssm_ssm_log_close(dssm_ssm_log* log) {
  if (!log || log->users.fetch_sub(1) > 1) return 1;
  const bool flushed = std::fclose(log->file) == 0;
  if (!flushed && !log->failed)
    report_os_error("cannot write log file", log->file_name.c_str(), errno);
  const bool stored = flushed && !log->failed;
  delete log;
  return stored ? 1 : 0;
}

const dssm_ssm_log_head* dssm_ssm_log_get_head(const dssm_ssm_log* log) { return &log->head; }

int dssm_ssm_log_property(dssm_ssm_log* log, void* property, size_t size) {
  if (size != log->head.property_size) {
    report(*log, fmt::format("its property has {} bytes, the program's buffer {}; give it one of "
                             "that size",
                             log->head.property_size, size));
    return 0;
  }
  return read_at(*log, log->data_at - size, {{property, size}}) ? 1 : 0;
}

int dssm_ssm_log_write(dssm_ssm_log* log, double time, const void* data, size_t size) {
  if (log->failed || !fits(*log, data, size)) return 0;
  return write_all(*log, &time, sizeof time) && write_all(*log, data, size) ? 1 : 0;
}

int dssm_ssm_log_read(dssm_ssm_log* log, double* time, void* data, size_t size) {
  if (!fits(*log, data, size)) return 0;
  double read_time = 0;
  log->at_end =
      !(log->next < records(*log)) ||
      !read_at(*log, log->offset_of(log->next), {{&read_time, sizeof read_time}, {data, size}});
  if (log->at_end) return 0;
  ++log->next;
  *time = read_time;
  return 1;
}

int dssm_ssm_log_seek(dssm_ssm_log* log, int diff) {
  const std::int64_t wanted = static_cast<std::int64_t>(log->next) + diff;
  if (wanted < 0 || static_cast<std::uint64_t>(wanted) > records(*log)) return 0;
  log->next = static_cast<std::uint64_t>(wanted);
  log->at_end = false;
  return 1;
}

int dssm_ssm_log_back(dssm_ssm_log* log) { return dssm_ssm_log_seek(log, log->at_end ? -1 : -2); }

int dssm_ssm_log_find(dssm_ssm_log* log, double time) {
  const std::uint64_t count = records(*log);
  if (count == 0) return 0;
  log->next = newest_before(*log, time, count);
  log->at_end = false;
  return 1;
}

}  // extern "C"
