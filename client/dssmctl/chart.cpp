// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/chart.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>

#include "client/dssmctl/text.hpp"
#include "core/base/time.hpp"

namespace dssm::ctl {
namespace {

constexpr int kLabelColumns = 10;

// Dots in cells: 2 x 4 of Braille, or 1 x 1.
class Canvas {
 public:
  Canvas(const ChartSize& size, bool plain)
      : size_(size), plain_(plain), cells_(size.columns * size.rows) {}

  int width() const { return static_cast<int>(size_.columns) * (plain_ ? 1 : 2); }
  int height() const { return static_cast<int>(size_.rows) * (plain_ ? 1 : 4); }

  // From the left and from below.
  void set(int x, int y) {
    const auto from_above = static_cast<std::size_t>(height() - 1 - y);
    const auto column = static_cast<std::size_t>(x);
    if (plain_) {
      cells_[from_above * size_.columns + column] = 1;
      return;
    }
    // Unicode 15, chapter 21.1: dots 1 to 3 are the left column from above, 4 to 6 the right one, 7
    // and 8 the row below.
    constexpr std::array<std::array<std::uint8_t, 2>, 4> kDots = {
        {{0x01, 0x08}, {0x02, 0x10}, {0x04, 0x20}, {0x40, 0x80}}};
    cells_[from_above / 4 * size_.columns + column / 2] |= kDots[from_above % 4][column % 2];
  }

  std::string row(std::size_t row) const {
    std::string text;
    for (std::size_t column = 0; column < size_.columns; ++column) {
      const std::uint8_t cell = cells_[row * size_.columns + column];
      if (plain_) {
        text += cell ? '*' : ' ';
      } else {  // U+2800 and its dots, as UTF-8
        text += '\xe2';
        text += static_cast<char>(0xa0 | cell >> 6);
        text += static_cast<char>(0x80 | (cell & 0x3f));
      }
    }
    return text;
  }

 private:
  ChartSize size_;
  bool plain_;
  std::vector<std::uint8_t> cells_;
};

// A line without gaps from one dot to the next.
void draw_line(Canvas& canvas, int x, int y, int to_x, int to_y) {
  const int steps = std::max({std::abs(to_x - x), std::abs(to_y - y), 1});
  for (int step = 0; step <= steps; ++step) {
    const double share = static_cast<double>(step) / steps;
    canvas.set(x + static_cast<int>(std::lround((to_x - x) * share)),
               y + static_cast<int>(std::lround((to_y - y) * share)));
  }
}

}  // namespace

std::vector<std::string> draw_chart(const std::vector<ChartPoint>& points, Time end, Duration span,
                                    const ChartSize& size, bool plain) {
  const Time begin = saturating_add(end, -span);
  const auto is_shown = [&](const ChartPoint& point) {
    return point.time >= begin && point.time <= end && std::isfinite(point.value);
  };
  constexpr double kInfinity = std::numeric_limits<double>::infinity();
  double least = kInfinity, greatest = -kInfinity;
  for (const ChartPoint& point : points) {
    if (!is_shown(point)) continue;
    least = std::min(least, point.value), greatest = std::max(greatest, point.value);
  }
  Canvas canvas(size, plain);
  const auto place = [](double share, int dots) {
    return std::clamp(static_cast<int>(std::lround(share * (dots - 1))), 0, dots - 1);
  };
  // Halves, as the whole difference may be too great for a double.
  const double half_height = greatest / 2 - least / 2;
  bool is_continued = false;
  int last_x = 0, last_y = 0;
  for (const ChartPoint& point : points) {
    const bool shown = is_shown(point);
    if (shown) {
      const int x = place(static_cast<double>(to_ns(point.time - begin)) /
                              std::max(static_cast<double>(to_ns(span)), 1.0),
                          canvas.width());
      // One value only: in the middle.
      const int y = place(half_height > 0 ? (point.value / 2 - least / 2) / half_height : 0.5,
                          canvas.height());
      if (is_continued) {
        draw_line(canvas, last_x, last_y, x, y);
      } else {
        canvas.set(x, y);
      }
      last_x = x, last_y = y;
    }
    is_continued = shown;
  }
  std::vector<std::string> lines;
  for (std::size_t row = 0; row < size.rows; ++row) {
    std::string label;
    if (std::isfinite(least) && row == 0) label = fmt::format("{:.5g}", greatest);
    if (std::isfinite(least) && half_height > 0 && row + 1 == size.rows) {
      label = fmt::format("{:.5g}", least);
    }
    lines.push_back(fmt::format("{:>{}} {}", label, kLabelColumns, canvas.row(row)));
  }
  return lines;
}

std::string gnuplot_text(const std::vector<NamedCurve>& curves, std::string_view format,
                         std::string_view file) {
  // In single quotes a quote is doubled, and nothing else is special.
  const auto quoted = [](std::string_view text) {
    std::string result = "'";
    for (const char c : text) result.append(c == '\'' ? 2 : 1, c);
    return result + "'";
  };
  Time begin = Time::max(), end = Time::min();
  for (const NamedCurve& curve : curves) {
    for (const ChartPoint& point : curve.points) {
      begin = std::min(begin, point.time), end = std::max(end, point.time);
    }
  }
  const auto seconds = [&](Time time) { return static_cast<double>(to_ns(time - begin)) * 1e-9; };
  std::string text = fmt::format(
      "set terminal {} size {},{} noenhanced\nset output {}\nset multiplot layout {},1\n"
      "set grid\nset lmargin 12\nset xrange [0:{}]\n",
      format == "png" ? "pngcairo" : "svg background 'white'", 1000, 60 + 240 * curves.size(),
      quoted(file), curves.size(), end > begin ? seconds(end) : 1);
  for (std::size_t i = 0; i < curves.size(); ++i) {
    const NamedCurve& curve = curves[i];
    if (i + 1 == curves.size()) {
      text += fmt::format("set xlabel {}\n",
                          quoted(fmt::format("seconds after {}", time_text(begin, true))));
    }
    text += fmt::format("plot '-' using 1:2 with lines linewidth 1.5 title {}\n",
                        quoted(escaped(curve.name)));
    for (const ChartPoint& point : curve.points) {
      text += fmt::format("{:.9f} {}\n", seconds(point.time),
                          std::isfinite(point.value) ? fmt::format("{}", point.value) : "NaN");
    }
    text += "e\n";
  }
  return text + "unset multiplot\n";
}

}  // namespace dssm::ctl
