// SPDX-License-Identifier: Apache-2.0
//
// encoder: the vehicle's wheel encoders, replayed from a recording into the stream "odometry".
//
// This is an SSM program: it uses only <ssm.hpp>, as the sensor handlers of existing vehicles do.
// Linked with libssm, it shares its samples through DSSM.
//
// A real encoder has a constant rate that does not depend on the LIDAR. But the recording has about
// five readings a second, each with exactly the stamp of a scan. So this program interpolates the
// recorded motion every --cycle seconds. `--cycle 0` replays the readings as they were recorded.
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <ssm.hpp>
#include <string>
#include <vector>

#include "carmen_log.hpp"
#include "odometry.hpp"
#include "progress.hpp"
#include "replay.hpp"
#include "resample.hpp"
#include "stop.hpp"

namespace {

// Median interval of the recording's readings; sizes the ring with --cycle 0.
constexpr double kRecordedCycleS = 0.2;

int fail(const std::string& message) {
  std::fprintf(stderr, "encoder: %s\n", message.c_str());
  return 1;
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Replays a recording's odometry into the stream 'odometry'.");
  vehicle::ReplayOptions options;
  options.add_to(app);
  double cycle_s = 0.05;
  app.add_option("--cycle", cycle_s, "seconds between samples; 0: as recorded")
      ->check(CLI::Range(0.0, 10.0))
      ->capture_default_str();
  CLI11_PARSE(app, argc, argv);
  vehicle::stop_on_signals();
  vehicle::Progress progress("encoder");

  const dssm::Result<vehicle::Replay> replay = vehicle::Replay::from(options);
  if (!replay) return fail(replay.error().message);
  const dssm::Result<vehicle::CarmenLog> log = vehicle::read_carmen_log(options.log);
  if (!log) return fail(log.error().message);
  const std::vector<vehicle::OdometryReading> readings =
      cycle_s > 0 ? vehicle::resample(log->odometry, cycle_s) : log->odometry;
  const vehicle::Span part = vehicle::span_around(readings, options.from_s, options.to_s);
  progress.print(log->summary());

  if (!initSSM()) return fail("cannot reach dssmd (see above); start it, then try again");
  SSMApi<Odometry> odometry("odometry", 0);
  const double ring_cycle_s = replay->in_stamps(cycle_s > 0 ? cycle_s : kRecordedCycleS);
  if (!odometry.create(replay->in_stamps(options.life_s), ring_cycle_s)) {
    endSSM();
    return fail("cannot create the stream 'odometry' (see above)");
  }

  std::size_t written = 0;
  for (std::size_t i = part.begin; i < part.end; ++i) {
    const vehicle::OdometryReading& reading = readings[i];
    if (!replay->wait_until(reading.time_s)) break;
    odometry.data.x_m = reading.pose.x_m;
    odometry.data.y_m = reading.pose.y_m;
    odometry.data.theta_rad = reading.pose.theta_rad;
    const double stamp_s = static_cast<double>(dssm::to_ns(replay->stamp(reading.time_s))) / 1e9;
    if (!odometry.write(stamp_s)) {
      endSSM();
      return fail("cannot write to the stream 'odometry'");
    }
    ++written;
    progress.update([&] {
      return "second " + std::to_string(std::lround(reading.time_s)) + " of the recording, " +
             std::to_string(written) + " samples";
    });
  }
  progress.print(std::to_string(written) + " samples written");
  odometry.release();
  endSSM();
  return 0;
}
