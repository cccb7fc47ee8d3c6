// SPDX-License-Identifier: Apache-2.0
//
// Draws pixel by pixel: with a graphics library, the bytes would also depend on its version. libpng
// writes the file.
#include "map_picture.hpp"

#include <png.h>

#include <algorithm>
#include <cmath>
#include <cstdio>
#include <cstdlib>

namespace vehicle {
namespace {

struct Colour {
  std::uint8_t red, green, blue;
};
constexpr Colour kUnknown{203, 206, 210};
constexpr Colour kFree{255, 255, 255};
constexpr Colour kWall{25, 28, 36};
constexpr Colour kWay{38, 110, 220};
constexpr Colour kStart{30, 150, 70};
constexpr Colour kEnd{210, 50, 50};

constexpr int kPixels = 2;        // per cell
constexpr int kMarginCells = 20;  // 1 m
constexpr double kBarM = 5;

// Maps the shown part of the grid to pixels, and draws.
class Canvas {
 public:
  explicit Canvas(OccupancyGrid::Box box) : box_(box) {
    if (box_.last_column < box_.first_column) {
      box_ = {OccupancyGrid::kSide / 2, OccupancyGrid::kSide / 2, OccupancyGrid::kSide / 2,
              OccupancyGrid::kSide / 2};
    }
    picture_.width = (box_.last_column - box_.first_column + 1 + 2 * kMarginCells) * kPixels;
    picture_.height = (box_.last_row - box_.first_row + 1 + 2 * kMarginCells) * kPixels;
    picture_.rgb.resize(static_cast<std::size_t>(picture_.width) *
                        static_cast<std::size_t>(picture_.height) * 3);
    fill(0, 0, picture_.width, picture_.height, kUnknown);
  }

  void cell(int column, int row, Colour colour) {
    const int x = (column - box_.first_column + kMarginCells) * kPixels;
    const int y = (box_.last_row - row + kMarginCells) * kPixels;
    fill(x, y, kPixels, kPixels, colour);
  }

  // A square of `size` pixels around a point on the floor.
  void dot(double x_m, double y_m, int size, Colour colour) {
    fill(x_of(x_m) - size / 2, y_of(y_m) - size / 2, size, size, colour);
  }

  void line(const Pose2& from, const Pose2& to, Colour colour) {
    const int steps = std::max(
        {1, std::abs(x_of(to.x_m) - x_of(from.x_m)), std::abs(y_of(to.y_m) - y_of(from.y_m))});
    for (int i = 0; i <= steps; ++i) {
      const double weight = static_cast<double>(i) / steps;
      dot(from.x_m + weight * (to.x_m - from.x_m), from.y_m + weight * (to.y_m - from.y_m), 2,
          colour);
    }
  }

  // The bar of kBarM with a tick at each end.
  void scale_bar() {
    const int length = static_cast<int>(kBarM / OccupancyGrid::kCellM) * kPixels;
    const int x = 12, y = picture_.height - 16;
    fill(x, y, length, 3, kWall);
    fill(x, y - 5, 3, 13, kWall);
    fill(x + length - 3, y - 5, 3, 13, kWall);
  }

  Picture take() { return std::move(picture_); }

 private:
  int x_of(double x_m) const { return pixel(x_m / OccupancyGrid::kCellM, box_.first_column); }
  int y_of(double y_m) const {
    return picture_.height - 1 - pixel(y_m / OccupancyGrid::kCellM, box_.first_row);
  }
  static int pixel(double cells, int first) {
    const double shown = cells + OccupancyGrid::kSide / 2.0 - first + kMarginCells;
    return static_cast<int>(std::floor(shown * kPixels));
  }

  void fill(int left, int top, int width, int height, Colour colour) {
    for (int y = std::max(top, 0); y < std::min(top + height, picture_.height); ++y) {
      for (int x = std::max(left, 0); x < std::min(left + width, picture_.width); ++x) {
        std::uint8_t* pixel =
            &picture_.rgb[(static_cast<std::size_t>(y) * static_cast<std::size_t>(picture_.width) +
                           static_cast<std::size_t>(x)) *
                          3];
        pixel[0] = colour.red, pixel[1] = colour.green, pixel[2] = colour.blue;
      }
    }
  }

  OccupancyGrid::Box box_;
  Picture picture_;
};

}  // namespace

Picture draw_map(const OccupancyGrid& grid, const std::vector<Pose2>& way) {
  const OccupancyGrid::Box box = grid.known();
  Canvas canvas(box);
  for (int row = box.first_row; row <= box.last_row; ++row) {
    for (int column = box.first_column; column <= box.last_column; ++column) {
      const OccupancyGrid::Cell cell = grid.at(column, row);
      if (cell == OccupancyGrid::Cell::free) canvas.cell(column, row, kFree);
      if (cell == OccupancyGrid::Cell::wall) canvas.cell(column, row, kWall);
    }
  }
  for (std::size_t i = 1; i < way.size(); ++i) canvas.line(way[i - 1], way[i], kWay);
  if (!way.empty()) {
    canvas.dot(way.front().x_m, way.front().y_m, 13, kStart);
    canvas.dot(way.back().x_m, way.back().y_m, 13, kEnd);
  }
  canvas.scale_bar();
  return canvas.take();
}

dssm::Result<void> write_png(const Picture& picture, const std::string& path) {
  const std::string what = "write the map '" + path + "'";
  const std::string unfinished = path + ".part";
  png_image image{};
  image.version = PNG_IMAGE_VERSION;
  image.width = static_cast<png_uint_32>(picture.width);
  image.height = static_cast<png_uint_32>(picture.height);
  image.format = PNG_FORMAT_RGB;
  if (!png_image_write_to_file(&image, unfinished.c_str(), 0, picture.rgb.data(), 0, nullptr)) {
    return dssm::Error{dssm::Errc::system, what + ": " + image.message +
                                               "; check that the folder exists and may be written"};
  }
  if (std::rename(unfinished.c_str(), path.c_str()) != 0) {
    dssm::Error error = dssm::os_error(what);
    (void)std::remove(unfinished.c_str());
    return error;
  }
  return {};
}

}  // namespace vehicle
