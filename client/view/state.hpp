// SPDX-License-Identifier: Apache-2.0
//
// The state of the vehicle, as dssmd knows it, collected once a second by a thread of its own:
// hosts and streams always, because from their changes follow the events; programs and doctor's
// findings only while clients ask for them. Or what a recording has of it.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <functional>
#include <map>
#include <mutex>
#include <optional>
#include <string>
#include <thread>
#include <utility>
#include <vector>

#include "client/dssmctl/black_box_streams.hpp"
#include "client/dssmctl/output.hpp"
#include "client/view/events.hpp"

namespace dssm::view {

struct TimeRange {
  Time first, last;
};

// NOLINTNEXTLINE(bugprone-exception-escape): the moves of Json throw nothing
struct VehicleState {
  std::string host;
  std::vector<StreamInfo> streams;
  std::vector<std::optional<Time>> oldest;  // of each stream: of its oldest sample, about
  std::vector<NodeInfo> nodes;
  std::optional<TimeRange> range;  // of all samples, about; empty: there are none
  bool has_all = false;            // also programs and findings are of now
  ctl::Json json;  // an answer to "overview" of the page's protocol (docs/view.md), without its id

  // What a reader of streams[i] has found. Not if its times ran backwards in between.
  void set_oldest(std::size_t i, Time time) {
    if (oldest[i] && time <= streams[i].newest_time) oldest[i] = time;
  }
};

// The range and the oldest times in `state.json` as `state.oldest` has them. The range is of the
// samples that are about now; if there are none, of all.
void show_oldest(VehicleState& state);

// The one that a recording shows: its streams, its triggers as events, its warnings as findings.
VehicleState recorded_state(const Recording& recording);
// Its warnings again: what is damaged in the midst of a file is found when that is read.
void show_warnings(const Recording& recording, VehicleState& state);

class StateCollector {
 public:
  StateCollector(Session session, std::string socket_path)
      : session_(std::move(session)), socket_path_(std::move(socket_path)) {}
  StateCollector(const StateCollector&) = delete;
  StateCollector& operator=(const StateCollector&) = delete;
  ~StateCollector();

  // From now on the thread calls `on_state` with each state. Once.
  void start(std::function<void(const VehicleState&)> on_state);

  // A client asks: all is collected, now if it was not for more than a second. Any thread.
  void want_all();

 private:
  static constexpr Duration kPeriod = std::chrono::seconds(1);
  static constexpr Duration kWantedTime = std::chrono::seconds(5);
  static constexpr Duration kFindingsPeriod = std::chrono::seconds(10);
  static constexpr std::size_t kMaxProbes = 32;  // in one turn; each opens a stream
  static constexpr Duration kRefusedPause = std::chrono::seconds(30);
  static constexpr int kMaxIncidents = 64;  // of one black box, in one turn

  // When the oldest sample of a stream is from.
  struct Probe {
    std::uint64_t incarnation;
    Tid oldest;
    MonoTime at;
    std::optional<Time> time;  // empty: it could not be read
  };

  void run();
  Result<void> collect(bool all);
  // A guess for each stream, and the true time for this PC's, if all is wanted.
  void find_oldest(bool all);
  void probe(const StreamInfo& stream);
  static bool is_due(const Probe& probe, const StreamInfo& stream);
  void find_incidents();
  void find_incidents(const StreamInfo& stream);

  Session session_;
  const std::string socket_path_;
  std::function<void(const VehicleState&)> on_state_;

  const Time started_ = WallClock::now();

  // The thread's.
  VehicleState state_;
  MonoTime next_findings_{};
  bool is_connected_ = true;
  std::map<std::string, Reader<ctl::RecordedIncident>> incidents_;  // of all black boxes
  std::map<std::string, Probe> probes_;                             // of streams of this PC
  Events events_;

  std::mutex mutex_;
  std::condition_variable changed_;
  MonoTime wanted_until_{};
  bool is_wanted_now_ = false;
  bool is_ending_ = false;
  std::thread thread_;
};

}  // namespace dssm::view
