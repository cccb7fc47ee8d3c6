// SPDX-License-Identifier: Apache-2.0
//
// What a channel does for one stream: reads, subscriptions, publishing, property, and the stream's
// end.
#include "daemon/serve/stream_channel.hpp"

#include <algorithm>
#include <ctime>
#include <iterator>
#include <new>
#include <thread>

#include "daemon/base/turn_queue.hpp"
#include "tests/unit/daemon/remote/fake_clock_assessor.hpp"
#include "tests/unit/daemon/serve/server_rig.hpp"

namespace dssm::daemon {
namespace {

constexpr std::uint64_t kBytes = 24;

Bytes sample_frame(std::int64_t number, std::uint64_t serial = 0,
                   std::uint64_t payload_bytes = kBytes) {
  return sample_bytes({number, time_from_ns(5000 + number), Duration(4)},
                      Bytes(payload_bytes, std::byte{9}), serial);
}

net::Frame start_publishing_request(std::uint64_t publisher) {
  return with_serial(70, start_publishing_frame(publisher));
}

class StreamChannelTest : public testing::Test {
 protected:
  void SetUp() override {
    stream = rig.create("odometry", kBytes, 8);
    rig.connect(peer);
    rig.open(peer, "odometry");
  }

  std::vector<net::Frame> ask(const net::Frame& frame) {
    peer.put(frame);
    rig.turns();
    return peer.take();
  }

  // The tid that a Read brings, or minus its status.
  Tid read(const net::Read& what) {
    net::Frame frame = with_serial(50);
    *frame.mutable_read() = what;
    const std::vector<net::Frame> items = ask(frame);
    EXPECT_EQ(items.size(), 1u);
    if (items.empty()) return -100;
    EXPECT_EQ(items[0].serial(), 50u);
    if (items[0].has_no_sample()) {
      return -static_cast<Tid>(items[0].no_sample().status());
    }
    const Tid tid = items[0].sample().tid();
    EXPECT_EQ(payload_of(items[0]), ServerRig::payload_for(tid, kBytes));
    return tid;
  }
  Tid read_tid(Tid tid) {
    net::Read what;
    what.set_tid(tid);
    return read(what);
  }
  Tid read_time(std::int64_t ns) {
    net::Read what;
    what.set_time_ns(ns);
    return read(what);
  }

  // "subscribed:0 1 2 caught_up gap:3+4 ended", and the like.
  static std::string words(const std::vector<net::Frame>& items) {
    std::string text;
    for (const net::Frame& item : items) {
      text += text.empty() ? "" : " ";
      if (item.has_subscribed()) {
        text += "subscribed:" + std::to_string(item.subscribed().first_tid());
      } else if (item.has_gap()) {
        text += "gap:" + std::to_string(item.gap().first_tid()) + "+" +
                std::to_string(item.gap().count());
      } else if (item.has_caught_up()) {
        text += "caught_up";
      } else if (item.has_ended()) {
        text += item.ended().removed() ? "removed" : "ended";
      } else if (item.has_sample()) {
        text += std::to_string(item.sample().tid());
      } else if (item.has_published()) {
        text += "published:" + std::to_string(item.published().last()) + "=" +
                std::to_string(item.published().last_tid());
      } else if (item.has_pong()) {
        text += item.pong().has_other_clocks() ? "mixed" : "clock";
        text += "@" + std::to_string(item.pong().newest_tid());
      } else if (item.has_failure()) {
        text += "failure:" + item.failure().code();
      } else {
        text += "?";
      }
    }
    return text;
  }
  std::string subscribe(const std::function<void(net::Subscribe&)>& how) {
    net::Frame frame = with_serial(60);
    how(*frame.mutable_subscribe());
    return words(ask(frame));
  }

  net::Publishing start_publishing(std::uint64_t publisher) {
    const net::Frame answer = rig.ask(peer, start_publishing_request(publisher));
    EXPECT_TRUE(answer.has_publishing()) << answer.failure().message();
    return answer.publishing();
  }

  ServerRig rig;
  MemoryPeer peer;
  std::shared_ptr<Stream> stream;
};

// --- reads

TEST_F(StreamChannelTest, ReadsByTidTimeAndNewest) {
  constexpr Tid kNotYet = -1, kTooOld = -2;
  net::Read newest, newer;
  newest.set_newest(true);
  EXPECT_EQ(read(newest), kNotYet);
  EXPECT_EQ(read_tid(0), kNotYet);
  EXPECT_EQ(read_time(1'000'000), kNotYet);
  rig.write(*stream, 20);  // 13 to 19 are held; times 1000 + 10 * tid
  EXPECT_EQ(read(newest), 19);
  EXPECT_EQ(read_tid(13), 13);
  EXPECT_EQ(read_tid(12), kTooOld);
  EXPECT_EQ(read_tid(20), kNotYet);
  EXPECT_EQ(read_tid(-3), kTooOld);
  EXPECT_EQ(read_time(1155), 15);
  EXPECT_EQ(read_time(999'999), 19);
  EXPECT_EQ(read_time(1129), kTooOld);
  newer.set_newer_than(18);
  EXPECT_EQ(read(newer), 19);
  newer.set_newer_than(19);
  EXPECT_EQ(read(newer), kNotYet);
}

TEST_F(StreamChannelTest, ReportsItsRange) {
  net::Frame frame = with_serial(1);
  frame.mutable_get_range()->set_time_ns(1155);
  net::Range range = ask(frame).at(0).range();
  EXPECT_EQ(range.oldest(), -1);
  EXPECT_EQ(range.newest(), -1);
  EXPECT_EQ(range.at_tid(), -1);
  rig.write(*stream, 20);
  range = ask(frame).at(0).range();
  EXPECT_EQ(range.oldest(), 13);
  EXPECT_EQ(range.newest(), 19);
  EXPECT_EQ(range.at_tid(), 15);
  frame.mutable_get_range()->clear_time_ns();
  EXPECT_EQ(ask(frame).at(0).range().at_tid(), -1);
}

// Runs whose links never end, as a hostile writer makes them: each search gives up.
class SearchWithoutEnd : public StreamChannelTest {
 protected:
  void SetUp() override {
    rig.connect(peer);
    stream = rig.create("runs", kBytes, 1024);
    rig.write(*stream, 600);
    const OfferedFiles files = as_offer(stream->descriptors_for(Role::writer).value());
    const auto mapping =
        ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write).value();
    const ring::SlotTable slots(*mapping);
    for (Tid tid = 0; tid < 600; ++tid) {
      ring::SlotHeader& slot = slots.slot(tid);
      slot.run_start = tid;
      slot.run_parent = slot.run_jump = tid - 1;
    }
    mapping->header().run_start = 599;
    rig.open(peer, "runs");
  }
  static Duration processor_time(const std::function<void()>& work) {
    const auto used = [] {
      timespec time{};
      ::clock_gettime(CLOCK_THREAD_CPUTIME_ID, &time);
      return std::chrono::seconds(time.tv_sec) + std::chrono::nanoseconds(time.tv_nsec);
    };
    const auto before = used();
    work();
    return used() - before;
  }
};

TEST_F(SearchWithoutEnd, TakesLittleOfATurn) {
  constexpr std::int64_t kBeforeAll = 1;
  const ring::RingReader reader(stream->mapping());
  Tid tid = kNoTid;
  const Duration all_retries = processor_time(
      [&] { EXPECT_EQ(reader.find(time_from_ns(kBeforeAll), tid), ReadStatus::lapped); });
  net::Frame range = with_serial(1);
  range.mutable_get_range()->set_time_ns(kBeforeAll);
  const Duration taken =
      processor_time([&] { EXPECT_EQ(ask(range).at(0).range().at_tid(), kNoTid); });
  EXPECT_LT(10 * taken, all_retries);
}

TEST_F(SearchWithoutEnd, GoesOnInLaterTurnsAndIsGivenUp) {
  net::Frame frame = with_serial(2);
  frame.mutable_read()->set_time_ns(1);
  EXPECT_TRUE(ask(frame).empty()) << "after 8 turns";
  rig.turns(200);
  const std::vector<net::Frame> answers = peer.take();
  ASSERT_EQ(answers.size(), 1U);
  EXPECT_EQ(answers[0].no_sample().status(), static_cast<std::uint32_t>(ReadStatus::lapped));
}

// --- subscriptions

TEST_F(StreamChannelTest, SendsFirstWhatTheReceiverMissedLongest) {
  const auto blocks = rig.create("blocks", 8000, 64);
  rig.write(*blocks, 40);
  const auto order = [&](std::optional<Tid> backlog_from, std::uint64_t incarnation) {
    MemoryPeer other;
    rig.connect(other);
    rig.open(other, "blocks");
    net::Frame frame = with_serial(61);
    net::Subscribe& subscribe = *frame.mutable_subscribe();
    subscribe.set_newest_first(true);
    subscribe.set_from_tid(0);
    subscribe.set_incarnation(incarnation);
    if (backlog_from) subscribe.set_backlog_from(*backlog_from);
    other.put(frame);
    rig.turns();
    return words(other.take()).substr(0, 21);
  };
  const std::uint64_t incarnation = blocks->incarnation();
  EXPECT_EQ(order(0, incarnation), "subscribed:0 39 0 1 2");
  EXPECT_EQ(order(std::nullopt, incarnation), "subscribed:0 39 31 32");
  EXPECT_EQ(order(0, incarnation + 1), "subscribed:0 39 31 32") << "those of another ring";
}

TEST_F(StreamChannelTest, BeginsASubscriptionWhereItIsAskedTo) {
  rig.write(*stream, 20);
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_oldest(true); }),
            "subscribed:13 13 14 15 16 17 18 19 caught_up");
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_now(true); }), "subscribed:20 caught_up");
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_newest(true); }), "subscribed:19 19 caught_up");
  EXPECT_EQ(subscribe([](auto&) {}), "subscribed:20 caught_up");
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_tid(17); }), "subscribed:17 17 18 19 caught_up");
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_tid(10); }),
            "subscribed:10 gap:10+3 13 14 15 16 17 18 19 caught_up");
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_time_ns(1175); }),
            "subscribed:17 17 18 19 caught_up");
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_time_ns(5); }),
            "subscribed:13 13 14 15 16 17 18 19 caught_up");
  rig.write(*stream);
  rig.turns();
  EXPECT_EQ(words(peer.take()), "20") << "the last subscription alone";
}

TEST_F(StreamChannelTest, BeginsAtTheOldestWhenTheTidIsAnotherRings) {
  rig.write(*stream, 3);
  EXPECT_EQ(subscribe([&](auto& s) {
              s.set_from_tid(2);
              s.set_incarnation(stream->incarnation());
            }),
            "subscribed:2 2 caught_up");
  EXPECT_EQ(subscribe([&](auto& s) {
              s.set_from_tid(2);
              s.set_incarnation(stream->incarnation() + 1);
            }),
            "subscribed:0 0 1 2 caught_up");
}

TEST_F(StreamChannelTest, SendsWhatIsWrittenFromThenOn) {
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_now(true); }), "subscribed:0 caught_up");
  for (int i = 0; i < 3; ++i) {
    rig.write(*stream);
    rig.turns();
    EXPECT_EQ(words(peer.take()), std::to_string(i));
  }
}

TEST_F(StreamChannelTest, ServesReadsDuringASubscription) {
  subscribe([](auto& s) { s.set_from_now(true); });
  peer.room = 30;
  rig.write(*stream, 5);
  rig.turns();
  peer.put(with_serial(99, read_frame(4)));
  rig.turns();
  peer.room = MemoryPeer::kAll;
  rig.turns(20);
  std::string subscribed;
  int answers = 0;
  for (const net::Frame& item : peer.take()) {
    if (item.serial() == 99) {
      ++answers;
      EXPECT_EQ(payload_of(item), ServerRig::payload_for(4, kBytes));
    } else {
      subscribed += std::to_string(item.sample().tid());
    }
  }
  EXPECT_EQ(answers, 1);
  EXPECT_EQ(subscribed, "01234");
}

TEST_F(StreamChannelTest, ThinsAtTheSource) {
  rig.write(*stream, 5);
  EXPECT_EQ(subscribe([](auto& s) {
              s.set_from_oldest(true);
              s.set_max_rate_hz(50);
            }),
            "subscribed:0 4 caught_up");
  // A sample each millisecond; 20 ms must pass between two that are sent.
  const MonoTime begin = rig.loop.now();
  std::vector<Tid> got;
  run_until(rig.loop, [&] {
    rig.write(*stream);
    for (const net::Frame& item : peer.take()) {
      EXPECT_TRUE(item.has_sample()) << "a gap for what was left out";
      got.push_back(item.sample().tid());
    }
    return got.size() == 5;
  });
  EXPECT_GE(rig.loop.now() - begin, std::chrono::milliseconds(20 * 4));
  EXPECT_TRUE(std::is_sorted(got.begin(), got.end()));
}

TEST_F(StreamChannelTest, SendsWithThePriorityThatTheStreamHasAtItsSubscription) {
  const auto subscribed = [&] {
    EXPECT_EQ(subscribe([](auto& s) { s.set_from_now(true); }), "subscribed:0 caught_up");
    return *peer.priority;
  };
  EXPECT_EQ(subscribed(), wire::Priority::high) << "a small one";
  rig.server.set_sending({{{"odo*", {wire::Priority::low, 30}}}});
  EXPECT_EQ(subscribed(), wire::Priority::low);
}

TEST_F(StreamChannelTest, RefusesAnInvalidRate) {
  for (const double rate :
       {-1.0, std::numeric_limits<double>::quiet_NaN(), std::numeric_limits<double>::infinity()}) {
    EXPECT_EQ(subscribe([rate](auto& s) { s.set_max_rate_hz(rate); }), "failure:invalid_argument");
  }
}

TEST_F(StreamChannelTest, SendsTheRestThenThatTheStreamWasRemoved) {
  EXPECT_EQ(subscribe([](auto& s) { s.set_from_now(true); }), "subscribed:0 caught_up");
  peer.room = 0;
  rig.write(*stream, 4);
  rig.turns();
  ASSERT_TRUE(rig.registry.remove({"odometry", 0, ""}));
  rig.turns();
  peer.room = MemoryPeer::kAll;
  rig.turns(20);
  EXPECT_EQ(words(peer.take()), "0 1 2 3 removed");
  EXPECT_EQ(words(ask(with_serial(1, read_frame(0)))), "failure:not_found");
  rig.write(*stream);
  rig.turns();
  EXPECT_EQ(words(peer.take()), "") << "nothing follows";
}

TEST_F(StreamChannelTest, ReportsTheRemovalAlsoWithoutASubscription) {
  ASSERT_TRUE(rig.registry.remove({"odometry", 0, ""}));
  rig.turns();
  EXPECT_EQ(words(peer.take()), "removed");
}

TEST_F(StreamChannelTest, DoesNotDisturbTheWriterWithoutASubscriber) {
  const auto is_armed = [&] { return stream->mapping().header().doorbell_armed != 0; };
  EXPECT_FALSE(is_armed());
  subscribe([](auto& s) { s.set_from_now(true); });
  EXPECT_TRUE(is_armed());
  peer.end();
  rig.turns();
  EXPECT_FALSE(is_armed());
}

// --- publishing

TEST_F(StreamChannelTest, WritesWhatIsPublishedAndAcknowledgesEachBatchOnce) {
  const net::Publishing publishing = start_publishing(11);
  EXPECT_EQ(publishing.last(), -1);
  EXPECT_EQ(publishing.incarnation(), stream->incarnation());
  Bytes batch;
  for (const std::int64_t number : {0, 1, 2}) {
    const Bytes one = sample_frame(number);
    batch.insert(batch.end(), one.begin(), one.end());
  }
  peer.put(batch);
  rig.turns();
  EXPECT_EQ(words(peer.take()), "published:2=2");
  const ring::RingReader reader(stream->mapping());
  Bytes payload(kBytes);
  SampleInfo info;
  ASSERT_EQ(reader.read(1, payload, info), ReadStatus::ok);
  EXPECT_EQ(payload, Bytes(kBytes, std::byte{9}));
  EXPECT_EQ(to_ns(info.time), 5001);
  EXPECT_EQ(info.clock_error, Duration(4));
  peer.put(sample_frame(3, 77));
  rig.turns();
  const std::vector<net::Frame> items = peer.take();
  EXPECT_EQ(words(items), "published:3=3");
  EXPECT_EQ(items[0].serial(), 77u);
}

TEST_F(StreamChannelTest, WritesEachSampleOnceOverReconnects) {
  start_publishing(11);
  peer.put(sample_frame(0));
  peer.put(sample_frame(1));
  rig.turns();
  peer.take();
  peer.end();
  rig.turns();
  rig.write(*stream);  // somebody else writes meanwhile

  MemoryPeer again;
  rig.connect(again);
  rig.open(again, "odometry");
  const net::Frame answer = rig.ask(again, start_publishing_request(11));
  EXPECT_EQ(answer.publishing().last(), 1);
  EXPECT_EQ(answer.publishing().last_tid(), 1);
  again.put(sample_frame(1));  // sent again, although it was written
  again.put(sample_frame(2));
  again.put(sample_frame(5));  // the client dropped some
  rig.turns();
  EXPECT_EQ(words(again.take()), "published:1=1 published:2=3 published:5=4");
  EXPECT_EQ(stream->info().newest, 4);
  EXPECT_EQ(rig.ask(again, start_publishing_request(12)).publishing().last(), -1)
      << "another publisher";
}

// The ring outlives dssmd, and what stands in it about publishers does.
TEST_F(StreamChannelTest, KnowsPublishersOfARingThatIsOfferedBack) {
  start_publishing(11);
  for (const std::int64_t number : {0, 3, 4}) peer.put(sample_frame(number));
  rig.turns();
  peer.take();
  ServerRig next;
  const std::shared_ptr<Stream> same =
      next.registry
          .adopt_untrusted({"odometry", 0, ""},
                           as_offer(stream->descriptors_for(Role::writer).value()))
          .value();
  MemoryPeer again;
  next.connect(again);
  next.open(again, "odometry");
  const net::Frame answer = next.ask(again, start_publishing_request(11));
  EXPECT_EQ(answer.publishing().last(), 4);
  EXPECT_EQ(answer.publishing().last_tid(), 2);
  again.put(sample_frame(4));
  again.put(sample_frame(5));
  next.turns();
  EXPECT_EQ(words(again.take()), "published:4=2 published:5=3");
  EXPECT_EQ(same->info().newest, 3);
}

// A connection was cut in the middle of a sample, and what was under way arrives after all, while
// the publisher has gone on by another one.
TEST_F(StreamChannelTest, WritesEachSampleOnceWhenAnOldConnectionContinues) {
  constexpr std::uint64_t kInPieces = 100'000;  // received piece by piece
  const std::shared_ptr<Stream> camera = rig.create("camera", kInPieces);
  MemoryPeer old, again;
  for (MemoryPeer* one : {&old, &again}) {
    rig.connect(*one);
    rig.open(*one, "camera");
    EXPECT_EQ(rig.ask(*one, start_publishing_request(11)).publishing().last(), -1);
  }
  const auto large = [](std::int64_t number) { return sample_frame(number, 0, kInPieces); };
  const Bytes first = large(0);
  old.put({first.begin(), first.begin() + 50'000});
  rig.turns();
  for (const std::int64_t number : {0, 1, 2}) again.put(large(number));
  rig.turns();
  EXPECT_EQ(camera->info().newest, 2);
  old.put({first.begin() + 50'000, first.end()});
  old.put(large(1));
  rig.turns();
  EXPECT_EQ(camera->info().newest, 2);
  EXPECT_EQ(words(old.take()), "published:2=2 published:2=2");
  again.put(large(3));
  rig.turns();
  EXPECT_EQ(camera->info().newest, 3);
}

TEST_F(StreamChannelTest, AcknowledgesWhatWasWrittenBeforeWithoutWritingIt) {
  start_publishing(11);
  peer.put(sample_frame(4));
  rig.turns();
  peer.take();
  peer.put(sample_frame(4, 88));
  rig.turns();
  const std::vector<net::Frame> items = peer.take();
  EXPECT_EQ(words(items), "published:4=0");
  EXPECT_EQ(items[0].serial(), 88u);
  EXPECT_EQ(stream->info().newest, 0);
}

TEST_F(StreamChannelTest, BringsPublishedSamplesToOtherChannels) {
  MemoryPeer reader;
  rig.connect(reader);
  rig.open(reader, "odometry");
  net::Frame frame = with_serial(60);
  frame.mutable_subscribe()->set_from_now(true);
  reader.put(frame);
  rig.turns();
  reader.take();
  start_publishing(11);
  peer.put(sample_frame(0));
  rig.turns();
  EXPECT_EQ(words(reader.take()), "0");
}

TEST_F(StreamChannelTest, EndsAloneWhenASampleFindsNoMemory) {
  start_publishing(11);
  MemoryPeer without_memory, other;
  for (MemoryPeer* reader : {&without_memory, &other}) {
    rig.connect(*reader);
    rig.open(*reader, "odometry");
    net::Frame frame = with_serial(60);
    frame.mutable_subscribe()->set_from_now(true);
    reader->put(frame);
    rig.turns();
    EXPECT_EQ(words(reader->take()), "subscribed:0 caught_up");
  }
  bool has_thrown = false;
  without_memory.after_send = [&] {
    if (!std::exchange(has_thrown, true)) throw std::bad_alloc();
  };
  for (const Tid tid : {0, 1}) {
    peer.put(sample_frame(tid));
    rig.turns();
    EXPECT_EQ(words(other.take()), std::to_string(tid));
  }
  EXPECT_TRUE(has_thrown);
  EXPECT_TRUE(without_memory.closed);
  EXPECT_FALSE(peer.closed) << "the publisher, whose sample it was";
}

TEST_F(StreamChannelTest, RefusesSamplesBeforeStartPublishing) {
  peer.put(sample_frame(0));
  rig.turns();
  EXPECT_TRUE(peer.closed);
  EXPECT_NE(peer.take().back().failure().message().find("StartPublishing"), std::string::npos);
}

TEST_F(StreamChannelTest, DoesNotWaitForAProgramThatHoldsTheLock) {
  start_publishing(11);
  // A program in the middle of filling a slot, in a thread of its own, as locks are threads'.
  const auto mapping = stream->map_for_writing().value();
  const auto bell = stream->map_bell().value();
  std::atomic<int> step = 0;
  std::thread program([&] {
    ring::RingWriter writer(*mapping, *bell, -1);
    EXPECT_TRUE(writer.begin());
    step = 1;
    step.notify_all();
    step.wait(1);
    writer.cancel();
    step = 3;
    step.notify_all();
  });
  step.wait(0);
  for (const std::int64_t number : {0, 1, 2}) peer.put(sample_frame(number));
  rig.turns(20);
  EXPECT_EQ(words(peer.take()), "");
  MemoryPeer other;
  rig.connect(other);  // the loop goes on
  step = 2;
  step.notify_all();
  step.wait(2);
  program.join();
  std::vector<net::Frame> items;
  run_until(rig.loop, [&] {
    for (net::Frame& item : peer.take()) items.push_back(std::move(item));
    return stream->info().newest == 2 && !items.empty() && items.back().published().last() == 2;
  });
}

TEST_F(StreamChannelTest, HoldsNoMoreForAPublisherThanItsHostMay) {
  ServerRig small({16, 8, 1U << 20});
  small.create("camera", 900 << 10, 4);
  MemoryPeer camera;
  small.connect(camera);
  small.open(camera, "camera");
  const net::Frame refused = small.ask(camera, start_publishing_request(3));
  EXPECT_EQ(refused.failure().code(), "limit_exceeded");
  EXPECT_NE(refused.failure().message().find("max_peer_memory"), std::string::npos);
  EXPECT_NE(refused.failure().message().find("'camera:0@pc1'"), std::string::npos);
}

// --- turns

// Four channels, and each frame that one of them is sent takes the time that all have in a turn.
class SlowChannels : public StreamChannelTest {
 protected:
  void begin(const std::function<net::Frame(std::uint64_t number)>& request) {
    for (std::uint64_t i = 0; i < std::size(peers); ++i) {
      rig.connect(peers[i]);
      rig.open(peers[i], "odometry");
      peers[i].put(request(i));
      rig.turns();
      EXPECT_FALSE(peers[i].take().empty());
      peers[i].after_send = [] {
        for (const MonoTime begin = MonoClock::now();
             MonoClock::now() - begin < TurnQueue::kMaxTurn;) {
        }
      };
    }
  }
  // In one turn of the loop: one at once, and one of those that waited.
  void expect_served_in_turns() {
    const auto served = [this] {
      return std::count_if(std::begin(peers), std::end(peers),
                           [](const MemoryPeer& one) { return !one.sent.empty(); });
    };
    for (int turn = 0; turn < 20 && served() < 4; ++turn) {
      const auto before = served();
      rig.turns(1);
      EXPECT_LE(served() - before, 2);
    }
    EXPECT_EQ(served(), 4);
  }
  MemoryPeer peers[4];
};

TEST_F(SlowChannels, AreSentSamplesInTurns) {
  begin([](std::uint64_t) {
    net::Frame frame = with_serial(60);
    frame.mutable_subscribe()->set_from_now(true);
    return frame;
  });
  rig.write(*stream);
  expect_served_in_turns();
}

TEST_F(SlowChannels, HaveTheirSamplesTakenInTurns) {
  begin([](std::uint64_t number) { return start_publishing_request(20 + number); });
  for (MemoryPeer& one : peers) one.put(sample_frame(0));
  expect_served_in_turns();
  EXPECT_EQ(ring::RingReader(stream->mapping()).newest(), 3);
}

TEST_F(StreamChannelTest, TakesManySmallSamplesInSeveralTurns) {
  start_publishing(11);
  constexpr int kSamples = 20'000;
  Bytes samples;
  for (int i = 0; i < kSamples; ++i) {
    const Bytes one = sample_frame(i);
    samples.insert(samples.end(), one.begin(), one.end());
  }
  peer.max_receive_bytes = 16U << 10;
  peer.put(samples);
  rig.turns(1);
  const ring::RingReader reader(stream->mapping());
  EXPECT_LT(reader.newest(), 2 * Tid{FrameConnection::kSamplesPerTurn});
  run_until(rig.loop, [&] { return reader.newest() == kSamples - 1; });
}

// --- property

TEST_F(StreamChannelTest, KeepsThePropertyForAllPeers) {
  net::Frame get = with_serial(1), set = with_serial(2);
  get.mutable_get_property();
  set.mutable_set_property()->set_property("calibration");
  EXPECT_EQ(words(ask(get)), "failure:not_found");
  EXPECT_TRUE(ask(set).at(0).has_done());
  EXPECT_EQ(ask(get).at(0).property().property(), "calibration");
  MemoryPeer control;
  rig.connect(control);
  get.mutable_get_property()->mutable_id()->set_name("odometry");
  EXPECT_EQ(rig.ask(control, get).property().property(), "calibration");
  set.mutable_set_property()->mutable_id()->set_name("odometry");
  set.mutable_set_property()->set_property("");
  EXPECT_TRUE(rig.ask(control, set).has_done());
  EXPECT_EQ(rig.ask(control, get).failure().code(), "not_found");
}

// --- clocks

class WriterOfAnotherClock : public testing::Test {
 protected:
  void start_publishing() {
    rig.connect(peer);
    rig.open(peer, "far");
    EXPECT_TRUE(rig.ask(peer, start_publishing_request(11)).has_publishing());
  }
  ring::ClockAssessment stated() const { return ring::RingReader(stream->mapping()).clock(); }

  FakeClockAssessor assessor;
  ServerRig rig{{16, 8, 32U << 20}, &assessor};
  MemoryPeer peer;
  std::shared_ptr<Stream> stream = rig.create("far");
};

TEST_F(WriterOfAnotherClock, HasTheStreamsTimesAssessedFromThenOn) {
  assessor.own_bound = std::chrono::microseconds(100);
  rig.server.on_clock();
  EXPECT_TRUE(stated().same_clock) << "only this PC writes to it yet";
  start_publishing();
  EXPECT_FALSE(stated().same_clock);
  EXPECT_EQ(stated().policy, ClockPolicy::enforce);
  EXPECT_EQ(stated().added, assessor.own_bound);
  assessor.own_bound = std::chrono::microseconds(300);
  rig.server.on_clock();
  EXPECT_EQ(stated().added, assessor.own_bound);
}

// Which samples are of the new setting of a clock follows from it.
TEST_F(StreamChannelTest, BeforeSamplesOfANewGenerationOfTheClockComeItsReportAndTheNewestTid) {
  FakeClockAssessor assessor;
  ServerRig with_clock{{16, 8, 32U << 20}, &assessor};
  MemoryPeer reader;
  stream = with_clock.create("odometry", kBytes, 8);
  with_clock.write(*stream, 3);
  with_clock.connect(reader, false);
  wire::Greeting greeting = greeting_of("pc2");
  greeting.features = {std::string(wire::kFeatureClock)};
  reader.put(hello_frame(greeting));
  with_clock.turns();
  reader.take();
  with_clock.open(reader, "odometry");
  const auto came = [&] {
    with_clock.turns();
    return words(reader.take());
  };
  net::Frame subscribe = with_serial(60);
  subscribe.mutable_subscribe()->set_from_oldest(true);
  reader.put(subscribe);
  EXPECT_EQ(came(), "subscribed:0 clock@2 0 1 2 caught_up");
  with_clock.write(*stream);
  EXPECT_EQ(came(), "3");
  ++assessor.generation;
  with_clock.write(*stream, 2);
  EXPECT_EQ(came(), "clock@5 4 5");
  ++assessor.generation;
  with_clock.server.send_clock();
  EXPECT_EQ(came(), "") << "it can wait for the next sample";
  with_clock.own_clock->settled_from = time_from_ns(7);
  with_clock.server.send_clock();
  EXPECT_EQ(came(), "clock@5") << "the next sample is of this setting";
  with_clock.write(*stream);
  EXPECT_EQ(came(), "6");
  const auto mapping = stream->map_for_writing().value();
  mapping->header().clock.store(ring::ClockAssessment());  // as when another host writes to it
  with_clock.write(*stream);
  EXPECT_EQ(came(), "mixed@7 7");
  subscribe.mutable_subscribe()->set_from_now(true);
  reader.put(subscribe);
  EXPECT_EQ(came(), "subscribed:8 mixed@7 caught_up") << "the client may have earlier samples";
}

TEST_F(WriterOfAnotherClock, IsNoneWhenItsKernelIsThisOne) {
  assessor.same_clock = true;
  start_publishing();
  rig.server.on_clock();
  EXPECT_FALSE(stream->mapping().header().clock.is_set());
}

}  // namespace
}  // namespace dssm::daemon
