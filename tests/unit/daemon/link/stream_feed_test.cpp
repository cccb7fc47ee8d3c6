// SPDX-License-Identifier: Apache-2.0
//
// How dssmd hears of new samples: every one of them once somebody waits, and nothing when nobody
// does.
#include "daemon/link/stream_feed.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <set>

#include "core/ring/ring_writer.hpp"
#include "tests/support/memory_peer.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;

class StreamFeedTest : public testing::Test, protected StreamFeed::Observer {
 protected:
  // A program that writes.
  struct Program {
    explicit Program(OfferedFiles its_files) : files(std::move(its_files)) {
      mapping =
          ring::RingMapping::open_untrusted(files.ring.get(), ring::Access::read_write).value();
      bell = ring::Bell::open_untrusted(files.bell.get()).value();
    }
    Tid write() {
      const Bytes payload(24);
      return ring::RingWriter(*mapping, *bell, files.doorbell.get())
          .write(payload, {}, kUnknownClockError);
    }
    bool is_armed() const { return mapping->header().doorbell_armed != 0; }
    // How often the doorbell was rung since this was asked last.
    std::uint64_t rings() const {
      std::uint64_t count = 0;
      return ::read(files.doorbell.get(), &count, sizeof count) == sizeof count ? count : 0;
    }
    OfferedFiles files;
    std::shared_ptr<const ring::RingMapping> mapping;
    std::shared_ptr<ring::Bell> bell;
  };

  Program writer() { return Program(as_offer(stream->descriptors_for(Role::writer).value())); }

  void on_sample_available() override {
    ++notifications;
    if (on_notified) on_notified();
  }

  EventLoop loop = *EventLoop::open();
  Registry registry{"pc1", kLimits};
  std::shared_ptr<Stream> stream =
      registry.create({"odometry", 0, ""}, odometry_type(), kHistory, 1)->stream;
  std::shared_ptr<StreamFeed> feed = StreamFeed::open(loop, stream).value();
  int notifications = 0;
  std::function<void()> on_notified;
};

TEST_F(StreamFeedTest, NotifiesOnceOfANewerSample) {
  Program program = writer();
  ASSERT_TRUE(feed->wait(*this, kNoTid));
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 0);
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 1);
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 1) << "it does not wait any more";
}

TEST_F(StreamFeedTest, ReportsAtOnceASampleThatIsThere) {
  Program program = writer();
  program.write();
  EXPECT_FALSE(feed->wait(*this, kNoTid));
  EXPECT_FALSE(program.is_armed());
  EXPECT_TRUE(feed->wait(*this, 0));
}

TEST_F(StreamFeedTest, LetsWritersRingOnlyWhileAnObserverWaits) {
  Program program = writer();
  EXPECT_FALSE(program.is_armed());
  program.write();
  EXPECT_EQ(program.rings(), 0u);
  ASSERT_TRUE(feed->wait(*this, 0));
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(program.rings(), 1u);
  EXPECT_EQ(notifications, 1);
  for (int i = 0; i < 100; ++i) program.write();
  EXPECT_EQ(program.rings(), 0u) << "whoever was told is at work, and needs no ring";
}

TEST_F(StreamFeedTest, ArmsAgainForAnObserverThatWaitsForALaterSample) {
  Program program = writer();
  ASSERT_TRUE(feed->wait(*this, 2));  // wants sample 3
  for (int i = 0; i < 3; ++i) {
    program.write();
    run_turns(loop, 3);
  }
  EXPECT_EQ(notifications, 0);
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 1);
}

TEST_F(StreamFeedTest, MissesNoSampleThatIsWrittenDuringANotification) {
  Program program = writer();
  Tid known = kNoTid;
  on_notified = [&] {
    program.write();  // after the bell was looked at
    known = ring::RingReader(stream->mapping()).newest();
    EXPECT_TRUE(feed->wait(*this, known));
  };
  ASSERT_TRUE(feed->wait(*this, known));
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 1);
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 2);
  EXPECT_EQ(known, 3);
}

TEST_F(StreamFeedTest, WatchesEveryDoorbellOfItsStream) {
  Program first = writer();
  // A writer that kept a doorbell of its own over a restart.
  UniqueFd kept(::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC));
  Program second = writer();
  second.files.doorbell = copy_of(kept);
  stream->take_doorbell_untrusted(7, std::move(kept));
  for (Program* program : {&first, &second, &first, &second}) {
    const int before = notifications;
    ASSERT_TRUE(feed->wait(*this, ring::RingReader(stream->mapping()).newest()));
    program->write();
    run_turns(loop, 3);
    EXPECT_EQ(notifications, before + 1);
  }
}

TEST_F(StreamFeedTest, RemovesAnObserverAlsoDuringANotification) {
  struct Other final : StreamFeed::Observer {
    void on_sample_available() override { ++notifications; }
    int notifications = 0;
  } other;
  Program program = writer();
  ASSERT_TRUE(feed->wait(*this, kNoTid));
  ASSERT_TRUE(feed->wait(other, kNoTid));
  on_notified = [&] { feed->forget(other); };
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 1);
  EXPECT_EQ(other.notifications, 0);
  ASSERT_TRUE(feed->wait(other, 0));
  feed->forget(other);
  EXPECT_FALSE(program.is_armed());
}

TEST_F(StreamFeedTest, ChecksTheRingWhenPolled) {
  Program program = writer();
  ASSERT_TRUE(feed->wait(*this, kNoTid));
  feed->poll();
  EXPECT_EQ(notifications, 0);
  // A writer that was killed before it could ring.
  UniqueFd doorbell = std::move(program.files.doorbell);
  program.write();
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 0);
  feed->poll();
  EXPECT_EQ(notifications, 1);
}

TEST_F(StreamFeedTest, DisarmsWhenItGoes) {
  Program program = writer();
  ASSERT_TRUE(feed->wait(*this, kNoTid));
  EXPECT_TRUE(program.is_armed());
  feed.reset();
  EXPECT_FALSE(program.is_armed());
}

// The client's connection may end in the same turn of the loop in which its doorbell rang.
TEST_F(StreamFeedTest, MissesNoSampleOfAClientThatIsGone) {
  Program program(as_offer(stream->descriptors_for(Role::writer, 7).value()));
  ASSERT_TRUE(feed->wait(*this, kNoTid));
  program.write();
  stream->remove_doorbell(7);
  run_turns(loop, 3);
  EXPECT_EQ(notifications, 1);
}

TEST(Doorbells, AreOfOneClientEach) {
  Registry registry("pc1", kLimits);
  const auto stream = registry.create({"odometry", 0, ""}, odometry_type(), kHistory, 1)->stream;
  struct Watch final : DoorbellObserver {
    void on_doorbell_added(int fd) override { fds.insert(fd); }
    void on_doorbell_removed(int fd) override { EXPECT_EQ(fds.erase(fd), 1u); }
    std::set<int> fds;
  } watch;
  stream->observe_doorbells(&watch);
  const auto doorbell_for = [&](ClientNumber client) {
    return as_offer(stream->descriptors_for(Role::writer, client).value()).doorbell;
  };
  const auto rings = [](const UniqueFd& doorbell) {
    std::uint64_t count = 0;
    return ::read(doorbell.get(), &count, sizeof count) == sizeof count;
  };
  const UniqueFd one = doorbell_for(1), same = doorbell_for(1), two = doorbell_for(2);
  EXPECT_EQ(watch.fds.size(), 2u);
  ASSERT_EQ(::eventfd_write(one.get(), 1), 0);
  EXPECT_FALSE(rings(two)) << "another program's";
  EXPECT_TRUE(rings(same));

  const auto eventfd = [] { return UniqueFd(::eventfd(0, EFD_NONBLOCK | EFD_CLOEXEC)); };
  stream->take_doorbell_untrusted(3, eventfd());
  stream->take_doorbell_untrusted(3, eventfd());
  EXPECT_EQ(watch.fds.size(), 3u) << "one per client, the last one";
  int pipe_ends[2];
  ASSERT_EQ(::pipe2(pipe_ends, O_CLOEXEC), 0);
  const UniqueFd write_end(pipe_ends[1]);
  stream->take_doorbell_untrusted(4, UniqueFd(pipe_ends[0]));
  EXPECT_EQ(watch.fds.size(), 3u) << "no eventfd";

  stream->remove_doorbell(2);
  stream->remove_doorbell(2);
  EXPECT_EQ(watch.fds.size(), 2u);
  stream->observe_doorbells(nullptr);
}

}  // namespace
}  // namespace dssm::daemon
