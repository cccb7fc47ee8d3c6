// SPDX-License-Identifier: Apache-2.0
//
// A curve as text: a cell of Braille has 2 x 4 dots, which is enough to follow a value over ssh.
#pragma once

#include <cstddef>
#include <dssm/time.hpp>
#include <string>
#include <string_view>
#include <vector>

namespace dssm::ctl {

struct ChartPoint {
  Time time;
  double value;
};

struct ChartSize {
  std::size_t columns = 72, rows = 8;  // of the curve
};

// Draws `points`, in the order of time, as far as they are within `span` before `end`: a line per
// row, the greatest and the least value at its left, and the curve from one sample to the next.
// Values that are not numbers interrupt it.
//   plain  stars in place of Braille, for terminals without UTF-8
std::vector<std::string> draw_chart(const std::vector<ChartPoint>& points, Time end, Duration span,
                                    const ChartSize& size, bool plain);

// The same for a program that draws files: what gnuplot(1) reads. Each curve has its own axes, one
// below the other. It makes a gap where a value is not a number.
struct NamedCurve {
  std::string name;
  std::vector<ChartPoint> points;
};
std::string gnuplot_text(const std::vector<NamedCurve>& curves, std::string_view format,
                         std::string_view file);

}  // namespace dssm::ctl
