// SPDX-License-Identifier: Apache-2.0
//
// The map as a picture: walls are dark, free floor is white, unknown floor is grey. The vehicle's
// path is blue, from a green square to a red one. The bar in the lower left corner is 5 m long. One
// cell is two pixels wide; y points up. The same grid and path give the same file, byte for byte.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <string>
#include <vector>

#include "occupancy_grid.hpp"

namespace vehicle {

// Rows from top to bottom, three bytes (red, green, blue) per pixel.
struct Picture {
  int width = 0, height = 0;
  std::vector<std::uint8_t> rgb;
};

// Draws the known part of `grid` with a margin. An empty grid gives a small grey picture.
Picture draw_map(const OccupancyGrid& grid, const std::vector<Pose2>& way);

// Writes a PNG file and replaces an old one in one step: a viewer never sees half a picture.
dssm::Result<void> write_png(const Picture& picture, const std::string& path);

}  // namespace vehicle
