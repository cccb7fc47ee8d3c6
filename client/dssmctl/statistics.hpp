// SPDX-License-Identifier: Apache-2.0
//
// Mean, extremes and standard deviation of the newest few durations.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <deque>
#include <dssm/time.hpp>

namespace dssm::ctl {

// What a window holds at a moment. All zero without values.
struct Statistics {
  std::size_t count = 0;
  double mean_ns = 0;
  double std_dev_ns = 0;  // of the population: divided by count, as `ros2 topic hz` does
  Duration min{};
  Duration max{};
};

class Window {
 public:
  // Keeps the newest `capacity` (>= 1) values.
  explicit Window(std::size_t capacity) : capacity_(capacity) {}

  void add(Duration value);
  std::size_t size() const { return values_.size(); }

  // Exact sums, whatever the values: two passes over the window.
  Statistics statistics() const;

 private:
  std::size_t capacity_;
  std::deque<Duration> values_;
};

inline void Window::add(Duration value) {
  if (values_.size() == capacity_) values_.pop_front();
  values_.push_back(value);
}

inline Statistics Window::statistics() const {
  Statistics result;
  if (values_.empty()) return result;
  __extension__ __int128 sum = 0;  // 2^24 values of 2^63 do not fit into 64 bits
  result.count = values_.size();
  result.min = result.max = values_.front();
  for (const Duration value : values_) {
    sum += to_ns(value);
    result.min = std::min(result.min, value);
    result.max = std::max(result.max, value);
  }
  const double count = static_cast<double>(result.count);
  result.mean_ns = static_cast<double>(sum) / count;
  double squares = 0;
  for (const Duration value : values_) {
    const double distance = static_cast<double>(to_ns(value)) - result.mean_ns;
    squares += distance * distance;
  }
  result.std_dev_ns = std::sqrt(squares / count);
  return result;
}

}  // namespace dssm::ctl
