// SPDX-License-Identifier: Apache-2.0
//
// lockstep-program WAY: reads the streams of lockstep_test.cpp in one of the ways in which programs
// read streams, and prints what it gets, a line each, in the order in which it gets it.
#include <poll.h>

#include <condition_variable>
#include <cstdio>
#include <deque>
#include <dssm/dssm.hpp>
#include <functional>
#include <map>
#include <mutex>
#include <ssm.hpp>
#include <string>
#include <thread>

#include "tests/process/dssmctl/lockstep_sample.hpp"

namespace {

using dssm::test::Numbered;

constexpr std::int64_t kLast = 999;

dssm::Session& session() {
  static dssm::Session session = dssm::Session::connect().value();
  return session;
}

void print(const char* stream, const dssm::Sample<Numbered>& sample) {
  static dssm::PlaybackClock clock = session().open_playback_clock().value();
  std::printf("%s %lld %.6f\n", stream, static_cast<long long>(sample.value.number), clock.now_s());
}

// Waits in a read.
void next(std::int64_t last = kLast) {
  auto fast = session().await_reader<Numbered>("fast").value();
  fast.seek(dssm::kNoTid);
  for (std::int64_t number = 0; number < last;) {
    (void)fast.wait(std::chrono::milliseconds(1));
    while (const auto sample = fast.read_next()) {
      print("fast", *sample);
      number = sample->value.number;
    }
  }
}

// Waits for two streams, and reads one of them at the time of the other.
void any() {
  auto fast = session().await_reader<Numbered>("fast").value();
  auto slow = session().await_reader<Numbered>("slow").value();
  dssm::RawReader* const readers[] = {&fast, &slow};
  for (std::int64_t number = 0; number < kLast;) {
    (void)dssm::wait_any(readers, dssm::kNever);
    while (const auto sample = slow.read_next()) {
      print("slow", *sample);
      if (const auto before = fast.read_at(sample->time())) print("before", *before);
    }
    while (const auto sample = fast.read_next()) number = sample->value.number;
  }
}

// Is called by an executor, in its thread.
void callbacks() {
  dssm::Executor executor = dssm::Executor::create().value();
  dssm::SubscribeOptions options;
  options.executor = &executor;
  const auto slow = session().subscribe<Numbered>(
      "slow", [](const dssm::Sample<Numbered>& sample) { print("slow", sample); }, options);
  const auto fast = session().subscribe<Numbered>(
      "fast",
      [&](const dssm::Sample<Numbered>& sample) {
        print("fast", sample);
        if (sample.value.number == kLast) executor.stop();
      },
      options);
  (void)executor.run();
}

// Waits in a loop of its own, and hands all to another thread.
void hand_over() {
  std::mutex mutex;
  std::condition_variable changed;
  std::deque<dssm::Sample<Numbered>> samples;
  std::thread worker([&] {
    for (std::int64_t number = 0; number < kLast;) {
      std::unique_lock lock(mutex);
      changed.wait(lock, [&] { return !samples.empty(); });
      const dssm::Sample<Numbered> sample = samples.front();
      samples.pop_front();
      lock.unlock();
      // Works, and sleeps until dssmd has answered.
      for (volatile int work = 0; work < 300'000;) work = work + 1;
      for (int request = 0; request < 4; ++request) (void)session().list_own_streams();
      number = sample.value.number;
      print("fast", sample);
    }
  });
  auto fast = session().await_reader<Numbered>("fast").value();
  fast.seek(dssm::kNoTid);
  for (std::int64_t number = 0; number < kLast;) {
    pollfd ready{fast.ready_fd().value(), POLLIN, 0};
    (void)::poll(&ready, 1, -1);
    fast.clear_ready();
    while (const auto sample = fast.read_next()) {
      number = sample->value.number;
      const std::lock_guard lock(mutex);
      samples.push_back(*sample);
      changed.notify_one();
    }
  }
  worker.join();
}

// Writes a stream of its own.
void echo() {
  auto slow = session().await_reader<Numbered>("slow").value();
  slow.seek(dssm::kNoTid);
  std::optional<dssm::Writer<Numbered>> out;
  for (std::int64_t number = 0; number < kLast / 10;) {
    (void)slow.wait(dssm::kNever);
    while (const auto sample = slow.read_next()) {
      number = sample->value.number;
      const dssm::History history{1024, std::chrono::milliseconds(10)};
      if (!out) out = session().create<Numbered>("echo", history).value();
      out->write(sample->value, sample->time());
    }
  }
}

// Reads that, and is there before it.
void heard() {
  auto echoed = session().await_reader<Numbered>("echo").value();
  echoed.seek(dssm::kNoTid);
  for (std::int64_t number = 0; number < kLast / 10;) {
    (void)echoed.wait(dssm::kNever);
    while (const auto sample = echoed.read_next()) {
      print("echo", *sample);
      number = sample->value.number;
    }
  }
}

// As programs of SSM do, which poll.
void ssm() {
  SSMApi<Numbered> fast("fast");
  while (!fast.open()) usleepSSM(1000);
  for (std::int64_t number = 0; number < kLast;) {
    if (fast.readNew()) {
      number = fast.data.number;
      std::printf("fast %lld %.6f\n", static_cast<long long>(number), gettimeSSM());
    } else {
      usleepSSM(3000);
    }
  }
  fast.close();
}

// Waits as it does in no test: until it is ended.
void wait() {
  auto fast = session().await_reader<Numbered>("fast").value();
  for (;;) {
    while (const auto sample = fast.read_next()) print("fast", *sample);
    (void)fast.wait(dssm::kNever);
  }
}

}  // namespace

int main(int argc, char** argv) {
  const std::map<std::string, std::function<void()>> ways = {{"next", [] { next(); }},
                                                             {"next-100", [] { next(100); }},
                                                             {"any", any},
                                                             {"callbacks", callbacks},
                                                             {"hand-over", hand_over},
                                                             {"echo", echo},
                                                             {"heard", heard},
                                                             {"wait", wait},
                                                             {"ssm", [] {
                                                                if (!initSSM()) std::abort();
                                                                ssm();
                                                                endSSM();
                                                              }}};
  const auto way = argc == 2 ? ways.find(argv[1]) : ways.end();
  if (way == ways.end()) return 2;
  (void)std::setvbuf(stdout, nullptr, _IOLBF, 0);
  way->second();
  return 0;
}
