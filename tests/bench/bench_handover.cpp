// SPDX-License-Identifier: Apache-2.0
//
// From one process to another: waking a sleeping reader 1,000 times a second, compared with a bare
// futex; and passing a sample to a spinning reader, compared with a bare cache line.
#include <linux/futex.h>
#include <sched.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <climits>
#include <csignal>
#include <dssm/dssm.hpp>

#include "tests/bench/harness.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

constexpr int kWakes = 3000;
constexpr int kRounds = 200'000;

// Shared between this process and its child.
struct Shared {
  alignas(64) std::atomic<std::uint32_t> word{0};
  alignas(64) std::int64_t sent_ns = 0;
  alignas(64) std::atomic<std::int64_t> ball{0};
  alignas(64) double raw_wake_ns[kWakes];
  double our_wake_ns[kWakes];
};

void pin(int cpu) {
  cpu_set_t set;
  CPU_ZERO(&set);
  CPU_SET(static_cast<unsigned>(cpu), &set);
  ::sched_setaffinity(0, sizeof set,
                      &set);  // without affinity, or with one core, results are only noisier
}

long futex(std::atomic<std::uint32_t>& word, int operation, std::uint32_t value) {
  return ::syscall(SYS_futex, &word, operation, value, nullptr, nullptr, 0);
}

struct Ball {
  std::int64_t number;
  std::byte rest[56];
};

// The child: waits for the raw futex and for the stream in turns, then returns the ball.
[[noreturn]] void child(Shared& shared, const std::string& socket) {
  ::prctl(PR_SET_PDEATHSIG, SIGKILL);
  pin(1);
  Session session = Session::connect({.socket_path = socket}).value();
  Reader<Ball> there = session.await_reader<Ball>("there").value();
  Writer<Ball> back = session.create<Ball>("back", History{64, 1ms}).value();
  Ball ball{};
  SampleInfo info;
  for (int i = 0; i < kWakes; ++i) {
    const auto announced = static_cast<std::uint32_t>(i);
    while (shared.word.load() == announced) futex(shared.word, FUTEX_WAIT, announced);
    shared.raw_wake_ns[i] = static_cast<double>(now_ns() - shared.sent_ns);
    while (there.wait(kNever) != WaitStatus::ready) {
    }
    if (there.read_next(ball, info) != ReadStatus::ok) std::abort();
    shared.our_wake_ns[i] = static_cast<double>(now_ns() - ball.number);
  }
  for (std::int64_t i = 0; i < kRounds; ++i) {
    while (shared.ball.load(std::memory_order_acquire) != 2 * i + 1) {
    }
    shared.ball.store(2 * i + 2, std::memory_order_release);
  }
  for (int i = 0; i < kRounds; ++i) {
    while (there.read_next(ball, info) != ReadStatus::ok) {
    }
    back.write(ball, time_from_ns(i));
  }
  ::_exit(0);
}

void sleep_until(MonoTime time) {
  const timespec until{to_ns(time.time_since_epoch()) / 1'000'000'000,
                       to_ns(time.time_since_epoch()) % 1'000'000'000};
  ::clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &until, nullptr);
}

}  // namespace

int main() {
  test::DaemonProcess daemon;
  auto* shared = new (::mmap(nullptr, sizeof(Shared), PROT_READ | PROT_WRITE,
                             MAP_SHARED | MAP_ANONYMOUS, -1, 0)) Shared;
  const std::string socket = daemon.socket_path();
  const pid_t pid = ::fork();
  if (pid == 0) child(*shared, socket);
  pin(0);
  Session session = Session::connect({.socket_path = socket}).value();
  Writer<Ball> there = session.create<Ball>("there", History{64, 1ms}).value();
  Reader<Ball> back = session.await_reader<Ball>("back").value();
  Ball ball{};
  SampleInfo info;
  MonoTime next = MonoClock::now() + 100ms;
  for (int i = 0; i < kWakes; ++i) {  // 500 us apart: each kind occurs 1,000 times a second
    sleep_until(next += 500us);
    shared->sent_ns = now_ns();
    shared->word.fetch_add(1);
    futex(shared->word, FUTEX_WAKE, INT_MAX);
    sleep_until(next += 500us);
    ball.number = now_ns();
    there.write(ball, time_from_ns(i));
  }
  sleep_until(next + 50ms);  // the last wake-up
  print_head();
  const Pair wake{figures_of({shared->raw_wake_ns, shared->raw_wake_ns + kWakes}),
                  figures_of({shared->our_wake_ns, shared->our_wake_ns + kWakes})};
  print_pair("wake by a bare futex", "wake a sleeping reader", wake, "<= 1.15, p99 <= 1.5");
  std::printf("%-44s %47.2f\n", "  ratio of the p99", wake.ours.p99 / wake.raw.p99);

  std::vector<double> raw, ours;
  for (std::int64_t i = 0; i < kRounds; ++i) {
    const std::int64_t start = now_ns();
    shared->ball.store(2 * i + 1, std::memory_order_release);
    while (shared->ball.load(std::memory_order_acquire) != 2 * i + 2) {
    }
    raw.push_back(static_cast<double>(now_ns() - start) / 2);
  }
  for (int i = 0; i < kRounds; ++i) {
    const std::int64_t start = now_ns();
    ball.number = i;
    there.write(ball, time_from_ns(i));
    while (back.read_next(ball, info) != ReadStatus::ok || ball.number != i) {
    }
    ours.push_back(static_cast<double>(now_ns() - start) / 2);
  }
  print_pair("pass a cache line", "pass 64 B to a spinning reader",
             {figures_of(std::move(raw)), figures_of(std::move(ours))}, "<= 2");
  ::waitpid(pid, nullptr, 0);
}
