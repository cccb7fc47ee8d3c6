// SPDX-License-Identifier: Apache-2.0
//
// The client of chronyd against a scripted one on a socket: which requests it sends, when, and what
// it does with late, foreign, wrong and missing replies.
#include "daemon/clock/chronyd_client.hpp"

#include <event2/event.h>

#include <set>

#include "tests/unit/daemon/clock/fake_chronyd.hpp"
#include "tests/unit/daemon/run_loop.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

constexpr Duration kPeriod = 200ms;

class ChronydClientTest : public testing::Test, protected ChronydClient::Observer {
 protected:
  using Request = FakeChronyd::Request;
  struct Answer {
    TrackingReply reply;
    MonoTime asked;
    clock::Instant answered;
  };

  EventLoop loop = EventLoop::open(TimerQueue::Time::simulated).value();
  // What happens with each question; every test says so.
  std::function<void(const Request&)> on_request;
  std::vector<Request> requests;
  FakeChronyd chronyd{loop, [this](const Request& request) {
                        requests.push_back(request);
                        on_request(request);
                      }};
  std::vector<Answer> answers;
  std::vector<std::string> unanswered;
  int absent = 0;
  std::unique_ptr<ChronydClient> client;

  void on_answer(const TrackingReply& reply, MonoTime asked,
                 const clock::Instant& answered) override {
    answers.push_back({reply, asked, answered});
  }
  void on_no_chronyd() override { ++absent; }
  void on_no_answer(const Error& error) override { unanswered.push_back(error.message); }

  void start() { start(chronyd.address()); }
  void start(const wire::SocketAddress& address) {
    ChronydClient::Observer& observer = *this;
    client = std::make_unique<ChronydClient>(
        loop, address, observer,
        [this] {
          return clock::Instant{loop.now(), {}, {}};
        },
        kPeriod);
  }
  void reply(const Request& request) { chronyd.answer(request, real_reply()); }
  void until(const std::function<bool()>& done) { run_until(loop, done); }
};

TEST_F(ChronydClientTest, SendsRequestsWithDifferentNumbers) {
  on_request = [this](const Request& request) { reply(request); };
  const MonoTime begin = loop.now();
  start();
  until([&] { return answers.size() == 3; });
  EXPECT_GE(loop.now() - begin, 2 * kPeriod);
  std::set<std::uint32_t> numbers;
  for (const Request& request : requests) {
    EXPECT_EQ(request.bytes.size(), kTrackingBytes);
    numbers.insert(request.sequence());
  }
  EXPECT_EQ(numbers.size(), 3u);
  EXPECT_TRUE(unanswered.empty());
  EXPECT_EQ(absent, 0);
  MonoTime last = begin;
  for (const Answer& answer : answers) {
    EXPECT_EQ(answer.reply.tracking.reference_id, 0x7f000001u);
    EXPECT_GE(answer.asked, last);
    EXPECT_GE(answer.answered.mono, answer.asked);
    last = answer.answered.mono;
  }
}

TEST_F(ChronydClientTest, SendsRequestsWhenTheProcessIsAwakeAnyway) {
  on_request = [this](const Request& request) { reply(request); };
  start();
  until([&] { return answers.size() == 1; });
  struct Occasion {
    MonoTime begin, end;
  };
  std::vector<Occasion> occasions;
  EventSource heartbeat = EventSource::timer(loop, [&] {
    const MonoTime begin = loop.now();
    for (int i = 0; i < 10; ++i) client->poll_if_due();
    occasions.push_back({begin, loop.now()});
    heartbeat.enable_in(kPeriod);
  });
  heartbeat.enable_in(kPeriod * 9 / 10);
  until([&] { return answers.size() == 6; });
  ASSERT_EQ(occasions.size(), 5u) << "each was one to ask at, once";
  for (std::size_t i = 0; i < occasions.size(); ++i) {
    EXPECT_GE(answers[i + 1].asked, occasions[i].begin);
    EXPECT_LE(answers[i + 1].asked, occasions[i].end);
  }
  heartbeat.disable();
  until([&] { return answers.size() == 7; });  // by itself again
}

// A heartbeat between two questions is none to ask at; from some later one on each is.
TEST_F(ChronydClientTest, AdaptsToHeartbeats) {
  on_request = [this](const Request& request) { reply(request); };
  MonoTime begin, end;  // of the last heartbeat
  EventSource heartbeat = EventSource::timer(loop, [&] {
    begin = loop.now();
    client->poll_if_due();
    end = loop.now();
    heartbeat.enable_in(kPeriod);
  });
  start();
  heartbeat.enable_in(kPeriod / 2);
  std::size_t seen = 0;
  int in_turn = 0;
  until([&] {
    for (; seen < answers.size(); ++seen) {
      const MonoTime asked = answers[seen].asked;
      in_turn = asked >= begin && asked <= end ? in_turn + 1 : 0;
    }
    return in_turn == 4;
  });
}

TEST_F(ChronydClientTest, NoticesAtOnceThatNoProcessListens) {
  chronyd.stop();
  const MonoTime begin = loop.now();
  start();
  until([&] { return absent == 1; });
  EXPECT_LT(loop.now() - begin, kPeriod) << "with the first question";
  until([&] { return absent == 2; });
  on_request = [this](const Request& request) { reply(request); };
  chronyd.start();
  until([&] { return answers.size() == 1; });
  chronyd.stop();
  const int before = absent;
  until([&] { return absent > before; });
  EXPECT_TRUE(unanswered.empty());
}

TEST_F(ChronydClientTest, DoesNotWaitForAChronydThatDoesNotAnswer) {
  on_request = [](const Request&) {};
  start();
  until([&] { return unanswered.size() == 2; });
  EXPECT_NE(unanswered[0].find("does not answer"), std::string::npos) << unanswered[0];
  on_request = [this](const Request& request) { reply(request); };
  until([&] { return answers.size() == 1; });
  EXPECT_EQ(absent, 0);
}

TEST_F(ChronydClientTest, IgnoresLateAnswers) {
  on_request = [this](const Request&) {
    if (requests.size() == 1) return;
    // The first one's comes with the second question, to where either came from.
    reply(requests[0]);
    Datagram late = real_reply();
    put_number(late, kReplySequence, requests[0].sequence());
    chronyd.send(requests.back(), late);
  };
  start();
  until([&] { return unanswered.size() == 2; });
  EXPECT_TRUE(answers.empty());
  EXPECT_NE(unanswered[1].find("does not answer our question"), std::string::npos) << unanswered[1];
}

TEST_F(ChronydClientTest, FindsTheAnswerAfterGarbage) {
  on_request = [this](const Request& request) {
    chronyd.send(request, {});
    chronyd.send(request, Datagram(3, std::byte{0xff}));
    chronyd.send(request, Datagram(2000, std::byte{6}));
    Datagram other = real_reply();
    put_number(other, kReplySequence, request.sequence() + 1);
    chronyd.send(request, other);
    Datagram damaged = real_reply();
    damaged.pop_back();
    chronyd.answer(request, damaged);
    reply(request);
    reply(request);
  };
  start();
  until([&] { return answers.size() == 2; });
  EXPECT_EQ(requests.size(), 2u) << "one answer for each question";
  EXPECT_TRUE(unanswered.empty());
}

TEST_F(ChronydClientTest, ReadsALimitedNumberOfDatagrams) {
  on_request = [this](const Request& request) {
    for (int i = 0; i < ChronydClient::kMaxDatagrams; ++i) chronyd.send(request, {});
    reply(request);
  };
  start();
  until([&] { return unanswered.size() == 1; });
  EXPECT_TRUE(answers.empty());
  // And it is as good as new then.
  on_request = [this](const Request& request) {
    for (int i = 1; i < ChronydClient::kMaxDatagrams; ++i) chronyd.send(request, {});
    reply(request);
  };
  until([&] { return answers.size() == 1; });
}

TEST_F(ChronydClientTest, ReportsWhyItWasRefused) {
  on_request = [this](const Request& request) {
    Datagram refusal = real_reply();
    refusal.resize(28);
    put_number(refusal, kReplyStatus, std::uint16_t{6});
    chronyd.answer(request, refusal);
  };
  start();
  until([&] { return unanswered.size() == 1; });
  EXPECT_NE(unanswered[0].find("not enabled"), std::string::npos) << unanswered[0];
}

TEST_F(ChronydClientTest, RetriesWithoutARoute) {
  // Linux lets no socket send to everybody that has not asked for it.
  const auto nowhere = wire::Address::parse("255.255.255.255:323").value();
  start(wire::resolve_number(nowhere).at(0));
  until([&] { return unanswered.size() == 2; });
  EXPECT_NE(unanswered[0].find("ask chronyd"), std::string::npos) << unanswered[0];
  EXPECT_TRUE(answers.empty());
}

}  // namespace
}  // namespace dssm::daemon
