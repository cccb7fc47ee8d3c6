// SPDX-License-Identifier: Apache-2.0
//
// A link over a transport of the test's own: order and bounds of what is sent, pauses, and how it
// ends.
#include "daemon/link/frame_connection.hpp"

#include <optional>

#include "tests/support/memory_peer.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace test;

net::Frame property(std::uint64_t serial, std::size_t bytes) {
  net::Frame frame;
  frame.set_serial(serial);
  frame.mutable_property()->set_property(std::string(bytes, 'p'));
  return frame;
}

net::Frame ping(std::uint64_t serial) { return with_serial(serial, ping_frame()); }

iovec part(const Bytes& bytes, std::size_t from, std::size_t to) {
  return {const_cast<std::byte*>(bytes.data()) + from, to - from};
}

class FrameConnectionTest : public testing::Test,
                            protected FrameConnection::Observer,
                            protected FrameConnection::SampleDelegate {
 protected:
  static constexpr std::size_t kMaxQueued = 10'000;
  static constexpr std::size_t kPayloadBytes = 100;

  FrameConnectionTest() { link->take_samples(kPayloadBytes, *this); }

  Result<void> on_frame(net::Frame& frame) override {
    received_serials.push_back(frame.serial());
    return handler ? handler(frame) : Result<void>();
  }
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override {
    begun.push_back(sample.info.tid);
    if (hold_sample) {
      link->pause();
      return {};
    }
    payload.assign(sample.info.payload_bytes, std::byte{0});
    out = payload.data();
    return {};
  }
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool) override {
    ended.push_back(sample.info.tid);
    return {};
  }
  void on_batch_end() override { ++batches; }
  void on_output_empty() override { ++empties; }
  void on_closed(const Error& error) override {
    EXPECT_FALSE(closed_with) << "told twice";
    closed_with = error;
  }

  std::vector<std::uint64_t> serials_sent() {
    std::vector<std::uint64_t> serials;
    for (const net::Frame& item : frames_of(peer.sent)) serials.push_back(item.serial());
    return serials;
  }

  EventLoop loop = *EventLoop::open();
  MemoryPeer peer;
  std::function<Result<void>(net::Frame&)> handler;
  std::vector<std::uint64_t> received_serials;
  std::vector<Tid> begun, ended;
  Bytes payload;
  bool hold_sample = false;
  int batches = 0, empties = 0;
  std::optional<Error> closed_with;
  std::optional<FrameConnection> link{std::in_place, loop, std::make_unique<MemoryTransport>(peer),
                                      static_cast<FrameConnection::Observer&>(*this), kMaxQueued};
};

using Serials = std::vector<std::uint64_t>;

TEST_F(FrameConnectionTest, SendsAtOnceWhatThePeerTakes) {
  link->send(ping(1));
  EXPECT_EQ(serials_sent(), Serials{1}) << "without a turn of the loop";
  EXPECT_TRUE(link->output_empty());
}

TEST_F(FrameConnectionTest, KeepsTheOrderWhereverThePeerStops) {
  const std::size_t all = to_bytes(property(1, 50)).size() + to_bytes(ping(2)).size() +
                          to_bytes(property(3, 200)).size();
  for (std::size_t room = 0; room <= all; ++room) {
    MemoryPeer other;
    other.room = room;
    FrameConnection one(loop, std::make_unique<MemoryTransport>(other), *this, kMaxQueued);
    one.send(property(1, 50));
    one.send(ping(2));
    one.send(property(3, 200));
    EXPECT_EQ(one.output_empty(), room == all);
    other.room = MemoryPeer::kAll;
    other.max_send_bytes = 7;
    run_turns(loop, 100);
    EXPECT_TRUE(one.output_empty());
    Serials serials;
    for (const net::Frame& item : frames_of(other.sent)) serials.push_back(item.serial());
    EXPECT_EQ(serials, (Serials{1, 2, 3})) << "room for " << room;
  }
}

TEST_F(FrameConnectionTest, ReportsWhenItsOutputIsEmpty) {
  peer.room = 3;
  link->send(ping(1));
  EXPECT_EQ(empties, 0);
  peer.room = MemoryPeer::kAll;
  run_turns(loop, 3);
  EXPECT_EQ(empties, 1);
  link->want_output();
  run_turns(loop, 3);
  EXPECT_EQ(empties, 2) << "asked for without anything waiting";
}

TEST_F(FrameConnectionTest, PutsNoFrameIntoTheMiddleOfAnother) {
  const Bytes frame = to_bytes(property(1, 300));
  for (const bool queues_rest : {true, false}) {
    peer.sent.clear();
    link->set_mid_frame(true);
    iovec first = part(frame, 0, 100);
    ASSERT_EQ(link->send_now({&first, 1}), 100u);
    link->send(ping(2));
    run_turns(loop, 3);
    EXPECT_EQ(peer.sent.size(), 100u) << "it waits";
    iovec second = part(frame, 100, 200);
    ASSERT_EQ(link->send_now({&second, 1}), 100u) << "goes on before what waits";
    if (queues_rest) {
      link->queue_rest(RawBytes::copy_of(std::span(frame).subspan(200)));
    } else {
      iovec third = part(frame, 200, frame.size());
      ASSERT_EQ(link->send_now({&third, 1}), frame.size() - 200);
    }
    link->set_mid_frame(false);
    run_turns(loop, 3);
    EXPECT_EQ(serials_sent(), (Serials{1, 2}));
    EXPECT_TRUE(link->output_empty());
  }
}

TEST_F(FrameConnectionTest, ClosesOnAPeerThatRequestsAndDoesNotRead) {
  peer.room = 0;
  int sent = 0;
  for (; link->is_open() && sent < 100; ++sent) link->send(property(1, 1000));
  EXPECT_EQ(sent, 10) << "10,000 bytes may wait, frames have a few bytes more than 1,000";
  EXPECT_TRUE(peer.closed);
  EXPECT_FALSE(closed_with) << "not from within a call of ours";
  run_turns(loop, 2);
  ASSERT_TRUE(closed_with);
  EXPECT_EQ(closed_with->code, Errc::limit_exceeded);
}

TEST_F(FrameConnectionTest, ChargesWhatWaitsToTheBudgetAndGivesItBack) {
  MemoryBudget budget(5000);
  link->set_budget(budget);
  peer.room = 0;
  link->send(property(1, 3000));
  EXPECT_GE(budget.used(), 3000u);
  peer.room = MemoryPeer::kAll;
  run_turns(loop, 2);
  EXPECT_EQ(budget.used(), 0u);
  peer.room = 0;
  link->send(property(2, 3000));
  link->send(property(3, 3000));
  EXPECT_FALSE(link->is_open()) << "the budget is smaller than what may wait otherwise";
  EXPECT_EQ(budget.used(), 0u);
  run_turns(loop, 2);
  ASSERT_TRUE(closed_with);
  EXPECT_NE(closed_with->message.find("max_peer_memory"), std::string::npos)
      << closed_with->message;
}

TEST_F(FrameConnectionTest, ChargesALongFrameWhileItIsReceived) {
  MemoryBudget budget(1 << 20);
  link->set_budget(budget);
  const Bytes frame = to_bytes(property(1, 700'000));
  const auto part_end = frame.begin() + 400'000;
  peer.put({frame.begin(), part_end});
  run_turns(loop, 5);
  EXPECT_GE(budget.used(), 300'000u);
  peer.put({part_end, frame.end()});
  run_turns(loop, 5);
  EXPECT_EQ(received_serials, Serials{1});
  EXPECT_EQ(budget.used(), 0u);

  const Bytes longer = to_bytes(property(2, 3'000'000));
  peer.put(longer);
  run_turns(loop, 20);
  EXPECT_FALSE(link->is_open());
  EXPECT_EQ(budget.used(), 0u);
}

TEST_F(FrameConnectionTest, LetsOthersHaveTheirTurn) {
  Bytes many;
  for (std::uint64_t serial = 1; serial <= 30'000; ++serial) {
    const Bytes one = to_bytes(property(serial, 100));
    many.insert(many.end(), one.begin(), one.end());
  }
  ASSERT_GT(many.size(), 2 * FrameConnection::kBytesPerTurn);
  peer.put(many);
  run_turns(loop, 1);
  EXPECT_GT(received_serials.size(), 0u);
  EXPECT_LT(received_serials.size(), 20'000u) << "all of it in one turn";
  EXPECT_EQ(batches, 1);
  run_turns(loop, 50);
  EXPECT_EQ(received_serials.size(), 30'000u);
}

TEST_F(FrameConnectionTest, HandsNothingOutWhilePaused) {
  handler = [&](net::Frame& frame) -> Result<void> {
    if (frame.serial() == 2) link->pause();
    return {};
  };
  Bytes three;
  for (const std::uint64_t serial : {1U, 2U, 3U}) {
    const Bytes one = to_bytes(ping(serial));
    three.insert(three.end(), one.begin(), one.end());
  }
  peer.put(three);
  peer.put(ping(4));
  run_turns(loop, 5);
  EXPECT_EQ(received_serials, (Serials{1, 2})) << "though 3 was received together with 2";
  EXPECT_EQ(batches, 1);
  link->resume();
  run_turns(loop, 5);
  EXPECT_EQ(received_serials, (Serials{1, 2, 3, 4}));
}

Bytes sample(Tid tid, std::size_t payload_bytes, std::byte content) {
  return sample_bytes({.tid = tid}, Bytes(payload_bytes, content));
}

TEST_F(FrameConnectionTest, RefusesASampleWithoutADelegate) {
  MemoryPeer other;
  FrameConnection one(loop, std::make_unique<MemoryTransport>(other), *this, kMaxQueued);
  other.put(sample(7, kPayloadBytes, std::byte{5}));
  run_turns(loop, 3);
  EXPECT_TRUE(begun.empty());
  ASSERT_TRUE(closed_with);
  EXPECT_EQ(closed_with->code, Errc::protocol);
  EXPECT_NE(closed_with->message.find("none is expected"), std::string::npos)
      << closed_with->message;
}

// A transport that decrypts holds input that the descriptor does not show.
TEST_F(FrameConnectionTest, GoesOnAfterAPauseWithWhatTheTransportHeldAndWhatComesThen) {
  handler = [this](const net::Frame& frame) -> Result<void> {
    if (frame.serial() == 1) link->pause();
    return {};
  };
  peer.put(ping(1));
  peer.hides_input = true;
  for (const std::uint64_t serial : {2U, 3U}) peer.put(ping(serial));
  run_turns(loop, 4);
  EXPECT_EQ(received_serials, Serials{1});
  link->resume();
  run_turns(loop, 4);
  EXPECT_EQ(received_serials, (Serials{1, 2, 3}));
  peer.hides_input = false;
  peer.put(ping(4));
  run_turns(loop, 4);
  EXPECT_EQ(received_serials, (Serials{1, 2, 3, 4}));
}

TEST_F(FrameConnectionTest, BeginsASampleAgainThatCameInAPause) {
  hold_sample = true;
  peer.put(sample(7, kPayloadBytes, std::byte{5}));
  run_turns(loop, 3);
  EXPECT_EQ(begun, std::vector<Tid>{7});
  EXPECT_TRUE(ended.empty());
  hold_sample = false;
  link->resume();
  run_turns(loop, 3);
  EXPECT_EQ(begun, (std::vector<Tid>{7, 7}));
  EXPECT_EQ(ended, std::vector<Tid>{7});
  EXPECT_EQ(payload, Bytes(kPayloadBytes, std::byte{5}));
}

TEST_F(FrameConnectionTest, SendsThePeerTheReasonBeforeItCloses) {
  handler = [](net::Frame&) -> Result<void> { return Error{Errc::protocol, "not like this"}; };
  Bytes two = to_bytes(ping(1));
  const Bytes second = to_bytes(ping(2));
  two.insert(two.end(), second.begin(), second.end());
  peer.put(two);
  run_turns(loop, 3);
  EXPECT_EQ(received_serials, Serials{1}) << "nothing is handed out after an error";
  EXPECT_TRUE(peer.closed);
  const std::vector<net::Frame> items = frames_of(peer.sent);
  ASSERT_EQ(items.size(), 1u);
  EXPECT_EQ(items[0].serial(), 0u);
  EXPECT_EQ(items[0].failure().message(), "not like this");
  ASSERT_TRUE(closed_with);
  EXPECT_EQ(closed_with->message, "not like this");
}

TEST_F(FrameConnectionTest, ReadsThePeersFinalFailureWhenItTakesNothingMore) {
  peer.put(ping(9));
  peer.end_silently();
  link->send(ping(1));
  EXPECT_TRUE(link->is_open()) << "what the peer said is still to be read";
  run_turns(loop, 3);
  EXPECT_EQ(received_serials, Serials{9});
  ASSERT_TRUE(closed_with);
  EXPECT_EQ(closed_with->code, Errc::unavailable);
}

TEST_F(FrameConnectionTest, EndsWithThePeerAlsoInTheMiddleOfAFrame) {
  const Bytes frame = to_bytes(property(1, 100));
  peer.put({frame.begin(), frame.begin() + 50});
  peer.end();
  run_turns(loop, 3);
  ASSERT_TRUE(closed_with);
  EXPECT_NE(closed_with->message.find("middle of a frame"), std::string::npos)
      << closed_with->message;
}

TEST_F(FrameConnectionTest, DoesNothingAfterItClosed) {
  link->close_with({Errc::closed, "enough"});
  peer.sent.clear();
  link->send(ping(1));
  link->pause();
  link->resume();
  link->want_output();
  link->queue_rest(RawBytes(10));
  iovec nothing{};
  EXPECT_EQ(link->send_now({&nothing, 1}), 0u);
  link->close_with({Errc::closed, "again"});
  run_turns(loop, 3);
  EXPECT_TRUE(peer.sent.empty());
  ASSERT_TRUE(closed_with);
  EXPECT_EQ(closed_with->message, "enough");
}

TEST_F(FrameConnectionTest, MayBeDestroyedBeforeItsEndIsReported) {
  link->close_with({Errc::closed, "enough"});
  link.reset();
  run_turns(loop, 3);
  EXPECT_FALSE(closed_with);
}

}  // namespace
}  // namespace dssm::daemon
