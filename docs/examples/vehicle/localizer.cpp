// SPDX-License-Identifier: Apache-2.0
//
// localizer: computes the vehicle's pose at the time of each scan. It follows the stream "lidar",
// reads the stream "odometry" at the time of each scan, and writes the stream "pose", stamped with
// the scan's time.
#include <CLI/CLI.hpp>
#include <cmath>
#include <cstdio>
#include <dssm/dssm.hpp>
#include <string>

#include "input.hpp"
#include "odometry_at.hpp"
#include "progress.hpp"
#include "samples.hpp"
#include "stop.hpp"

namespace {

int fail(const dssm::Error& error) {
  std::fprintf(stderr, "localizer: %s\n", error.message.c_str());
  return 1;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Reads the odometry at the time of each LIDAR scan and writes poses.");
  double deadline_s = 1;
  bool late = false, complete = false;
  app.add_option("--deadline", deadline_s, "seconds to wait for the odometry of a scan")
      ->check(CLI::Range(0.0, 3600.0))
      ->capture_default_str();
  app.add_flag("--late", late, "read the newest drive even if it is over");
  app.add_flag("--complete", complete, "end with status 3 when a scan got no pose");
  CLI11_PARSE(app, argc, argv);
  vehicle::stop_on_signals();
  vehicle::Progress progress("localizer");

  dssm::Result<dssm::Session> session = dssm::Session::connect();
  if (!session) return fail(session.error());
  auto scans = vehicle::open_when_there<vehicle::Scan>(*session, vehicle::kScanStream, progress);
  if (!scans) return fail(scans.error());
  if (!*scans) return 0;
  dssm::Reader<vehicle::Scan>& lidar = **scans;
  vehicle::seek_to_drive(lidar, late);
  // As many poses as the lidar keeps scans: a pose is useful while its scan exists.
  auto poses = session->create<vehicle::Pose>(vehicle::kPoseStream,
                                              dssm::History{lidar.depth(), lidar.cycle()});
  if (!poses) return fail(poses.error());
  auto readings = vehicle::open_when_there<Odometry>(*session, vehicle::kOdometryStream, progress);
  if (!readings) return fail(readings.error());
  if (!*readings) return 0;
  vehicle::OdometryAt odometry(std::move(**readings),
                               dssm::Duration(std::llround(deadline_s * 1e9)));

  std::size_t written = 0, without_odometry = 0;
  const auto summary = [&] {
    std::string text = std::to_string(written) + " poses";
    if (without_odometry) {
      text += ", " + std::to_string(without_odometry) + " scans without odometry";
    }
    if (lidar.lost_samples()) text += ", " + std::to_string(lidar.lost_samples()) + " scans missed";
    return text;
  };
  vehicle::Scan scan;
  vehicle::Pose last{};
  dssm::SampleInfo info;
  while (!vehicle::stop_requested()) {
    if (lidar.read_next(scan, info) != dssm::ReadStatus::ok) {
      (void)lidar.wait(vehicle::kSlice);
      continue;
    }
    if (scan.is_end()) break;
    if (const std::optional<vehicle::Pose2> pose = odometry.at(info.time)) {
      last = {pose->x_m, pose->y_m, pose->theta_rad, info.tid};
      poses->write(last, info.time);
      ++written;
    } else if (!vehicle::stop_requested()) {
      ++without_odometry;
    }
    progress.update(summary);
  }
  last.scan_tid = dssm::kNoTid;
  poses->write(last, info.time);  // the end mark
  progress.print(summary());
  return complete && without_odometry + lidar.lost_samples() > 0 ? vehicle::kIncompleteStatus : 0;
}
