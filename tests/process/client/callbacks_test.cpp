// SPDX-License-Identifier: Apache-2.0
//
// Session::subscribe(): which samples the callback gets, streams that come later, restart or cannot
// be read, and the end of a subscription, from any place.
#include "tests/process/client/callbacks.hpp"

#include <gtest/gtest.h>
#include <signal.h>
#include <unistd.h>

#include <atomic>
#include <thread>

#include "tests/support/await.hpp"
#include "tests/support/daemon_process.hpp"
#include "tests/support/samples.hpp"
#include "tests/support/session.hpp"

namespace dssm {
namespace {

using namespace std::chrono_literals;
using test::await;
using test::DaemonProcess;
using test::Events;
using test::Numbered;
using test::numbered;
using test::tids;

const TypeInfo kOther{"", 3, 1, {}};

struct Callbacks : testing::Test {
  Writer<Numbered> create(const std::string& name, std::uint64_t depth = 1 << 10) {
    return session.create<Numbered>(name, History{depth, 1ms}).value();
  }
  static void write(Writer<Numbered>& writer, Tid first, Tid last) {
    for (Tid tid = first; tid <= last; ++tid) ASSERT_EQ(writer.write(numbered(tid)), tid);
  }
  // A callback that notes the tids.
  static auto note(Events<Tid>& to) {
    return [&to](const Sample<Numbered>& sample) {
      EXPECT_EQ(sample.value.number, sample.tid());
      to.add(sample.tid());
    };
  }

  DaemonProcess daemon;
  Session session = test::connect(daemon);
  Events<Tid> calls;
};

TEST_F(Callbacks, GetEachSampleInOrderInOneThreadWithoutSignals) {
  Writer<Numbered> writer = create("a"), second = create("b");
  Events<std::thread::id> threads;
  const auto check = [&](const Sample<Numbered>& sample) {
    threads.add(std::this_thread::get_id());
    sigset_t blocked;
    ::pthread_sigmask(SIG_BLOCK, nullptr, &blocked);
    EXPECT_TRUE(sigismember(&blocked, SIGINT));
    calls.add(sample.tid());
  };
  const auto both = {session.subscribe<Numbered>("a", check),
                     session.subscribe<Numbered>("b", [&](const Sample<Numbered>&) {
                       threads.add(std::this_thread::get_id());
                     })};
  for (const auto& one : both) {
    ASSERT_TRUE(one);
    await([&] { return one->is_open(); });
  }
  write(writer, 0, 99);
  write(second, 0, 99);
  EXPECT_EQ(calls.await(100), tids(0, 99));
  const auto seen = threads.await(200);
  EXPECT_EQ(std::count(seen.begin(), seen.end(), seen[0]), 200);
  EXPECT_NE(seen[0], std::this_thread::get_id());
}

TEST_F(Callbacks, BeginWithTheNewestOrTheOldestSample) {
  Writer<Numbered> writer = create("a", 16);
  write(writer, 0, 19);
  Events<Tid> from_oldest, newest;
  const auto each = session.subscribe<Numbered>("a", note(calls));
  const auto all = session.subscribe<Numbered>("a", note(from_oldest),
                                               {.which = WhichSamples::each_from_oldest});
  const auto last = session.subscribe<Numbered>("a", note(newest), {.which = WhichSamples::newest});
  const Tid oldest = session.open_reader<Numbered>("a").value().oldest_tid();
  from_oldest.await(static_cast<std::size_t>(20 - oldest));
  calls.await(1), newest.await(1);
  write(writer, 20, 20);
  EXPECT_EQ(calls.await(2), tids(19, 20));
  EXPECT_EQ(newest.await(2), tids(19, 20));
  EXPECT_EQ(from_oldest.await(static_cast<std::size_t>(21 - oldest)), tids(oldest, 20));
}

TEST_F(Callbacks, AwaitAStreamOfThisPcFromItsFirstSampleOn) {
  const auto handle = session.subscribe<Numbered>("late", note(calls)).value();
  EXPECT_FALSE(handle.is_open());
  Writer<Numbered> writer = create("late");
  write(writer, 0, 9);
  EXPECT_EQ(calls.await(10), tids(0, 9));
  EXPECT_TRUE(handle.is_open());
}

TEST_F(Callbacks, AwaitAStreamOfAHostThatIsDown) {
  DaemonProcess other({}, "pc2");
  DaemonProcess here({"--peer", other.address()}, "pc3");
  other.kill_hard();
  Session reading = test::connect(here);
  const auto handle = reading.subscribe<Numbered>("far@pc2", note(calls)).value();
  other.start();
  Writer<Numbered> writer =
      test::connect(other).create<Numbered>("far", History{1 << 10, 1ms}).value();
  await([&] { return handle.is_open(); });
  const Tid first = writer.newest_tid() + 1;
  write(writer, first, first + 9);
  EXPECT_EQ(calls.await(10), tids(first, first + 9));
}

TEST_F(Callbacks, DoNotWaitForDssmdWhenTheySubscribe) {
  daemon.kill_hard();
  await([&] { return !session.is_connected(); });
  const auto handle = session.subscribe<Numbered>("late", note(calls)).value();
  daemon.start();  // not before subscribe() has returned
  Writer<Numbered> writer = create("late");
  await([&] { return handle.is_open(); });
  write(writer, 0, 2);
  EXPECT_EQ(calls.await(3), tids(0, 2));
}

TEST_F(Callbacks, MayReadThePastOfTheirStream) {
  Writer<Numbered> writer = create("a");
  for (Tid tid = 0; tid < 4; ++tid) writer.write(numbered(tid), time_from_ns(1000 * tid));
  const auto handle =
      session.subscribe<Numbered>("a",
                                  [&](const Sample<Numbered>& sample, Reader<Numbered>& reader) {
                                    if (const auto before = reader.read_at(sample.time() - 1000ns))
                                      calls.add(before->tid());
                                  },
                                  {.which = WhichSamples::each_from_oldest});
  EXPECT_EQ(calls.await(3), tids(0, 2));
}

TEST_F(Callbacks, GetBytesOfAnyTypeAndLength) {
  RawWriter writer = session.create_raw({"raw", 0, ""}, {"", 100, 1, {}}, {16, 1ms}).value();
  Events<std::string> texts;
  const auto handle = session.subscribe_raw(
      {"raw", 0, ""},
      [&](std::span<const std::byte> payload, const SampleInfo& info, RawReader& reader) {
        EXPECT_EQ(reinterpret_cast<std::uintptr_t>(payload.data()) % 64, 0u);
        EXPECT_EQ(info.tid, reader.cursor());
        texts.add({reinterpret_cast<const char*>(payload.data()), payload.size()});
      });
  const std::string text = "a text";
  writer.write(std::as_bytes(std::span(text)));
  EXPECT_EQ(texts.await(1)[0], text);
  const TypeInfo wanted = type_of<Numbered>();
  await([&] {
    const auto failed = session.subscribe_raw({"raw", 0, ""}, {}, {}, &wanted);
    return !failed && failed.error().code == Errc::type_mismatch;
  });
}

TEST_F(Callbacks, FailAtOnceForAReasonThatStays) {
  EXPECT_EQ(session.subscribe<Numbered>("a:b", note(calls)).error().code, Errc::invalid_argument);
  EXPECT_EQ(session.subscribe_raw({"", 0, ""}, {}).error().code, Errc::invalid_argument);
  session.create_raw({"a", 0, ""}, kOther, {16, 1ms}).value();
  await([&] {  // dssmd may take longer than subscribe() waits for it
    const auto failed = session.subscribe<Numbered>("a", note(calls), {.on_error = [](auto&) {}});
    return !failed && failed.error().code == Errc::type_mismatch;
  });
}

TEST_F(Callbacks, ReportAReasonThatIsFoundLaterOnce) {
  Events<Errc> errors;
  Events<std::string> notices;
  Session noticing =
      Session::connect({.socket_path = daemon.socket_path(),
                        .request_timeout = 60s,
                        .on_notice = [&](const std::string& text) { notices.add(text); }})
          .value();
  const auto first = session.subscribe<Numbered>(
      "late", note(calls), {.on_error = [&](const Error& error) { errors.add(error.code); }});
  const auto second = noticing.subscribe<Numbered>("late", note(calls));
  ASSERT_TRUE(first && second);
  RawWriter writer = session.create_raw({"late", 0, ""}, kOther, {16, 1ms}).value();
  EXPECT_EQ(errors.await(1)[0], Errc::type_mismatch);
  for (std::size_t i = 1;; ++i) {  // it may have reported its wait before
    const std::string text = notices.await(i)[i - 1];
    if (text.starts_with("subscribe to 'late:0': open 'late:0': ")) break;
    EXPECT_TRUE(text.starts_with("has waited ")) << text;
  }
  EXPECT_FALSE(first->is_open());
}

TEST_F(Callbacks, FollowARestartedStream) {
  Writer<Numbered> old = create("a");
  Events<Tid> newest;
  const auto each = session.subscribe<Numbered>("a", note(calls)).value();
  const auto last =
      session.subscribe<Numbered>("a", note(newest), {.which = WhichSamples::newest}).value();
  write(old, 0, 0);
  calls.await(1), newest.await(1);
  ASSERT_TRUE(session.remove({"a", 0, ""}));
  Writer<Numbered> again = create("a");
  write(again, 0, 0);
  EXPECT_EQ(newest.await(2)[1], 0) << "its tid is that of the last call, but it is another sample";
  write(again, 1, 3);
  EXPECT_EQ(calls.await(5), (std::vector<Tid>{0, 0, 1, 2, 3}));
  EXPECT_EQ(each.restarts(), 1u);
  EXPECT_EQ(last.restarts(), 1u);
  EXPECT_EQ(each.lost_samples(), 0u);
}

TEST_F(Callbacks, ReportThatARestartedStreamHasAnotherTypeOnce) {
  Writer<Numbered> writer = create("a");
  Events<Errc> errors;
  const auto handle =
      session
          .subscribe<Numbered>("a", note(calls),
                               {.on_error = [&](const Error& error) { errors.add(error.code); }})
          .value();
  write(writer, 0, 0);
  calls.await(1);
  ASSERT_TRUE(session.remove({"a", 0, ""}));
  RawWriter other = session.create_raw({"a", 0, ""}, kOther, {16, 1ms}).value();
  errors.await(1);
  write(writer, 1, 20);  // to the old ring
  Events<Tid> later;     // of the same thread
  const auto marker = session.subscribe_raw(
      {"a", 0, ""}, [&](auto, const SampleInfo& info, auto&) { later.add(info.tid); });
  const std::byte payload[3]{};
  for (Tid tid = 0; tid < 20; ++tid) {
    ASSERT_EQ(other.write(payload, Time{}), tid);
    later.await(static_cast<std::size_t>(tid + 1));
  }
  EXPECT_EQ(errors.now(), std::vector{Errc::type_mismatch});
  EXPECT_EQ(calls.now(), tids(0, 0));
  EXPECT_EQ(handle.restarts(), 0u);
}

// --- the end

TEST_F(Callbacks, EndFromInsideTheirOwnCall) {
  Writer<Numbered> writer = create("a");
  const auto owned = std::make_shared<int>(1);
  std::optional<StreamCallback> handle;
  std::mutex assigning;
  const auto end_itself = [&, owned](const Sample<Numbered>& sample) {
    const std::lock_guard guard(assigning);
    handle.reset();
    EXPECT_EQ(*owned, 1) << "what the callback holds lives until it returns";
    calls.add(sample.tid());
  };
  {
    const std::lock_guard guard(assigning);
    handle = session.subscribe<Numbered>("a", end_itself).value();
    write(writer, 0, 99);
  }
  Events<Tid> others;
  calls.await(1);
  const auto other = session.subscribe<Numbered>("a", note(others));
  others.await(1);
  await([&] { return owned.use_count() == 2; });  // end_itself has another one
  EXPECT_EQ(calls.now().size(), 1u);
}

TEST_F(Callbacks, EndOnlyAfterACallThatIsRunning) {
  Writer<Numbered> writer = create("a");
  std::atomic<bool> ending = false, returned = false;
  std::optional<StreamCallback> handle =
      session
          .subscribe<Numbered>("a",
                               [&](const Sample<Numbered>& sample) {
                                 calls.add(sample.tid());
                                 await([&] { return ending.load(); });
                                 for (int i = 0; i < 20; ++i) {  // has much to do
                                   std::this_thread::sleep_for(test::kPollPause);
                                 }
                                 returned = true;
                               })
          .value();
  write(writer, 0, 0);
  calls.await(1);
  ending = true;
  handle.reset();
  EXPECT_TRUE(returned);
}

// For the sanitizers: what a callback uses is destroyed right after the subscription.
TEST_F(Callbacks, AreNotCalledAfterTheirEnd) {
  Writer<Numbered> writer = create("a");
  test::WriterThread load(writer, 50us);
  for (int round = 0; round < 200; ++round) {
    auto sum = std::make_unique<std::int64_t>(0);
    {
      Events<Tid> called;
      const auto handle =
          session.subscribe<Numbered>("a", [&, to = sum.get()](const Sample<Numbered>& sample) {
            *to += sample.value.number;
            called.add(sample.tid());
          });
      if (round % 2 == 0) called.await(1);
    }
    sum.reset();
  }
}

TEST_F(Callbacks, EndOneThatAwaitsItsStream) {
  const auto owned = std::make_shared<int>(1);
  for (int round = 0; round < 20; ++round) {
    const auto handle =
        session.subscribe<Numbered>("never", [owned](const Sample<Numbered>&) {}).value();
  }
  EXPECT_EQ(owned.use_count(), 1);
}

// The connection to dssmd ends with its last user, which is the callback.
TEST_F(Callbacks, EndTheLastSessionFromInside) {
  Writer<Numbered> writer = create("a");
  struct Program {
    std::optional<Session> session;
    std::optional<StreamCallback> handle;
    std::mutex ready;
  };
  auto program = std::make_unique<Program>();
  {
    const std::lock_guard guard(program->ready);
    program->session = test::connect(daemon);
    program->handle = program->session
                          ->subscribe<Numbered>("a",
                                                [&](const Sample<Numbered>& sample) {
                                                  { const std::lock_guard until(program->ready); }
                                                  program->session.reset();
                                                  program->handle.reset();
                                                  calls.add(sample.tid());
                                                })
                          .value();
  }
  write(writer, 0, 5);
  calls.await(1);
  await([&] { return session.list_clients().value().size() == 1; });
}

TEST_F(Callbacks, OutliveTheirSession) {
  Writer<Numbered> writer = create("a");
  auto subscribed = [&] {
    return test::connect(daemon).subscribe<Numbered>("a", note(calls)).value();
  }();
  await([&] { return subscribed.is_open(); });
  write(writer, 0, 5);
  calls.await(6);
  subscribed = session.subscribe<Numbered>("a", note(calls)).value();
  await([&] { return session.list_clients().value().size() == 1; });
}

}  // namespace
}  // namespace dssm
