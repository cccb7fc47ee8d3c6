// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/statistics.hpp"

#include <algorithm>
#include <cmath>

namespace dssm::ctl {

void Window::add(Duration value) {
  if (values_.size() == capacity_) values_.pop_front();
  values_.push_back(value);
}

Statistics Window::statistics() const {
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
