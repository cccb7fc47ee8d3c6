// SPDX-License-Identifier: Apache-2.0
//
// Curves as text, and what gnuplot gets.
#include "client/dssmctl/chart.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <limits>

namespace dssm::ctl {
namespace {

using Lines = std::vector<std::string>;

Time at(double seconds) { return time_from_ns(static_cast<std::int64_t>(seconds * 1e9)); }

TEST(Chart, DrawsFromOneSampleToTheNextBetweenTheLeastAndTheGreatest) {
  const std::vector<ChartPoint> points = {{at(0), 0}, {at(1), 4}, {at(2), 0}};
  EXPECT_EQ(draw_chart(points, at(2), std::chrono::seconds(2), {5, 5}, true),
            (Lines{
                "         4   *  ",
                "             ** ",
                "            * * ",
                "            *  *",
                "         0 *   *",
            }));
}

TEST(Chart, HasEightDotsInEachCell) {
  // From the lower left dot of the left cell to the upper right one of the right cell.
  const std::vector<ChartPoint> points = {{at(0), -1}, {at(3), 2}};
  EXPECT_EQ(draw_chart(points, at(3), std::chrono::seconds(3), {2, 1}, false),
            (Lines{"        -1 \xe2\xa1\xa0\xe2\xa0\x8a"}));
}

TEST(Chart, LeavesOutWhatIsTooOldAndWhatIsNotANumber) {
  const std::vector<ChartPoint> points = {{at(0), 100}, {at(6), 1}, {at(7), NAN}, {at(10), 2}};
  EXPECT_EQ(draw_chart(points, at(10), std::chrono::seconds(4), {5, 2}, true),
            (Lines{
                "         2     *",
                "         1 *    ",
            }));
}

TEST(Chart, DrawsAValueThatDoesNotChangeInTheMiddle) {
  const std::vector<ChartPoint> points = {{at(0), 7.25}, {at(4), 7.25}};
  EXPECT_EQ(draw_chart(points, at(4), std::chrono::seconds(4), {3, 3}, true),
            (Lines{"      7.25    ", "           ***", "              "}));
}

TEST(Chart, TakesTheGreatestValuesAndNone) {
  constexpr double kMax = std::numeric_limits<double>::max();
  const std::vector<ChartPoint> points = {{at(0), -kMax}, {at(1), kMax}};
  EXPECT_EQ(draw_chart(points, at(1), std::chrono::seconds(1), {2, 2}, true),
            (Lines{"1.7977e+308  *", "-1.7977e+308 * "}));
  EXPECT_EQ(draw_chart({}, Time::min(), std::chrono::hours(1), {2, 1}, true),
            (Lines{"             "}));
}

TEST(Chart, GivesGnuplotAllCurvesOverTheSameTime) {
  const std::string text = gnuplot_text(
      {{"it's.x", {{at(1), 0.5}, {at(2.5), NAN}}}, {"b.y", {{at(1.5), -3}}}}, "svg", "a 'b'.svg");
  EXPECT_EQ(text,
            "set terminal svg background 'white' size 1000,540 noenhanced\n"
            "set output 'a ''b''.svg'\n"
            "set multiplot layout 2,1\n"
            "set grid\n"
            "set lmargin 12\n"
            "set xrange [0:1.5]\n"
            "plot '-' using 1:2 with lines linewidth 1.5 title 'it''s.x'\n"
            "0.000000000 0.5\n"
            "1.500000000 NaN\n"
            "e\n"
            "set xlabel 'seconds after 1970-01-01T00:00:01.000000000Z'\n"
            "plot '-' using 1:2 with lines linewidth 1.5 title 'b.y'\n"
            "0.500000000 -3\n"
            "e\n"
            "unset multiplot\n");
}

}  // namespace
}  // namespace dssm::ctl
