// SPDX-License-Identifier: Apache-2.0
//
// The map as a picture: walls dark, free floor white, unknown ground grey, the vehicle's way blue
// from a green square to a red one, and a bar 5 m long in the lower left corner. One cell is two
// pixels wide; y points up. The same grid and way give the same file, byte for byte.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <string>
#include <vector>

#include "occupancy_grid.hpp"

namespace vehicle {

// Rows from the top, three bytes (red, green, blue) a pixel.
struct Picture {
  int width = 0, height = 0;
  std::vector<std::uint8_t> rgb;
};

// Shows the known part of `grid` and a margin. An empty grid gives a small grey picture.
Picture draw_map(const OccupancyGrid& grid, const std::vector<Pose2>& way);

// Writes a PNG file, whole or not at all: a viewer that has it open never sees half a picture.
dssm::Result<void> write_png(const Picture& picture, const std::string& path);

}  // namespace vehicle
