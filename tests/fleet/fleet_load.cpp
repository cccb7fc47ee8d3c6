// SPDX-License-Identifier: Apache-2.0
//
// The load of the fleet's scenarios: writes or reads streams, and checks every sample.
//
//   fleet-load write RATE_HZ STREAM@HOST...   creates them and writes each at this rate
//   fleet-load read RATE_HZ STREAM@HOST...    reads each from its oldest sample on
//   fleet-load film RATE_HZ STREAM@HOST...    creates them and writes images into each, with the
//                                             time of the clock
//   fleet-load look RATE_HZ STREAM@HOST       reads the newest image 1,000 times a second
//
// Prints "ready" on stdout after the first sample of each stream, and for each byte on stdin the
// number of samples written or read so far; "look" prints the ages in us that it saw since the
// byte before: "MEDIAN P99". Ends when stdin ends; readers first read all samples written until
// then. The last line is JSON:
//
//   write  {"written": {STREAM: COUNT}}; film, too
//   look   {}
//   read   {"faults": TEXT, "streams": {STREAM: {"taken": N, "lost": N, "restarts": N}},
//           "silences_ms": {STREAM: [N]}}
//
// Silences are the times without a new sample, from 400 ms on, in their order.
// A fault is a sample that was torn, read twice, out of order, or lost without being counted.
// Exit status: 0; 1 with the reason on stderr.
#include <poll.h>
#include <unistd.h>

#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <ctime>
#include <dssm/dssm.hpp>
#include <functional>
#include <nlohmann/json.hpp>
#include <numeric>
#include <thread>
#include <utility>

#include "tests/process/network/follower.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

constexpr std::uint64_t kPayloadBytes = 256;
constexpr std::uint64_t kImageBytes = 640ULL * 480 * 3;
constexpr std::uint64_t kHistorySeconds = 20, kImageSeconds = 5;
constexpr Duration kLeastSilence = 400ms;

KnownStream known_stream(const std::string& name, std::uint64_t rate_hz) {
  KnownStream known;
  known.id = StreamId::parse(name).value();
  known.payload_bytes = kPayloadBytes;
  known.depth = kHistorySeconds * rate_hz;
  known.cycle = Duration(1s) / static_cast<std::int64_t>(rate_hz);
  known.number = std::hash<std::string>()(known.id.str());
  return known;
}

void print(const std::string& line) {
  std::printf("%s\n", line.c_str());
  std::fflush(stdout);
}

// Answers a request on stdin, if there is one, with what it says. Returns whether stdin has ended.
bool stdin_ended(const std::function<std::string()>& answer) {
  pollfd in{STDIN_FILENO, POLLIN, 0};
  if (::poll(&in, 1, 0) <= 0) return false;
  char request = 0;
  if (::read(STDIN_FILENO, &request, 1) != 1) return true;
  print(answer());
  return false;
}

void write(const std::vector<KnownStream>& streams, bool by_the_clock) {
  Session session = Session::connect().value();
  std::vector<RawWriter> writers;
  for (const KnownStream& known : streams) {
    writers.push_back(session.create_raw(known.id, known.type(), known.history()).value());
  }
  // Greater with each writer of a stream, so that readers can distinguish their samples.
  const auto life = static_cast<std::uint64_t>(std::time(nullptr));
  std::vector<std::byte> payload(streams[0].payload_bytes);
  MonoTime due = MonoClock::now();
  Tid tid = 0;
  const auto moved = [&] {
    return std::to_string(static_cast<std::uint64_t>(tid) * streams.size());
  };
  for (; !stdin_ended(moved); ++tid, due += streams[0].cycle) {
    std::this_thread::sleep_until(due);
    for (std::size_t i = 0; i < streams.size(); ++i) {
      streams[i].fill(payload, life, tid);
      SampleInfo info = streams[i].info(tid);
      if (by_the_clock) info.time = WallClock::now();
      if (writers[i].write(payload, info.time, info.clock_error) != tid) {
        std::fprintf(stderr, "'%s' existed already\n", streams[i].id.str().c_str());
        std::exit(1);
      }
    }
    if (tid == 0) print("ready");
  }
  nlohmann::json written;
  for (const RawWriter& writer : writers) written[writer.id().str()] = writer.newest_tid() + 1;
  print(nlohmann::json{{"written", written}}.dump());
}

// The times in which one stream brought nothing new.
class Silences {
 public:
  void update(std::uint64_t taken) {
    const MonoTime now = MonoClock::now();
    if (taken == taken_) return;
    const Duration silent = now - since_;
    if (taken_ > 0 && silent >= kLeastSilence) {
      found_ms_.push_back(std::chrono::duration_cast<std::chrono::milliseconds>(silent).count());
    }
    taken_ = taken;
    since_ = now;
  }
  const std::vector<std::int64_t>& found_ms() const { return found_ms_; }

 private:
  std::uint64_t taken_ = 0;
  MonoTime since_{};
  std::vector<std::int64_t> found_ms_;
};

void read(const std::vector<KnownStream>& streams) {
  Session session = Session::connect({.request_timeout = 60s}).value();
  std::vector<Follower> followers;
  for (const KnownStream& known : streams) {
    followers.emplace_back(known, session.await_raw_reader(known.id, kNever).value(), std::nullopt);
  }
  std::vector<RawReader*> readers;
  for (Follower& follower : followers) readers.push_back(&follower.reader());
  std::vector<Silences> silences(followers.size());
  const auto take = [&] {
    (void)wait_any(readers, deadline_in(100ms));
    for (std::size_t i = 0; i < followers.size(); ++i) {
      followers[i].take(1000);
      silences[i].update(followers[i].taken());
    }
  };
  const auto all = [&](auto condition) {
    return std::all_of(followers.begin(), followers.end(), condition);
  };
  const auto moved = [&] {
    return std::to_string(std::accumulate(
        followers.begin(), followers.end(), std::uint64_t{0},
        [](std::uint64_t sum, const Follower& follower) { return sum + follower.taken(); }));
  };
  while (!all([](const Follower& follower) { return follower.taken() > 0; })) take();
  print("ready");
  while (!stdin_ended(moved)) take();
  for (Follower& follower : followers) {
    const Tid newest = session.stream_info(follower.known().id).value().newest;
    while (follower.last() < newest) take();
  }
  nlohmann::json found, silent;
  std::string text;
  for (std::size_t i = 0; i < followers.size(); ++i) {
    const Follower& follower = followers[i];
    const std::string stream = follower.known().id.str();
    text += follower.faults();
    found[stream] = {
        {"taken", follower.taken()}, {"lost", follower.lost()}, {"restarts", follower.restarts()}};
    silent[stream] = silences[i].found_ms();
  }
  print(nlohmann::json{{"faults", text}, {"streams", found}, {"silences_ms", silent}}.dump());
}

void look(const KnownStream& known) {
  Session session = Session::connect({.request_timeout = 60s}).value();
  RawReader reader =
      session.await_raw_reader(known.id, kNever, nullptr, FetchHistory::at_once).value();
  std::vector<std::byte> payload(known.payload_bytes);
  std::vector<std::int64_t> ages_us;
  const auto answer = [&] {
    std::sort(ages_us.begin(), ages_us.end());
    const auto at = [&](std::size_t percent) {
      return std::to_string(ages_us[(ages_us.size() - 1) * percent / 100]);
    };
    const std::string text = ages_us.empty() ? "" : at(50) + " " + at(99);
    ages_us.clear();
    return text;
  };
  SampleInfo info;
  bool is_ready = false;
  while (!stdin_ended(answer)) {
    if (reader.read_newest(payload, info) == ReadStatus::ok) {
      ages_us.push_back(
          std::chrono::duration_cast<std::chrono::microseconds>(WallClock::now() - info.time)
              .count());
      if (!std::exchange(is_ready, true)) print("ready");
    }
    std::this_thread::sleep_for(1ms);
  }
  print("{}");
}

}  // namespace
}  // namespace dssm::test

int main(int argc, char** argv) {
  using namespace dssm::test;
  const std::string mode = argc > 3 ? argv[1] : "";
  const bool with_images = mode == "film" || mode == "look";
  if (mode != "write" && mode != "read" && !with_images) {
    std::fprintf(stderr, "usage: fleet-load write|read|film|look RATE_HZ STREAM@HOST...\n");
    return 1;
  }
  const std::uint64_t rate_hz = std::strtoull(argv[2], nullptr, 10);
  std::vector<KnownStream> streams;
  for (int i = 3; i < argc; ++i) {
    streams.push_back(known_stream(argv[i], rate_hz));
    if (!with_images) continue;
    streams.back().payload_bytes = kImageBytes;
    streams.back().depth = kImageSeconds * rate_hz;
  }
  if (mode == "read") {
    read(streams);
  } else if (mode == "look") {
    look(streams[0]);
  } else {
    write(streams, mode == "film");
  }
}
