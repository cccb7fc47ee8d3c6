// SPDX-License-Identifier: Apache-2.0
//
// Reports a PC's clock and DSSM's statements about clocks to lab/truth.py, which compares them with
// the true values.
//
//   fleet-clock PORT HOST...
//
// Writes the stream "truth" a hundred times a second, with this PC's clocks as payload, stamped
// like the samples of any program, and reads that stream of each other HOST. Answers each datagram
// "NUMBER STEP" at UDP PORT with JSON, see answer(). A STEP other than 0 first sets the wall clock
// forward by so many nanoseconds, or backward if negative.
//
// Prints "ready" on stdout before it writes. Ends when stdin ends. Exit status: 0; 1 with the
// reason on stderr.
#include <arpa/inet.h>
#include <poll.h>
#include <sys/socket.h>
#include <sys/timex.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <atomic>
#include <cerrno>
#include <cstdio>
#include <cstdlib>
#include <cstring>
#include <deque>
#include <dssm/clock.hpp>
#include <dssm/dssm.hpp>
#include <limits>
#include <memory>
#include <mutex>
#include <nlohmann/json.hpp>
#include <optional>
#include <string>
#include <thread>
#include <vector>

#include "core/base/unique_fd.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

constexpr Duration kPeriod = 10ms;
constexpr Duration kHistory = 10s;

struct Clocks {
  std::int64_t wall_ns = 0, mono_ns = 0;
  std::int64_t raw_ns = 0;     // CLOCK_MONOTONIC_RAW: never slewed or set
  std::int64_t within_ns = 0;  // between reading raw before and after the others
  std::int64_t instance = 0;   // differs between runs of this program, and after a sleep of the PC
};

std::int64_t now_ns(clockid_t clock) {
  timespec now{};
  ::clock_gettime(clock, &now);
  return std::int64_t{now.tv_sec} * 1'000'000'000 + now.tv_nsec;
}

std::int64_t raw_now_ns() { return now_ns(CLOCK_MONOTONIC_RAW); }

// How often the PC slept, as far as this program noticed: its raw and its monotonic clock stand
// still meanwhile. Each reading of two clocks bounds the time that it has slept since its boot.
std::int64_t sleeps() {
  static std::mutex mutex;
  static std::int64_t count = 0, least_ns = 0, most_ns = std::numeric_limits<std::int64_t>::max();
  const std::int64_t before = now_ns(CLOCK_MONOTONIC), boot = now_ns(CLOCK_BOOTTIME);
  const std::int64_t at_least = boot - now_ns(CLOCK_MONOTONIC), at_most = boot - before;
  const std::lock_guard lock(mutex);
  if (at_least > most_ns) {
    ++count;
    least_ns = at_least, most_ns = at_most;
  } else if (at_most >= least_ns) {  // else another thread has noticed a sleep meanwhile
    least_ns = std::max(least_ns, at_least), most_ns = std::min(most_ns, at_most);
  }
  return count;
}

// An interrupted reading is inaccurate, so it is repeated.
constexpr std::int64_t kQuickEnoughNs = 40'000;
constexpr int kMaxReadings = 5;

Clocks read_clocks() {
  static const std::int64_t start = to_ns(WallClock::now());
  Clocks best;
  for (int i = 0; i < kMaxReadings; ++i) {
    const std::int64_t before = raw_now_ns();
    const std::int64_t wall = to_ns(WallClock::now());
    const std::int64_t mono = MonoClock::now().time_since_epoch().count();
    const std::int64_t within = raw_now_ns() - before;
    if (i == 0 || within < best.within_ns)
      best = {wall, mono, before + within / 2, within, start + sleeps()};
    if (within < kQuickEnoughNs) break;
  }
  return best;
}

[[noreturn]] void fail(const std::string& what) {
  std::fprintf(stderr, "%s\n", what.c_str());
  std::exit(1);
}

// The stream of another host, opened as soon as possible.
class Other {
 public:
  Other(Session session, std::string host)
      : host_(std::move(host)), opening_([this, session = std::move(session)]() mutable {
          // Refused until both clocks are within bounds.
          reader_.emplace(session.await_reader<Clocks>("truth@" + host_).value());
          open_.store(true, std::memory_order_release);
        }) {
    opening_.detach();  // until the process ends
  }

  const std::string& host() const { return host_; }
  Reader<Clocks>* reader() { return open_.load(std::memory_order_acquire) ? &*reader_ : nullptr; }

 private:
  const std::string host_;
  std::optional<Reader<Clocks>> reader_;
  std::atomic<bool> open_ = false;
  std::thread opening_;
};

// -1: unknown.
std::int64_t known_ns(Duration error) { return error == kUnknownClockError ? -1 : error.count(); }

void put(nlohmann::json& to, const Clocks& clocks) {
  to["raw"] = clocks.raw_ns;
  to["within"] = clocks.within_ns;
  to["instance"] = clocks.instance;
}

// A sample, and DSSM's statement about its time on this PC.
nlohmann::json statement(const Reader<Clocks>& reader, ReadStatus status, const Clocks& sample,
                         const SampleInfo& info) {
  nlohmann::json out{{"status", name_of(status)}};
  if (status != ReadStatus::ok) return out;
  out["time"] = to_ns(info.time);
  put(out, sample);
  // Both by the same assessment: dssmd states a new one each second.
  Duration error, again = reader.clock_error(info);
  bool good = false;
  do {
    error = again;
    good = reader.clock_in_bounds(info);
    again = reader.clock_error(info);
  } while (again - error > 1us || again < error);
  out["error"] = known_ns(error);
  out["good"] = good;
  return out;
}

// A read that is refused if clocks may differ too much, and one that is never refused.
nlohmann::json statements(Reader<Clocks>& reader) {
  Clocks sample;
  SampleInfo info;
  ReadStatus status = reader.read_at(WallClock::now(), sample, info);
  nlohmann::json by_time = statement(reader, status, sample, info);
  status = reader.read_newest(sample, info);
  return {{"by_time", by_time}, {"newest", statement(reader, status, sample, info)}};
}

// The samples of all others at one time.
nlohmann::json joint_statement(const std::vector<Reader<Clocks>*>& readers) {
  std::vector<Clocks> samples(readers.size());
  std::vector<JointSample> joint;
  for (std::size_t i = 0; i < readers.size(); ++i)
    joint.push_back(readers[i]->joint_sample(samples[i]));
  const JointRead read = read_joint_at(WallClock::now(), joint, 1ms);
  nlohmann::json out{{"status", name_of(read.status)}, {"error", known_ns(read.clock_error)}};
  for (std::size_t i = 0; read.status == ReadStatus::ok && i < readers.size(); ++i) {
    nlohmann::json& of_one = out["samples"][readers[i]->id().host];
    of_one["time"] = to_ns(joint[i].info.time);
    put(of_one, samples[i]);
  }
  return out;
}

// {"number", "wall", "mono", "raw", "within", "instance": this PC's clocks after the request
// arrived,
//  "raw_end": raw clock when this is sent, "own": {"status", "error"},
//  "others": {HOST: {"by_time": SAMPLE, "newest": SAMPLE}},
//  "joint": {"status", "error", "samples": {HOST: SAMPLE}}}
// SAMPLE: {"status", "time", "raw", "within", "instance", "error", "good"}; the clocks are its
// writer's. Times and errors are in ns; an error of -1 is unknown. "joint" exists only when the
// streams of all others are open.
std::string answer(std::int64_t number, const Clocks& came, std::deque<Other>& others) {
  const clock::Reading own = clock::now();
  nlohmann::json out{
      {"number", number},
      {"wall", came.wall_ns},
      {"mono", came.mono_ns},
      {"own", {{"status", name_of(own.status)}, {"error", known_ns(own.clock_error)}}},
      {"others", nlohmann::json::object()}};
  put(out, came);
  std::vector<Reader<Clocks>*> readers;
  for (Other& other : others) {
    if (Reader<Clocks>* reader = other.reader()) {
      out["others"][other.host()] = statements(*reader);
      readers.push_back(reader);
    }
  }
  if (!readers.empty() && readers.size() == others.size()) out["joint"] = joint_statement(readers);
  out["raw_end"] = raw_now_ns();
  return out.dump();
}

void step(std::int64_t ns) {
  timex change{};
  change.modes = ADJ_SETOFFSET | ADJ_NANO;
  const std::int64_t second = 1'000'000'000;
  change.time.tv_sec = ns / second - (ns % second < 0 ? 1 : 0);
  change.time.tv_usec = (ns % second + second) % second;  // nanoseconds, by ADJ_NANO
  if (::adjtimex(&change) < 0) fail(std::string("cannot set the clock: ") + std::strerror(errno));
}

void answer_datagrams(int socket, std::deque<Other>& others) {
  for (;;) {
    std::array<char, 64> request{};
    sockaddr_in from{};
    socklen_t length = sizeof from;
    const ssize_t size = ::recvfrom(socket, request.data(), request.size() - 1, MSG_DONTWAIT,
                                    reinterpret_cast<sockaddr*>(&from), &length);
    if (size < 0) return;
    std::int64_t number = 0, ns = 0;
    if (std::sscanf(request.data(), "%ld %ld", &number, &ns) != 2) continue;
    if (ns) step(ns);
    const std::string out = answer(number, read_clocks(), others);
    ::sendto(socket, out.data(), out.size(), 0, reinterpret_cast<const sockaddr*>(&from), length);
  }
}

int run(std::uint16_t port, const std::vector<std::string>& hosts) {
  const UniqueFd socket(::socket(AF_INET, SOCK_DGRAM | SOCK_CLOEXEC, 0));
  sockaddr_in address{};
  address.sin_family = AF_INET;
  address.sin_port = htons(port);
  if (::bind(socket.get(), reinterpret_cast<const sockaddr*>(&address), sizeof address)) {
    fail("cannot listen at UDP port " + std::to_string(port) + ": " + std::strerror(errno));
  }
  Session session = Session::connect().value();
  Writer<Clocks> writer = session.create<Clocks>("truth", kHistory, kPeriod).value();
  std::deque<Other> others;
  for (const std::string& host : hosts) others.emplace_back(session, host);

  std::printf("ready\n");
  std::fflush(stdout);
  MonoTime due = MonoClock::now();
  for (;;) {
    std::array<pollfd, 2> ready{{{socket.get(), POLLIN, 0}, {STDIN_FILENO, POLLIN, 0}}};
    const Duration left = std::max(due - MonoClock::now(), Duration::zero());
    const timespec timeout{0, static_cast<long>(left.count())};
    ::ppoll(ready.data(), ready.size(), &timeout, nullptr);
    if (ready[1].revents) return 0;
    if (ready[0].revents) answer_datagrams(socket.get(), others);
    if (MonoClock::now() < due) continue;
    const Clocks sample = read_clocks();
    writer.write(sample, time_from_ns(sample.wall_ns));
    due = std::max(due + kPeriod, MonoClock::now());  // missed samples are not written later
  }
}

}  // namespace
}  // namespace dssm::test

int main(int argc, char** argv) {
  if (argc < 3) {
    std::fprintf(stderr, "usage: fleet-clock PORT HOST...\n");
    return 1;
  }
  const auto port = static_cast<std::uint16_t>(std::strtoul(argv[1], nullptr, 10));
  const int status = dssm::test::run(port, {argv + 2, argv + argc});
  std::_Exit(status);  // also ends threads that still wait for another host
}
