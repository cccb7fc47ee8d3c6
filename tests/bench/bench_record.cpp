// SPDX-License-Identifier: Apache-2.0
//
// `dssmctl record` beside the programs that write: its processor time, what it lost, and how long
// their writes take. First 100 streams of 64 B at 1 kHz and a camera of 640 x 480 x 3 bytes at
// 30 Hz, then samples of 1 MiB at 500 MB/s. The raw limit is a process that writes as many bytes of
// its own memory to the same disk at the same rate: each 100 ms, synced each second, as the
// recorder does. The files are in $TMPDIR.
#include <fcntl.h>
#include <unistd.h>

#include <cinttypes>
#include <csignal>
#include <cstdlib>
#include <dssm/dssm.hpp>
#include <dssm/recording.hpp>
#include <filesystem>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kRounds = 5;
constexpr Duration kRoundTime = 3s;
constexpr Duration kPiece = 100ms;

// Writes to all streams of a workload, once per cycle.
struct Workload {
  std::vector<RawWriter> writers;
  std::vector<Duration> cycles;
  std::uint64_t bytes_per_second = 0;

  void add(Session& session, const std::string& name, std::size_t bytes, Duration cycle,
           Duration history) {
    const auto depth = static_cast<std::uint64_t>(history / cycle);
    writers.push_back(
        session.create_raw({name, 0, ""}, {"bench.bytes", bytes, 1, {}}, {depth, cycle}).value());
    cycles.push_back(cycle);
    bytes_per_second += bytes * static_cast<std::uint64_t>(1s / cycle);
  }

  // For kRoundTime; returns how long the writes of the first stream took.
  std::vector<double> run() {
    static const std::vector<std::byte> payload(1U << 20);
    std::vector<double> times;
    std::vector<MonoTime> next(writers.size(), MonoClock::now());
    const MonoTime end = MonoClock::now() + kRoundTime;
    for (MonoTime tick = MonoClock::now(); tick < end; tick += 1ms) {
      sleep_until(tick);
      for (std::size_t i = 0; i < writers.size(); ++i) {
        if (next[i] > tick) continue;
        next[i] += cycles[i];
        const std::int64_t began = now_ns();
        if (writers[i].write(std::span(payload).first(writers[i].payload_bytes())) == kNoTid) {
          fail("write a sample");
        }
        if (i == 0) times.push_back(static_cast<double>(now_ns() - began));
      }
    }
    return times;
  }
};

struct Copier {
  static constexpr const char* kName = "raw copy";
  pid_t start(const std::string& file, const Workload& load) const {
    return in_child([&] {
      const std::size_t bytes = load.bytes_per_second / static_cast<std::uint64_t>(1s / kPiece);
      const std::vector<std::byte> memory(bytes, std::byte{1});
      const int fd = ::open(file.c_str(), O_CREAT | O_TRUNC | O_WRONLY | O_CLOEXEC, 0600);
      MonoTime next = MonoClock::now();
      for (std::uint64_t piece = 1;; ++piece) {
        if (::write(fd, memory.data(), bytes) != static_cast<ssize_t>(bytes)) fail("write");
        if (piece % static_cast<std::uint64_t>(1s / kPiece) == 0) ::fdatasync(fd);
        sleep_until(next += kPiece);
      }
    });
  }
};

// Runs the workload with each of: nothing, the raw copy, the recorder.
void compare(const std::string& name, test::DaemonProcess& daemon, Session& session, Workload& load,
             const std::string& folder, const std::vector<std::string>& kinds) {
  std::printf("%s, %.1f MB/s\n", name.c_str(), static_cast<double>(load.bytes_per_second) / 1e6);
  const std::string file = folder + "/recording.mcap";
  const StreamId last = load.writers.back().id();
  std::vector<double> raw_cpu, alone;
  std::vector<std::vector<double>> cpu(kinds.size()), beside(kinds.size());
  std::vector<std::uint64_t> lost(kinds.size()), recorded(kinds.size());
  const auto append = [](std::vector<double>& to, const std::vector<double>& from) {
    to.insert(to.end(), from.begin(), from.end());
  };
  // Processor time per second of `pid`, in ms, while the workload runs.
  const auto run_beside = [&](pid_t pid, std::vector<double>& times) {
    const std::int64_t before = cpu_ns(pid);
    append(times, load.run());
    return static_cast<double>(cpu_ns(pid) - before) / 1e6 /
           std::chrono::duration<double>(kRoundTime).count();
  };
  for (int round = 0; round < kRounds; ++round) {
    append(alone, load.run());
    std::vector<double> unused;
    const pid_t copier = Copier().start(file, load);
    raw_cpu.push_back(run_beside(copier, unused));
    end_child(copier);
    for (std::size_t i = 0; i < kinds.size(); ++i) {
      std::filesystem::remove(file);
      const pid_t recorder = test::start(
          {test::built("client/dssmctl/dssmctl"), "record", "-o", file, "--compression", kinds[i]},
          {daemon.environment()}, ::open("/dev/null", O_WRONLY));
      while (session.stream_info(last).value().readers == 0) sleep_until(MonoClock::now() + 10ms);
      cpu[i].push_back(run_beside(recorder, beside[i]));
      ::kill(recorder, SIGINT);
      test::wait_for(recorder);
      for (const auto& stream : Recording::open(file).value().streams()) {
        lost[i] += stream.lost_samples, recorded[i] += stream.samples;
      }
    }
  }
  print_row("  64 B or 1 MiB write, no recorder [ns]", figures_of(alone));
  const Figures raw = figures_of(raw_cpu);
  print_row("  raw copy, CPU per second [ms]", raw);
  for (std::size_t i = 0; i < kinds.size(); ++i) {
    print_row("write, beside the recorder, " + kinds[i] + " [ns]", figures_of(beside[i]));
    const Figures ours = figures_of(cpu[i]);
    char rest[120];
    std::snprintf(rest, sizeof rest, "%7.2f  recorded %" PRIu64 ", lost %" PRIu64,
                  ours.median / raw.median, recorded[i], lost[i]);
    print_row("record, " + kinds[i] + ", CPU per second [ms]", ours, rest);
  }
}

}  // namespace

int main() {
  const char* temporary = std::getenv("TMPDIR");
  std::string folder = std::string(temporary ? temporary : "/tmp") + "/bench-record-XXXXXX";
  if (::mkdtemp(folder.data()) == nullptr) return 1;
  test::DaemonProcess daemon;
  Session session = Session::connect({.socket_path = daemon.socket_path()}).value();
  print_head();
  {
    Workload load;
    for (int i = 0; i < 100; ++i) load.add(session, "small" + std::to_string(i), 64, 1ms, 1s);
    load.add(session, "camera", 640 * 480 * 3, 33ms, 330ms);
    compare("100 streams at 1 kHz and a camera", daemon, session, load, folder, {"none", "lz4"});
  }
  for (const StreamInfo& stream : session.list_streams().value()) (void)session.remove(stream.id);
  {
    Workload load;
    load.add(session, "large", 1U << 20, 2ms, 500ms);
    compare("samples of 1 MiB", daemon, session, load, folder, {"none"});
  }
  std::filesystem::remove_all(folder);
  return 0;
}
