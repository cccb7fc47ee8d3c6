// SPDX-License-Identifier: Apache-2.0
//
// For how long a reader on another host gets no sample of a stream at 1 kHz when the owner's dssmd
// is restarted, or killed and started again; beside the time that dssmd itself needs to be ready.
#include <dssm/dssm.hpp>
#include <string>
#include <vector>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kRounds = 20;

struct Shared {
  std::atomic<std::uint64_t> arrived{0}, lost{0};
  std::atomic<std::int64_t> longest_ns{0};
  std::atomic<bool> ended{false};
};

[[noreturn]] void write(const std::string& socket) {
  Session session = Session::connect({.socket_path = socket}).value();
  RawWriter writer =
      session.create_raw({"chain", 0, ""}, {"", 64, 1, {}}, History{10'000, 1ms}).value();
  const std::vector<std::byte> payload(writer.payload_bytes());
  for (MonoTime next = MonoClock::now();;) {
    sleep_until(next += 1ms);
    writer.write(payload);
  }
}

[[noreturn]] void read(const std::string& socket, Shared& out) {
  Session session = Session::connect({.socket_path = socket}).value();
  RawReader reader = session.await_raw_reader(StreamId{"chain", 0, "pc1"}, kNever).value();
  std::vector<std::byte> payload(reader.payload_bytes());
  SampleInfo info;
  std::int64_t last_ns = now_ns();
  for (;;) {
    static_cast<void>(reader.wait(kNever));
    while (reader.read_next(payload, info) == ReadStatus::ok) {
      const std::int64_t now = now_ns();
      out.longest_ns = std::max(out.longest_ns.load(), now - last_ns);
      last_ns = now;
      ++out.arrived;
    }
    out.lost = reader.lost_samples();
  }
}

void await_samples(const Shared& shared, std::uint64_t count) {
  const std::uint64_t from = shared.arrived;
  while (shared.arrived < from + count) ::usleep(1000);
}

void measure(const char* name, Shared& shared, test::DaemonProcess& owner, bool is_killed) {
  std::vector<double> silent_ns, start_ns;
  for (int round = 0; round < kRounds; ++round) {
    await_samples(shared, 1000);
    shared.longest_ns = 0;
    if (is_killed) {
      owner.kill_hard();
    } else {
      owner.stop();
    }
    const std::int64_t begin = now_ns();
    owner.start();
    start_ns.push_back(static_cast<double>(now_ns() - begin));
    await_samples(shared, 1000);
    silent_ns.push_back(static_cast<double>(shared.longest_ns));
  }
  const Figures silent = figures_of(silent_ns), start = figures_of(start_ns);
  std::printf("%-24s %8.1f %8.1f %8.1f   %8.1f %8.1f %8.1f   %6.2f\n", name, silent.min / 1e6,
              silent.median / 1e6, silent.p99 / 1e6, start.min / 1e6, start.median / 1e6,
              start.p99 / 1e6, silent.median / start.median);
}

}  // namespace

int main() {
  test::DaemonProcess owner({"--log-level", "error"}, "pc1");
  const test::DaemonProcess other({"--log-level", "error", "--peer", owner.address()}, "pc2");
  auto& result = shared<Shared>();
  const std::string here = owner.socket_path(), there = other.socket_path();
  const pid_t writer = in_child([&] { write(here); });
  const pid_t reader = in_child([&] { read(there, result); });
  std::printf("%-24s %8s %8s %8s   %8s %8s %8s   %6s\n", "ms without a sample; to start", "minimum",
              "median", "longest", "minimum", "median", "longest", "ratio");
  measure("dssmd restarted", result, owner, false);
  measure("dssmd killed, started", result, owner, true);
  std::printf("lost: %llu\n", static_cast<unsigned long long>(result.lost.load()));
  end_child(reader);
  end_child(writer);
}
