// SPDX-License-Identifier: Apache-2.0
//
// stall LONGEST_MS PAUSE_MS COMMAND...: runs the command and meanwhile blocks all processors
// repeatedly, for up to LONGEST_MS at a time, with pauses of up to PAUSE_MS. This is like a virtual
// machine on a busy host; it reveals tests that depend on timing.
// Ends with the command's exit status; 2: wrong arguments; 77: this machine does not allow it.
//
// starve.py, in this folder, stops only some of the processes.
//
// More than 950 ms has little effect: by default, the kernel reserves the last 50 ms of each second
// for programs that are not real-time (sched(7)).
#include <sched.h>
#include <unistd.h>

#include <barrier>
#include <chrono>
#include <cstdlib>
#include <iostream>
#include <random>
#include <string>
#include <thread>
#include <vector>

#include "tests/support/daemon_process.hpp"

namespace {

using Clock = std::chrono::steady_clock;
using std::chrono::milliseconds;

constexpr int kWrongArguments = 2, kCannotRunHere = 77;

std::vector<int> processors() {
  cpu_set_t allowed;
  ::sched_getaffinity(0, sizeof allowed, &allowed);
  std::vector<int> numbers;
  for (int number = 0; number < CPU_SETSIZE; ++number) {
    if (CPU_ISSET(number, &allowed)) numbers.push_back(number);
  }
  return numbers;
}

// Binds the calling thread to this processor, with priority over all that is not real-time.
bool claim(int processor) {
  cpu_set_t only;
  CPU_ZERO(&only);
  CPU_SET(processor, &only);
  const sched_param priority{.sched_priority = 50};
  return ::sched_setaffinity(0, sizeof only, &only) == 0 &&
         ::sched_setscheduler(0, SCHED_FIFO, &priority) == 0;
}

class Stalls {
 public:
  Stalls(milliseconds longest, milliseconds longest_pause, std::ptrdiff_t processors)
      : longest_(longest), longest_pause_(longest_pause), all_here_(processors) {}

  // Forever. The first thread decides when, for all.
  void take_part(bool first) {
    for (;;) {
      if (first) {
        std::this_thread::sleep_for(up_to(longest_pause_));
        until_ = Clock::now() + up_to(longest_);
      }
      all_here_.arrive_and_wait();
      while (Clock::now() < until_) {
      }
      all_here_.arrive_and_wait();  // no thread reads until_ any more
    }
  }

 private:
  milliseconds up_to(milliseconds longest) {
    return milliseconds(std::uniform_int_distribution<long>(0, longest.count())(random_));
  }

  const milliseconds longest_, longest_pause_;
  std::barrier<> all_here_;
  Clock::time_point until_;
  std::mt19937_64 random_{std::random_device{}()};
};

}  // namespace

int main(int argc, char** argv) {
  const long longest_ms = argc > 3 ? std::atol(argv[1]) : 0;
  const long pause_ms = argc > 3 ? std::atol(argv[2]) : 0;
  if (longest_ms <= 0 || pause_ms <= 0) {
    std::cerr << "usage: stall LONGEST_MS PAUSE_MS COMMAND...\n"
                 "for example: stall 600 600 meson test -C build --timeout-multiplier 3\n";
    return kWrongArguments;
  }
  const std::vector<int> all = processors();
  bool allowed = true;
  std::thread([&] { allowed = claim(all.front()); }).join();
  if (!allowed) {
    std::cerr << "stall: the kernel refuses real-time scheduling; run it as root\n";
    return kCannotRunHere;
  }
  const pid_t command = dssm::test::start({argv + 3, argv + argc}, {}, STDOUT_FILENO);
  Stalls stalls(milliseconds(longest_ms), milliseconds(pause_ms),
                static_cast<std::ptrdiff_t>(all.size()));
  for (const int processor : all) {
    std::thread([&, processor] {
      claim(processor);
      stalls.take_part(processor == all.front());
    }).detach();
  }
  // The threads end with the process; they use these objects until then.
  std::_Exit(dssm::test::wait_for(command));
}
