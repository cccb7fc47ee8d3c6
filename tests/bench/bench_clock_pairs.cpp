// SPDX-License-Identifier: Apache-2.0
//
// How far the clocks of two PCs may be apart by what their dssmd measure with heartbeats, beside
// half of the best round trip, which is the least that any heartbeat can show, and 30 us; and how
// often the two wake up. Both run here, but in namespaces with boot ids of their own, so that they
// do not know that they have one clock. Needs root.
#include <sched.h>
#include <sys/mount.h>
#include <sys/socket.h>

#include <dssm/dssm.hpp>
#include <fstream>
#include <string>
#include <thread>

#include "tests/bench/harness.hpp"
#include "tests/bench/processes.hpp"
#include "tests/support/daemon_process.hpp"

using namespace dssm;
using namespace dssm::bench;
using namespace std::chrono_literals;

namespace {

// The heartbeats of 64 s count.
constexpr auto kWarmUp = 66s;
constexpr int kReadings = 100;  // one a second
constexpr Duration kAllowed = 30us;

// From now on, processes that are started have this boot id.
void set_boot_id(const std::string& folder, char digit) {
  const std::string file = folder + "/boot_id" + digit;
  std::ofstream(file) << std::string(8, digit) << "-0000-4000-8000-000000000000\n";
  static constexpr const char* kFile = "/proc/sys/kernel/random/boot_id";
  ::umount(kFile);  // the one before, which else would be what this one is mounted on
  if (::mount(file.c_str(), kFile, nullptr, MS_BIND, nullptr) != 0) {
    fail("mount a boot id");
  }
}

void print(const char* name, const std::vector<double>& ns) {
  const Figures figures = figures_of(ns);
  std::printf("%-38s %8.1f %8.1f %8.1f %8.1f\n", name, figures.min / 1e3, figures.median / 1e3,
              figures.p99 / 1e3, figures.p999 / 1e3);
}

}  // namespace

int main() {
  if (::unshare(CLONE_NEWNS) != 0 || ::mount("", "/", nullptr, MS_REC | MS_PRIVATE, nullptr) != 0) {
    fail("make a mount namespace");
  }
  const auto [one_fd, one_port] = test::reserve_port(SOCK_STREAM);
  const auto [other_fd, other_port] = test::reserve_port(SOCK_STREAM);
  const std::string here = "127.0.0.1:";
  const std::string one_at = here + std::to_string(one_port),
                    other_at = here + std::to_string(other_port);
  const std::string folder = test::make_temp_dir();
  set_boot_id(folder, '1');
  test::DaemonProcess one({"--listen", one_at, "--peer", other_at}, "pc1");
  set_boot_id(folder, '2');
  test::DaemonProcess other({"--listen", other_at, "--peer", one_at}, "pc2");
  ::close(one_fd), ::close(other_fd);
  test::remove_tree(folder);
  Session session = Session::connect({.socket_path = one.socket_path()}).value();
  std::this_thread::sleep_for(kWarmUp);
  const std::int64_t one_before = sleeps_of(one.pid()), other_before = sleeps_of(other.pid());
  std::this_thread::sleep_for(30s);
  const double one_rate = static_cast<double>(sleeps_of(one.pid()) - one_before) / 30,
               other_rate = static_cast<double>(sleeps_of(other.pid()) - other_before) / 30;
  std::vector<double> bounds, half_round_trips;
  std::size_t within = 0;
  for (int i = 0; i < kReadings; ++i) {
    std::this_thread::sleep_for(1s);
    for (const ClockPair& pair : session.list_clock_pairs().value()) {
      if (!pair.error.empty()) continue;
      bounds.push_back(static_cast<double>(to_ns(pair.measured)));
      half_round_trips.push_back(static_cast<double>(to_ns(pair.round_trip)) / 2);
      within += pair.measured <= pair.round_trip / 2 + kAllowed;
    }
  }
  if (bounds.empty()) fail("measure a pair");
  std::printf("%-38s %8s %8s %8s %8s\n", "two clocks [us]", "min", "median", "p99", "p99.9");
  print("stated: at most so far apart", bounds);
  print("half of the best round trip", half_round_trips);
  std::printf("within that and 30 us: %.1f %% (target 100)\n",
              100.0 * static_cast<double>(within) / static_cast<double>(bounds.size()));
  std::printf("wake-ups a second: %.1f and %.1f\n", one_rate, other_rate);
}
