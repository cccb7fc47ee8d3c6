// SPDX-License-Identifier: Apache-2.0
//
// Executor: run() and the program's own loop, turns, exceptions, and its end.
#include <gtest/gtest.h>
#include <signal.h>

#include <stdexcept>
#include <thread>

#include "tests/process/client/callbacks.hpp"
#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/session.hpp"
#include "tests/support/signals.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;
using test::DaemonProcess;
using test::run_until;
using test::tids;

struct Executing : testing::Test {
  Writer<double> create(const std::string& name, Tid samples, std::uint64_t depth = 1 << 10) {
    Writer<double> writer = session.create<double>(name, History{depth, 1ms}).value();
    for (Tid tid = 0; tid < samples; ++tid) writer.write(0);
    return writer;
  }
  SubscribeOptions here(WhichSamples which = WhichSamples::each) {
    return {.which = which, .executor = &executor};
  }
  auto note() {
    return [this](const Sample<double>& sample) { calls.push_back(sample.tid()); };
  }

  DaemonProcess daemon;
  Session session = test::connect(daemon);
  Executor executor = Executor::create().value();
  std::vector<Tid> calls;  // only in this thread
};

TEST_F(Executing, CallsFromTheProgramsOwnLoop) {
  Writer<double> writer = create("a", 0);
  const auto handle = session.subscribe<double>("a", note(), here()).value();
  run_until(executor, [&] { return handle.is_open(); });
  for (Tid tid = 0; tid < 100; ++tid) {
    writer.write(0);
    run_until(executor, [&] { return calls.size() == static_cast<std::size_t>(tid + 1); });
  }
  EXPECT_EQ(calls, tids(0, 99));
}

TEST_F(Executing, GivesEachSubscriptionItsTurn) {
  const Writer<double> first = create("a", 1000), second = create("b", 1000);
  // Both are open at the same time unless this machine is very busy; it is run until they were.
  for (std::string order, both; both.size() < 900;) {
    order.clear();
    const auto a = session.subscribe<double>(
        "a", [&](const Sample<double>&) { order += 'a'; }, here(WhichSamples::each_from_oldest));
    const auto b = session.subscribe<double>(
        "b", [&](const Sample<double>&) { order += 'b'; }, here(WhichSamples::each_from_oldest));
    while (order.size() < 2000) {
      pollfd event{executor.fd(), POLLIN, 0};
      ASSERT_EQ(::poll(&event, 1, -1), 1) << "readable while samples are left";
      EXPECT_LE(executor.run_ready(), 2 * 16u);
    }
    const std::size_t begin = std::max(order.find('a'), order.find('b'));
    const std::size_t end = std::min(order.rfind('a'), order.rfind('b'));
    both = begin < end ? order.substr(begin, end - begin) : "";
    EXPECT_EQ(both.find(std::string(17, 'a')), std::string::npos) << both;
    EXPECT_EQ(both.find(std::string(17, 'b')), std::string::npos) << both;
  }
}

TEST_F(Executing, EndsATurnAfterASlowCallback) {
  const Writer<double> writer = create("a", 10);
  const auto handle = session.subscribe<double>(
      "a",
      [&](const Sample<double>& sample) {
        calls.push_back(sample.tid());
        std::this_thread::sleep_for(1ms);  // what the turn may take
      },
      here(WhichSamples::each_from_oldest));
  while (calls.size() < 10) EXPECT_LE(executor.run_ready(), 1u);
}

TEST_F(Executing, LeavesOutAllButTheNewest) {
  Writer<double> writer = create("a", 10);
  const auto handle = session.subscribe<double>("a", note(), here(WhichSamples::newest)).value();
  run_until(executor, [&] { return calls.size() == 1; });
  for (int i = 0; i < 10; ++i) writer.write(0);
  run_until(executor, [&] { return !calls.empty() && calls.back() == 19; });
  EXPECT_EQ(calls.front(), 9);
  EXPECT_EQ(handle.lost_samples(), 0u);
}

TEST_F(Executing, CountsSamplesThatTheRingNoLongerHeld) {
  Writer<double> writer = create("a", 1, 16);
  const auto handle = session.subscribe<double>("a", note(), here()).value();
  run_until(executor, [&] { return calls.size() == 1; });
  for (int i = 0; i < 100; ++i) writer.write(0);
  run_until(executor, [&] { return calls.back() == 100; });
  EXPECT_EQ(handle.lost_samples() + calls.size(), 101u);
  EXPECT_GT(handle.lost_samples(), 80u);
}

TEST_F(Executing, PassesAnExceptionOnAndContinues) {
  const Writer<double> writer = create("a", 5);
  const auto handle = session.subscribe<double>(
      "a",
      [&](const Sample<double>& sample) {
        calls.push_back(sample.tid());
        if (sample.tid() == 1) throw std::runtime_error("one");
        if (sample.tid() == 3) throw std::runtime_error("three");
        if (sample.tid() == 4) executor.stop();
      },
      here(WhichSamples::each_from_oldest));
  EXPECT_THROW(run_until(executor, [] { return false; }), std::runtime_error);
  EXPECT_EQ(calls, tids(0, 1));
  EXPECT_THROW((void)executor.run(), std::runtime_error);
  EXPECT_EQ(calls, tids(0, 3));
  EXPECT_EQ(executor.run(), WaitStatus::ready);
  EXPECT_EQ(calls, tids(0, 4));
}

TEST_F(Executing, EndsRunByStopDeadlineAndSignal) {
  EXPECT_EQ(executor.run(MonoTime{}), WaitStatus::timeout);
  EXPECT_EQ(executor.run(1ms), WaitStatus::timeout);
  executor.stop();
  EXPECT_EQ(executor.run(), WaitStatus::ready) << "also if it comes before run()";
  std::thread other([&] { executor.stop(); });
  EXPECT_EQ(executor.run(), WaitStatus::ready);
  other.join();
  EXPECT_EQ(executor.run(0ms), WaitStatus::timeout) << "once";
  const test::Signals signals;
  EXPECT_EQ(executor.run(), WaitStatus::interrupted);
}

TEST_F(Executing, LetsCallbacksSubscribeToOthers) {
  const Writer<double> first = create("a", 1), second = create("b", 1);
  std::optional<StreamCallback> inner;
  const auto outer = session.subscribe<double>(
      "a",
      [&](const Sample<double>&) {
        inner = session.subscribe<double>("b", note(), here()).value();
      },
      here());
  run_until(executor, [&] { return !calls.empty(); });
  EXPECT_EQ(calls, tids(0, 0));
}

TEST_F(Executing, EndsASubscriptionInItsOwnCallAndInThatOfAnother) {
  Writer<double> writer = create("a", 1);
  std::optional<StreamCallback> itself, other;
  itself = session
               .subscribe<double>(
                   "a",
                   [&](const Sample<double>& sample) {
                     calls.push_back(sample.tid());
                     itself.reset();
                     other.reset();
                   },
                   here())
               .value();
  run_until(executor, [&] { return !calls.empty(); });
  other = session
              .subscribe<double>(
                  "a", [](const Sample<double>&) { ADD_FAILURE(); }, here())
              .value();
  itself = session
               .subscribe<double>(
                   "a", [&](const Sample<double>&) { other.reset(); }, here())
               .value();
  other = session.subscribe<double>("a", note(), here()).value();
  calls.clear();
  writer.write(0);
  run_until(executor, [&] { return !other; });
  executor.run_ready();
  EXPECT_LE(calls.size(), 2u) << "those before";
}

TEST_F(Executing, OutlivesNoneOfItsSubscriptions) {
  Writer<double> writer = create("a", 1);
  const auto owned = std::make_shared<int>(1);
  auto handle = session
                    .subscribe<double>(
                        "a", [owned](const Sample<double>&) {}, here())
                    .value();
  const auto awaiting = session.subscribe<double>("never", note(), here()).value();
  run_until(executor, [&] { return handle.is_open(); });
  executor = Executor::create().value();
  EXPECT_EQ(owned.use_count(), 1) << "the callback is destroyed";
  writer.write(0);
  EXPECT_EQ(executor.run(0ms), WaitStatus::timeout);
  handle = session.subscribe<double>("a", note(), here()).value();
  run_until(executor, [&] { return calls.size() == 1; });
}

TEST_F(Executing, MayBeDestroyedByACallback) {
  const Writer<double> writer = create("a", 10);
  auto own = std::make_optional(Executor::create().value());
  const auto handle =
      session.subscribe<double>("a",
                                [&](const Sample<double>& sample) {
                                  calls.push_back(sample.tid());
                                  own.reset();
                                },
                                {.which = WhichSamples::each_from_oldest, .executor = &*own});
  EXPECT_EQ(own->run(), WaitStatus::ready);
  EXPECT_EQ(calls, tids(0, 0));
}

TEST_F(Executing, HasAThreadOfItsOwnIfWanted) {
  const Writer<double> writer = create("a", 3);
  test::Events<Tid> seen;
  ASSERT_TRUE(executor.start());
  const auto handle = session.subscribe<double>(
      "a", [&](const Sample<double>& sample) { seen.add(sample.tid()); },
      here(WhichSamples::each_from_oldest));
  EXPECT_EQ(seen.await(3), tids(0, 2));
}

TEST_F(Executing, EndsTheProgramWhenACallbackThrowsInAThreadOfDssm) {
  const pid_t victim =
      test::start({test::built("tests/process/client/victim"), "throw"}, {daemon.environment()});
  EXPECT_EQ(test::wait_for(victim), 128 + SIGABRT);
}

}  // namespace
}  // namespace dssm
