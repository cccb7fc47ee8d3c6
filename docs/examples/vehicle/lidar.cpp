// SPDX-License-Identifier: Apache-2.0
//
// lidar: the vehicle's laser scanner, replayed from a recording into the stream "lidar".
//
// Uses <dssm/...>. Each scan is filled in place, without a copy: loan() returns the ring's next
// slot, and publish() makes it visible to readers. At the end of the recording, or after a signal
// to stop, the program writes an end mark (samples.hpp).
#include <CLI/CLI.hpp>
#include <algorithm>
#include <cmath>
#include <cstdio>
#include <dssm/dssm.hpp>
#include <string>

#include "carmen_log.hpp"
#include "progress.hpp"
#include "replay.hpp"
#include "samples.hpp"
#include "stop.hpp"

namespace {

// Mean interval of the recording's scans.
constexpr double kCycleS = 0.22;

int fail(const dssm::Error& error) {
  std::fprintf(stderr, "lidar: %s\n", error.message.c_str());
  return 1;
}

// Angle between beams. Lasers of this kind scan a half circle, from 90 degrees to the right to 90
// degrees to the left; the last beam is at the left end only if their number is odd (181, 361).
float step_rad(std::size_t beams) {
  return static_cast<float>(M_PI / static_cast<double>(beams % 2 == 0 ? beams : beams - 1));
}

// Fills the ring's next slot and publishes it. A null `reading` gives the end mark.
void publish(dssm::Writer<vehicle::Scan>& writer, const vehicle::ScanReading* reading,
             dssm::Time time) {
  dssm::LoanedSample loan = writer.loan();  // cannot fail: there is no other loan
  vehicle::Scan& scan = dssm::Writer<vehicle::Scan>::view(loan);
  scan = {};
  if (reading) {
    scan.beams = static_cast<std::int32_t>(reading->ranges_m.size());
    scan.first_rad = static_cast<float>(-M_PI / 2);
    scan.step_rad = step_rad(reading->ranges_m.size());
    std::copy(reading->ranges_m.begin(), reading->ranges_m.end(), scan.range_m);
  }
  loan.publish(time);
}

}  // namespace

int main(int argc, char** argv) {
  CLI::App app("Replays a recording's LIDAR scans into the stream 'lidar'.");
  vehicle::ReplayOptions options;
  options.add_to(app);
  CLI11_PARSE(app, argc, argv);
  vehicle::stop_on_signals();
  vehicle::Progress progress("lidar");

  const dssm::Result<vehicle::Replay> replay = vehicle::Replay::from(options);
  if (!replay) return fail(replay.error());
  const dssm::Result<vehicle::CarmenLog> log = vehicle::read_carmen_log(options.log);
  if (!log) return fail(log.error());
  progress.print(log->summary());

  dssm::Result<dssm::Session> session = dssm::Session::connect();
  if (!session) return fail(session.error());
  const auto in_stamps = [&](double log_s) {
    return dssm::Duration(std::llround(replay->in_stamps(log_s) * 1e9));
  };
  dssm::Result<dssm::Writer<vehicle::Scan>> writer = session->create<vehicle::Scan>(
      vehicle::kScanStream, in_stamps(options.life_s), in_stamps(kCycleS));
  if (!writer) return fail(writer.error());

  std::size_t written = 0;
  dssm::Time newest = replay->stamp(options.from_s);
  for (const vehicle::ScanReading& reading : log->scans) {
    if (reading.time_s < options.from_s || reading.time_s > options.to_s) continue;
    if (!replay->wait_until(reading.time_s)) break;
    newest = replay->stamp(reading.time_s);
    publish(*writer, &reading, newest);
    ++written;
    progress.update([&] {
      return "second " + std::to_string(std::lround(reading.time_s)) + " of the recording, " +
             std::to_string(written) + " scans";
    });
  }
  // Later than the last scan, so that a read at that scan's time does not return the mark.
  publish(*writer, nullptr, newest + std::chrono::milliseconds(1));
  progress.print(std::to_string(written) + " scans written");
  return 0;
}
