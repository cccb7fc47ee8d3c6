// SPDX-License-Identifier: Apache-2.0
//
// Mean, extremes and standard deviation of the newest few durations.
#pragma once

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

}  // namespace dssm::ctl
