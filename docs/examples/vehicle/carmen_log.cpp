// SPDX-License-Identifier: Apache-2.0
//
// The parser has two passes: the first parses each line (numbers, counts), the second checks all
// timestamps together, because a wrong stamp can be recognized only by comparing it with its
// neighbours. In the example's recording, about twenty ODOM lines near the end have stamps of the
// first seconds. Sorted by these stamps, they would turn the robot for a moment and blur the map.
#include "carmen_log.hpp"

#include <zlib.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <cmath>
#include <cstdio>
#include <limits>
#include <optional>

namespace vehicle {
namespace {

// A stamp is accepted when it is within kBelievableS of the median of the surrounding stamps,
// kAround lines on each side. The logger wrote lines up to a second out of order. Pauses are not a
// problem: on each side of a pause the stamp is near the median.
constexpr double kBelievableS = 5;
constexpr std::size_t kAround = 5;

constexpr double kNoReflectionM = 81.91;  // what a SICK LMS reports then: 13 bits of 1 cm

// Reads the blank-separated words of one line.
class Words {
 public:
  explicit Words(std::string_view line) : rest_(line) {}

  // The next word; empty at the end of the line.
  std::string_view next() {
    const std::size_t begin = rest_.find_first_not_of(" \t\r");
    if (begin == std::string_view::npos) return {};
    rest_.remove_prefix(begin);
    const std::string_view word = rest_.substr(0, rest_.find_first_of(" \t\r"));
    rest_.remove_prefix(word.size());
    return word;
  }

  // The next word as a finite number.
  std::optional<double> number() {
    const std::string_view word = next();
    double value = 0;
    const auto [end, problem] = std::from_chars(word.data(), word.data() + word.size(), value);
    if (problem != std::errc() || end != word.data() + word.size() || !std::isfinite(value)) {
      return std::nullopt;
    }
    return value;
  }

  // The next `count` words as finite numbers.
  template <std::size_t count>
  std::optional<std::array<double, count>> numbers() {
    std::array<double, count> values{};
    for (double& value : values) {
      const std::optional<double> read = number();
      if (!read) return std::nullopt;
      value = *read;
    }
    return values;
  }

 private:
  std::string_view rest_;
};

// ODOM x y theta tv rv accel timestamp host logger_timestamp
std::optional<OdometryReading> parse_odometry(Words& words) {
  const auto v = words.numbers<7>();
  if (!v) return std::nullopt;
  return OdometryReading{(*v)[6], {(*v)[0], (*v)[1], (*v)[2]}};
}

// FLASER n r1 ... rn x y theta odom_x odom_y odom_theta timestamp host logger_timestamp
std::optional<ScanReading> parse_scan(Words& words) {
  const std::optional<double> count = words.number();
  if (!count || *count < 1 || *count > static_cast<double>(kMaxBeams) ||
      *count != std::floor(*count)) {
    return std::nullopt;
  }
  ScanReading scan;
  scan.ranges_m.reserve(static_cast<std::size_t>(*count));
  for (std::size_t i = 0; i < static_cast<std::size_t>(*count); ++i) {
    const std::optional<double> range = words.number();
    if (!range || *range < 0) return std::nullopt;
    const bool is_reflected = *range < kNoReflectionM;
    scan.ranges_m.push_back(is_reflected ? static_cast<float>(*range)
                                         : std::numeric_limits<float>::infinity());
  }
  const auto v = words.numbers<7>();
  if (!v) return std::nullopt;
  scan.laser = {(*v)[0], (*v)[1], (*v)[2]};
  scan.time_s = (*v)[6];
  return scan;
}

// A reading with the index of its line among all stamped lines of the file.
template <class Reading>
struct Placed {
  std::size_t place;
  Reading reading;
};

// For each stamp, in file order, whether it agrees with the stamps around it.
std::vector<bool> believable(const std::vector<double>& stamps) {
  std::vector<bool> result(stamps.size());
  for (std::size_t i = 0; i < stamps.size(); ++i) {
    const std::size_t begin = i > kAround ? i - kAround : 0;
    const std::size_t end = std::min(stamps.size(), i + kAround + 1);
    std::vector<double> around(stamps.begin() + static_cast<std::ptrdiff_t>(begin),
                               stamps.begin() + static_cast<std::ptrdiff_t>(end));
    const auto middle = around.begin() + static_cast<std::ptrdiff_t>(around.size() / 2);
    std::nth_element(around.begin(), middle, around.end());
    result[i] = std::abs(stamps[i] - *middle) <= kBelievableS;
  }
  return result;
}

// The readings to keep, in order of time; those of equal time stay in file order.
template <class Reading>
std::vector<Reading> in_order(std::vector<Placed<Reading>>& placed, const std::vector<bool>& keep,
                              Skipped& skipped) {
  std::vector<Reading> readings;
  for (Placed<Reading>& one : placed) {
    if (keep[one.place]) {
      readings.push_back(std::move(one.reading));
    } else {
      ++skipped.misstamped;
    }
  }
  std::stable_sort(readings.begin(), readings.end(),
                   [](const Reading& a, const Reading& b) { return a.time_s < b.time_s; });
  return readings;
}

}  // namespace

CarmenLog parse_carmen_log(std::string_view text) {
  CarmenLog log;
  std::vector<Placed<OdometryReading>> odometry;
  std::vector<Placed<ScanReading>> scans;
  std::vector<double> stamps;
  for (std::size_t line_number = 1; !text.empty(); ++line_number) {
    const std::string_view line = text.substr(0, text.find('\n'));
    text.remove_prefix(std::min(text.size(), line.size() + 1));
    Words words(line);
    const std::string_view kind = words.next();
    if (kind.empty() || kind.front() == '#' || kind == "PARAM" || kind == "NEFF") continue;
    if (kind == "ODOM") {
      if (const auto reading = parse_odometry(words)) {
        if (reading->time_s == 0) {
          ++log.skipped.unstamped;
        } else {
          odometry.push_back({stamps.size(), *reading});
          stamps.push_back(reading->time_s);
        }
        continue;
      }
    } else if (kind == "FLASER") {
      if (auto reading = parse_scan(words)) {
        stamps.push_back(reading->time_s);
        scans.push_back({stamps.size() - 1, std::move(*reading)});
        continue;
      }
    }
    if (log.skipped.bad++ == 0) {
      log.skipped.first_bad = "line " + std::to_string(line_number) + ": '" +
                              std::string(line.substr(0, 40)) + (line.size() > 40 ? "...'" : "'");
    }
  }
  const std::vector<bool> keep = believable(stamps);
  log.odometry = in_order(odometry, keep, log.skipped);
  log.scans = in_order(scans, keep, log.skipped);
  return log;
}

std::string CarmenLog::summary() const {
  std::string text = std::to_string(odometry.size()) + " odometry readings and " +
                     std::to_string(scans.size()) +
                     " scans; left out: " + std::to_string(skipped.unstamped) +
                     " without a timestamp, " + std::to_string(skipped.misstamped) +
                     " with a wrong one, " + std::to_string(skipped.bad) + " unreadable";
  if (!skipped.first_bad.empty()) text += " (first: " + skipped.first_bad + ")";
  return text;
}

dssm::Result<CarmenLog> read_carmen_log(const std::string& path) {
  const std::string what = "read the recording '" + path + "'";
  errno = 0;
  gzFile file = ::gzopen(path.c_str(), "rbe");  // also reads uncompressed text
  if (!file) {
    const int problem = errno;  // 0: zlib itself had no memory
    dssm::Error error = dssm::os_error(what, problem == 0 ? ENOMEM : problem);
    if (problem == ENOENT) error.code = dssm::Errc::not_found;
    error.message += "; name another file with --log";
    return error;
  }
  std::string text;
  std::vector<char> chunk(1 << 20);
  int got = 0;
  while ((got = ::gzread(file, chunk.data(), static_cast<unsigned>(chunk.size()))) > 0) {
    text.append(chunk.data(), static_cast<std::size_t>(got));
  }
  int problem = Z_OK;
  const std::string reason = ::gzerror(file, &problem);
  ::gzclose(file);
  if (got < 0 || problem != Z_OK) {
    return dssm::Error{dssm::Errc::system,
                       what + ": " + reason + "; the file is damaged, get a fresh copy"};
  }
  CarmenLog log = parse_carmen_log(text);
  if (log.odometry.empty() && log.scans.empty()) {
    return dssm::Error{dssm::Errc::invalid_argument, what +
                                                         ": no usable ODOM or FLASER line in it (" +
                                                         log.summary() + "); is it a CARMEN log?"};
  }
  return log;
}

}  // namespace vehicle
