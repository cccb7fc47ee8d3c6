// SPDX-License-Identifier: Apache-2.0
//
// An occupancy grid: the floor in square cells, each with the evidence that it is a wall or free.
// A beam is evidence for free floor along its way and for a wall at its end.
//
// Evidence is added in integers and in the order of the scans, so the same scans and poses give the
// same grid, bit for bit, on every PC.
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <vector>

#include "pose.hpp"

namespace vehicle {

// One scan's beams: beam i points `first_rad + i * step_rad` from the laser's own direction,
// counter-clockwise.
struct Beams {
  std::span<const float> ranges_m;
  double first_rad = 0;
  double step_rad = 0;
};

class OccupancyGrid {
 public:
  static constexpr double kCellM = 0.05;
  static constexpr int kSide = 2400;  // cells: 120 m, with the recording's origin in the middle

  enum class Cell : std::uint8_t { unknown, free, wall };

  OccupancyGrid();

  // Adds a scan taken by a laser at `laser`. A beam longer than kMaxRangeM is ignored, one longer
  // than kMaxWallM is evidence only for free floor. Evidence outside the grid is ignored.
  void add(const Pose2& laser, const Beams& beams);

  // A cell by column (x) and row (y), both 0 to kSide - 1.
  Cell at(int column, int row) const;

  // The column of `x_m`, or the row of `y_m`; may be outside the grid.
  static int index_of(double m);

  // The number of cells of this kind.
  std::size_t count(Cell kind) const;

  // First and last column and row with known cells, inclusive. Empty grid: last < first.
  struct Box {
    int first_column = kSide, last_column = -1, first_row = kSide, last_row = -1;
  };
  Box known() const;

 private:
  void add_evidence(int column, int row, int evidence);
  std::vector<std::int16_t> evidence_;  // row by row; > 0 wall, < 0 free
};

}  // namespace vehicle
