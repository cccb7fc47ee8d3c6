// SPDX-License-Identifier: Apache-2.0
//
// Tests the grid with single beams, whose cells are counted by hand.
#include "docs/examples/vehicle/occupancy_grid.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <vector>

#include "docs/examples/vehicle/map_picture.hpp"

namespace vehicle {
namespace {

using Cell = OccupancyGrid::Cell;
constexpr int kMiddle = OccupancyGrid::kSide / 2;

// Adds one beam straight ahead.
void add_beam(OccupancyGrid& grid, const Pose2& laser, float range_m) {
  grid.add(laser, {std::vector<float>{range_m}, 0, 0});
}

TEST(OccupancyGrid, StartsUnknown) {
  const OccupancyGrid grid;
  EXPECT_EQ(grid.count(Cell::unknown), std::size_t{OccupancyGrid::kSide} * OccupancyGrid::kSide);
  EXPECT_LT(grid.known().last_column, grid.known().first_column);
}

TEST(OccupancyGrid, MarksTheCellsOfABeamFreeAndItsEndAsWall) {
  OccupancyGrid grid;
  add_beam(grid, {0.025, 0.025, 0}, 1);  // 20 cells along x
  EXPECT_EQ(grid.count(Cell::free), 20u);
  EXPECT_EQ(grid.count(Cell::wall), 1u);
  EXPECT_EQ(grid.at(kMiddle, kMiddle), Cell::free);
  EXPECT_EQ(grid.at(kMiddle + 19, kMiddle), Cell::free);
  EXPECT_EQ(grid.at(kMiddle + 20, kMiddle), Cell::wall);
  EXPECT_EQ(grid.at(kMiddle + 21, kMiddle), Cell::unknown);
}

TEST(OccupancyGrid, TurnsBeamsWithTheLaser) {
  OccupancyGrid grid;
  add_beam(grid, {0.025, 0.025, M_PI / 2}, 1);  // along y
  EXPECT_EQ(grid.at(kMiddle, kMiddle + 20), Cell::wall);
  grid.add({-2.975, 0.025, 0}, {std::vector<float>{1, 1}, -M_PI / 2, M_PI});  // right, then left
  EXPECT_EQ(grid.at(kMiddle - 60, kMiddle - 20), Cell::wall);
  EXPECT_EQ(grid.at(kMiddle - 60, kMiddle + 20), Cell::wall);
}

TEST(OccupancyGrid, IgnoresBeamsWithoutReflection) {
  OccupancyGrid grid;
  add_beam(grid, {0.025, 0.025, 0}, INFINITY);
  add_beam(grid, {0.025, 0.025, 0}, 0.05F);
  add_beam(grid, {0.025, 0.025, 0}, std::nanf(""));
  EXPECT_LT(grid.known().last_column, grid.known().first_column);
}

TEST(OccupancyGrid, MarksNoWallFarAway) {
  OccupancyGrid grid;
  add_beam(grid, {0.025, 0.025, 0}, 30);
  EXPECT_EQ(grid.count(Cell::wall), 0u);
  EXPECT_GT(grid.count(Cell::free), 0u);
}

TEST(OccupancyGrid, ClearsAWallThatBeamsPass) {
  OccupancyGrid grid;
  for (int i = 0; i < 100; ++i) add_beam(grid, {0.025, 0.025, 0}, 1);
  EXPECT_EQ(grid.at(kMiddle + 20, kMiddle), Cell::wall);
  for (int i = 0; i < 100; ++i) add_beam(grid, {0.025, 0.025, 0}, 2);
  EXPECT_EQ(grid.at(kMiddle + 20, kMiddle), Cell::free);
}

TEST(OccupancyGrid, IgnoresCellsOutsideTheGrid) {
  OccupancyGrid grid;
  add_beam(grid, {59.9, 0, 0}, 5);
  add_beam(grid, {1000, -1000, 0}, 5);
  EXPECT_EQ(grid.count(Cell::wall), 0u);
  EXPECT_EQ(grid.known().last_column, OccupancyGrid::kSide - 1);
}

TEST(DrawMap, ShowsWallsFloorAndPath) {
  OccupancyGrid grid;
  add_beam(grid, {0.025, 0.025, 0}, 1);
  const Picture picture = draw_map(grid, {{0.025, 0.025, 0}, {0.525, 0.025, 0}});
  ASSERT_EQ(picture.width, (21 + 40) * 2);  // known columns, a margin of 20, two pixels per cell
  ASSERT_EQ(picture.height, (1 + 40) * 2);
  const auto pixel = [&](int x, int y) {
    const std::size_t i = (static_cast<std::size_t>(y) * static_cast<std::size_t>(picture.width) +
                           static_cast<std::size_t>(x)) *
                          3;
    return (picture.rgb[i] << 16) + (picture.rgb[i + 1] << 8) + picture.rgb[i + 2];
  };
  EXPECT_EQ(pixel((20 + 20) * 2, 40), 0x191c24);  // the wall at column 20
  EXPECT_EQ(pixel((20 + 18) * 2, 40), 0xffffff);  // free floor in front of it
  EXPECT_EQ(pixel(0, 0), 0xcbced2);               // unknown
  EXPECT_EQ(pixel((20 + 5) * 2, 40), 0x266edc);   // the path
}

TEST(DrawMap, DrawsAnEmptyMap) {
  const Picture picture = draw_map(OccupancyGrid(), {});
  EXPECT_GT(picture.width, 0);
  EXPECT_GT(picture.height, 0);
}

TEST(WritePng, FailsWithThePathThatItCannotWrite) {
  const dssm::Result<void> written = write_png(draw_map(OccupancyGrid(), {}), "/nowhere/map.png");
  ASSERT_FALSE(written);
  EXPECT_NE(written.error().message.find("'/nowhere/map.png'"), std::string::npos);
}

}  // namespace
}  // namespace vehicle
