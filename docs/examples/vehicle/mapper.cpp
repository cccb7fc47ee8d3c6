// SPDX-License-Identifier: Apache-2.0
//
// mapper: draws the walls that the LIDAR saw and the path of the vehicle. It follows the stream
// "pose", reads the scan of each pose from "lidar" by time, and writes a picture at the end of the
// drive: at the end mark, after some seconds without a pose, or after a signal to stop.
#include <CLI/CLI.hpp>
#include <cmath>
#include <cstdio>
#include <dssm/dssm.hpp>
#include <string>
#include <vector>

#include "input.hpp"
#include "map_picture.hpp"
#include "occupancy_grid.hpp"
#include "progress.hpp"
#include "samples.hpp"
#include "scan_at.hpp"
#include "stop.hpp"

namespace {

int fail(const dssm::Error& error) {
  std::fprintf(stderr, "mapper: %s\n", error.message.c_str());
  return 1;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Draws a map from poses and LIDAR scans.");
  std::string out = "map.png";
  double timeout_s = 10, deadline_s = 1;
  bool late = false, complete = false;
  app.add_option("--out", out, "the picture to write (PNG)")->capture_default_str();
  app.add_option("--timeout", timeout_s, "seconds without a pose after which the drive is over")
      ->check(CLI::Range(0.1, 86400.0))
      ->capture_default_str();
  app.add_option("--deadline", deadline_s, "seconds to wait for the scan of a pose")
      ->check(CLI::Range(0.0, 3600.0))
      ->capture_default_str();
  app.add_flag("--late", late, "read the newest drive even if it is over");
  app.add_flag("--complete", complete, "end with status 3 when a pose or its scan was missed");
  CLI11_PARSE(app, argc, argv);
  vehicle::stop_on_signals();
  vehicle::Progress progress("mapper");
  const dssm::Duration timeout(std::llround(timeout_s * 1e9));

  dssm::Result<dssm::Session> session = dssm::Session::connect();
  if (!session) return fail(session.error());
  auto pose_reader =
      vehicle::open_when_there<vehicle::Pose>(*session, vehicle::kPoseStream, progress);
  if (!pose_reader) return fail(pose_reader.error());
  if (!*pose_reader) return 0;
  dssm::Reader<vehicle::Pose>& poses = **pose_reader;
  vehicle::seek_to_drive(poses, late);
  auto scan_reader =
      vehicle::open_when_there<vehicle::Scan>(*session, vehicle::kScanStream, progress);
  if (!scan_reader) return fail(scan_reader.error());
  if (!*scan_reader) return 0;
  vehicle::ScanAt scans(std::move(**scan_reader), dssm::Duration(std::llround(deadline_s * 1e9)));

  vehicle::OccupancyGrid grid;
  std::vector<vehicle::Pose2> way;
  std::size_t without_scan = 0;
  const auto summary = [&] {
    std::string text = std::to_string(way.size()) + " scans drawn";
    if (without_scan) text += ", " + std::to_string(without_scan) + " poses without their scan";
    if (poses.lost_samples()) text += ", " + std::to_string(poses.lost_samples()) + " poses missed";
    return text;
  };
  vehicle::Pose pose;
  vehicle::Scan scan;
  dssm::SampleInfo pose_info;
  dssm::MonoTime deadline = dssm::kNever;  // no timeout before the first pose
  while (!vehicle::stop_requested()) {
    if (poses.read_next(pose, pose_info) != dssm::ReadStatus::ok) {
      if (dssm::MonoClock::now() >= deadline) {
        progress.print("no pose for " + std::to_string(std::lround(timeout_s)) +
                       " s and no end mark: the map shows the poses until then");
        break;
      }
      (void)poses.wait(vehicle::kSlice);
      continue;
    }
    deadline = dssm::deadline_in(timeout);
    if (pose.is_end()) break;
    if (scans.at(pose_info.time, pose.scan_tid, scan)) {
      const vehicle::Pose2 laser{pose.x_m, pose.y_m, pose.theta_rad};
      grid.add(laser, {scan.ranges(), scan.first_rad, scan.step_rad});
      way.push_back(laser);
    } else if (!vehicle::stop_requested()) {
      ++without_scan;
    }
    progress.update(summary);
  }

  if (dssm::Result<void> written = vehicle::write_png(vehicle::draw_map(grid, way), out);
      !written) {
    return fail(written.error());
  }
  progress.print(summary() + "; " + std::to_string(grid.count(vehicle::OccupancyGrid::Cell::wall)) +
                 " wall cells; the map is in '" + out + "'");
  return complete && without_scan + poses.lost_samples() > 0 ? vehicle::kIncompleteStatus : 0;
}
