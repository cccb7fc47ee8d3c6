// SPDX-License-Identifier: Apache-2.0
//
// Bresenham's line algorithm visits the cells of each beam. The constants below were tuned by
// inspecting the pictures. A wall weighs more than free floor, because beams pass the cells in
// front of a wall many times for each beam that ends in it.
#include "occupancy_grid.hpp"

#include <algorithm>
#include <cmath>
#include <cstdlib>

namespace vehicle {
namespace {

constexpr double kMinRangeM = 0.2;  // nearer: the robot, or the laser's window
constexpr double kMaxWallM = 10;    // a degree of error in the pose is 17 cm there
constexpr double kMaxRangeM = 40;   // farther reflections are few, and infinite is none
constexpr int kWallEvidence = 3;
constexpr int kFreeEvidence = -1;
constexpr std::int16_t kMaxEvidence = 60;  // so that a door that opens can still become free
constexpr std::int16_t kMinEvidence = -30;

}  // namespace

OccupancyGrid::OccupancyGrid() : evidence_(std::size_t{kSide} * kSide) {}

int OccupancyGrid::index_of(double m) {
  return static_cast<int>(std::floor(m / kCellM)) + kSide / 2;
}

void OccupancyGrid::add_evidence(int column, int row, int evidence) {
  if (column < 0 || column >= kSide || row < 0 || row >= kSide) return;
  std::int16_t& cell =
      evidence_[static_cast<std::size_t>(row) * kSide + static_cast<std::size_t>(column)];
  cell = static_cast<std::int16_t>(std::clamp<int>(cell + evidence, kMinEvidence, kMaxEvidence));
}

void OccupancyGrid::add(const Pose2& laser, const Beams& beams) {
  const int start_column = index_of(laser.x_m), start_row = index_of(laser.y_m);
  for (std::size_t i = 0; i < beams.ranges_m.size(); ++i) {
    const double range = beams.ranges_m[i];
    if (!(range >= kMinRangeM && range <= kMaxRangeM)) continue;
    const double angle =
        laser.theta_rad + beams.first_rad + static_cast<double>(i) * beams.step_rad;
    const double length = std::min(range, kMaxWallM);
    const int end_column = index_of(laser.x_m + length * std::cos(angle));
    const int end_row = index_of(laser.y_m + length * std::sin(angle));

    const int columns = std::abs(end_column - start_column), rows = std::abs(end_row - start_row);
    const int column_step = start_column < end_column ? 1 : -1;
    const int row_step = start_row < end_row ? 1 : -1;
    int error = columns - rows;
    for (int column = start_column, row = start_row; column != end_column || row != end_row;) {
      add_evidence(column, row, kFreeEvidence);
      const int twice = 2 * error;
      if (twice > -rows) error -= rows, column += column_step;
      if (twice < columns) error += columns, row += row_step;
    }
    add_evidence(end_column, end_row, range <= kMaxWallM ? kWallEvidence : kFreeEvidence);
  }
}

OccupancyGrid::Cell OccupancyGrid::at(int column, int row) const {
  const std::int16_t evidence =
      evidence_[static_cast<std::size_t>(row) * kSide + static_cast<std::size_t>(column)];
  return evidence > 0 ? Cell::wall : evidence < 0 ? Cell::free : Cell::unknown;
}

std::size_t OccupancyGrid::count(Cell kind) const {
  std::size_t cells = 0;
  for (int row = 0; row < kSide; ++row) {
    for (int column = 0; column < kSide; ++column) cells += at(column, row) == kind;
  }
  return cells;
}

OccupancyGrid::Box OccupancyGrid::known() const {
  Box box;
  for (int row = 0; row < kSide; ++row) {
    for (int column = 0; column < kSide; ++column) {
      if (at(column, row) == Cell::unknown) continue;
      box.first_column = std::min(box.first_column, column);
      box.last_column = std::max(box.last_column, column);
      box.first_row = std::min(box.first_row, row);
      box.last_row = std::max(box.last_row, row);
    }
  }
  return box;
}

}  // namespace vehicle
