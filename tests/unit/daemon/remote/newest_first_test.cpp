// SPDX-License-Identifier: Apache-2.0
//
// The newest samples first, from an owner's ring to a mirror's: whatever the network does, each
// sample is received or counted as lost, once, and none stays awaited for ever.
#include <cstring>
#include <random>

#include "daemon/link/sample_pump.hpp"
#include "daemon/remote/mirror_ring.hpp"
#include "tests/support/memory_peer.hpp"
#include "tests/support/sanitized.hpp"
#include "tests/unit/core/ring/test_ring.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;

Time time_of(Tid tid) { return time_from_ns(1'000'000 + tid * 1000); }

// Some samples are shorter than the stream's.
std::vector<std::byte> payload_for(Tid tid, std::size_t payload_bytes) {
  return ring::payload_for(tid, tid % 3 == 1 ? payload_bytes / 4 : payload_bytes);
}

// A connection from the owner to the mirror, and what the mirror makes of its frames.
class Channel final : private FrameConnection::Observer, private SamplePump::Observer {
 public:
  Channel(const EventLoop& loop, const ring::TestRing& owner, MirrorRing& mirror)
      : mirror_(mirror),
        link_(loop, std::make_unique<MemoryTransport>(peer), *this, 1U << 20),
        sender_(*owner.mapping, link_, {true, &budget_}) {
    net::Subscribe request;
    mirror.resume(true, true, request);
    const Tid first = request.from_oldest() ? 0 : request.from_tid();
    EXPECT_TRUE(mirror.on_subscribed_untrusted(first, true, 0));
    SamplePump::Plan plan;
    plan.first = first;
    plan.newest_first = true;
    plan.held = {request.held_from(), request.held_to()};
    if (request.has_backlog_from()) plan.backlog_from = request.backlog_from();
    pump_.emplace(*owner.mapping, link_, sender_, static_cast<SamplePump::Observer&>(*this), plan);
  }

  PumpWait pump(MonoTime now) {
    const Result<PumpWait> wait = pump_->pump(now);
    EXPECT_TRUE(wait) << wait.error().message;
    return wait ? *wait : PumpWait::ended;
  }
  bool is_idle() const { return link_.output_empty() && consumed_ == peer.sent.size(); }

  // The mirror gets what was sent.
  void deliver() {
    while (consumed_ < peer.sent.size()) {
      const std::span<std::byte> space = input_.space();
      const std::size_t part = std::min(space.size(), peer.sent.size() - consumed_);
      std::memcpy(space.data(), peer.sent.data() + consumed_, part);
      consumed_ += part;
      input_.commit(part);
      while (const std::optional<net::Frame> frame = input_.next()) take(*frame);
    }
    mirror_.wake();
  }

  MemoryPeer peer;

 private:
  void take(const net::Frame& frame) {
    if (frame.has_gap()) {
      EXPECT_TRUE(mirror_.on_gap_untrusted(frame.gap().first_tid(), frame.gap().count()));
    }
    if (!frame.has_sample()) return;
    const std::vector<std::byte> payload = test::payload_of(frame);
    const wire::IncomingSample sample{0,
                                      {frame.sample().tid(), time_from_ns(frame.sample().time_ns()),
                                       Duration(5), payload.size()}};
    const Result<std::byte*> place = mirror_.begin_untrusted(sample);
    ASSERT_TRUE(place) << place.error().message;
    std::memcpy(*place, payload.data(), payload.size());
    mirror_.end(sample, frame.torn());
  }
  Result<void> on_frame(net::Frame&) override { return {}; }
  void on_closed(const Error& why) override { ADD_FAILURE() << why.message; }
  void on_gap(Tid first, std::uint64_t count) override { link_.send(gap_frame(first, count)); }

  MirrorRing& mirror_;
  MemoryBudget budget_{1U << 30};
  FrameConnection link_;
  SampleSender sender_;
  std::optional<SamplePump> pump_;
  FrameInput input_;
  std::size_t consumed_ = 0;
};

class NewestFirstEndToEnd : public testing::TestWithParam<std::size_t> {};
INSTANTIATE_TEST_SUITE_P(PayloadBytes, NewestFirstEndToEnd,
                         testing::Values(40, 8000, 20'000, 65'537),
                         testing::PrintToStringParamName());

TEST_P(NewestFirstEndToEnd, EachSampleIsReceivedOrLostOnce) {
  const std::size_t payload_bytes = GetParam();
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  const int rounds = (payload_bytes == 40 ? 30 : 8) / (test::kIsSanitized ? 4 : 1);
  for (int round = 0; round < rounds && !testing::Test::HasFailure(); ++round) {
    const std::uint64_t depth = 4 + random() % 60;
    const EventLoop loop = *EventLoop::open();
    const ring::TestRing owner(payload_bytes, depth);
    ring::RingWriter writer = owner.writer();
    MemoryBudgets budgets{1U << 30, {}};
    const auto stream = Stream::create({.id = {"test", 0, "pc1"},
                                        .type = {"", payload_bytes, 1, {}},
                                        .depth = depth,
                                        .cycle = std::chrono::milliseconds(1),
                                        .purpose = Purpose::mirror,
                                        .incarnation = 42},
                                       budgets)
                            .value();
    const std::unique_ptr<MirrorRing> mirror = MirrorRing::open(stream, budgets.total()).value();
    auto channel = std::make_unique<Channel>(loop, owner, *mirror);
    MonoTime now{std::chrono::seconds(1000)};
    Tid written = 0;
    const auto write = [&](std::uint64_t count) {
      for (; count > 0; --count, ++written) {
        writer.write(payload_for(written, payload_bytes), time_of(written), Duration(5));
      }
    };
    const bool is_slow = round % 2 == 0;  // the network never carries all
    write(1);
    for (int step = 0; step < 300; ++step) {
      const auto what = random() % 100;
      write(is_slow ? 3 : what < 3 ? random() % (2 * depth) : random() % 4);
      if (what == 50) channel = std::make_unique<Channel>(loop, owner, *mirror);  // a cut
      const auto room = random() % 4;
      channel->peer.room = is_slow     ? random() % (2 * payload_bytes + 100)
                           : room == 0 ? 0
                           : room == 1 ? MemoryPeer::kAll
                                       : random() % (3 * payload_bytes + 100);
      now += std::chrono::milliseconds(random() % 300);
      run_turns(loop);
      channel->pump(now);
      if (random() % 3 > 0) channel->deliver();
    }
    channel->peer.room = MemoryPeer::kAll;
    while (channel->pump(now) != PumpWait::sample || !channel->is_idle()) {
      run_turns(loop);
      channel->deliver();
    }
    const ring::RingReader reader(stream->mapping());
    EXPECT_EQ(mirror->newest(), written - 1);
    EXPECT_EQ(mirror->filling_samples(), 0U);
    EXPECT_EQ(mirror->received_samples() + mirror->gap_samples(),
              static_cast<std::uint64_t>(written));
    std::vector<std::byte> payload(payload_bytes);
    SampleInfo info;
    for (Tid tid = reader.oldest(); tid < written; ++tid) {
      const ReadStatus status = reader.read(tid, payload, info);
      if (status == ReadStatus::lost) continue;
      ASSERT_EQ(name_of(status), name_of(ReadStatus::ok)) << tid;
      EXPECT_EQ(info.time, time_of(tid));
      ASSERT_EQ(std::vector(payload.begin(), payload.begin() + info.payload_bytes),
                payload_for(tid, payload_bytes));
      Tid found = kNoTid;
      ASSERT_EQ(reader.find(time_of(tid), found), ReadStatus::ok);
      ASSERT_EQ(found, tid);
    }
  }
}

}  // namespace
}  // namespace dssm::daemon
