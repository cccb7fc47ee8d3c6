// SPDX-License-Identifier: Apache-2.0
//
// What a black box waits for: conditions as people write them, and when they fire.
#include "client/dssmctl/trigger_watch.hpp"

#include <gtest/gtest.h>

#include <limits>

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;
using Kind = TriggerRule::Kind;
using Compare = TriggerRule::Compare;

TriggerRule rule(const std::string& text) { return TriggerRule::parse(text).value(); }

TEST(TriggerRule, ReadsConditionsWithAndWithoutANameAndBlanks) {
  const TriggerRule low = rule(" low battery:  battery:1@pc2.volts<-2.5e1 ");
  EXPECT_EQ(low.name, "low battery");
  EXPECT_EQ(low.kind, Kind::field);
  EXPECT_EQ(low.target, "battery:1@pc2.volts");
  EXPECT_EQ(low.compare, Compare::less);
  EXPECT_EQ(low.low, -25);
  EXPECT_EQ(rule("a.b > 1").name, "a.b");
  const TriggerRule range = rule("a.b outside -1 .. 2.5");
  EXPECT_EQ(range.compare, Compare::outside);
  EXPECT_EQ(range.low, -1);
  EXPECT_EQ(range.high, 2.5);
  EXPECT_EQ(rule("stalled").target, "*");
  EXPECT_EQ(rule("stalled lidar*").target, "lidar*");
  EXPECT_EQ(rule("x: crashed a").kind, Kind::crashed);
  EXPECT_EQ(rule("clock pc[12]").kind, Kind::clock);
  EXPECT_EQ(rule("clock").name, "clock");
}

TEST(TriggerRule, RefusesWhatItDoesNotUnderstandWithTheForms) {
  for (const char* text :
       {"", "a.b", "a.b =< 1", "a > 1", ".b > 1", "a. > 1", "a.b > x", "a.b > nan", "a.b inside 1",
        "a.b inside 2..1", "stalled a b", "moves a", ": stalled", "a.b > 1 2"}) {
    const Result<TriggerRule> parsed = TriggerRule::parse(text);
    ASSERT_FALSE(parsed) << text;
    EXPECT_EQ(parsed.error().code, Errc::invalid_argument);
    EXPECT_NE(parsed.error().message.find("'stalled STREAM'"), std::string::npos) << text;
  }
}

TEST(TriggerRule, ComparesAtTheLimits) {
  const double nan = std::numeric_limits<double>::quiet_NaN();
  struct {
    const char* text;
    std::vector<double> holds, does_not;
  } const cases[] = {
      {"a.b < 2", {1.9}, {2, 2.1, nan}},
      {"a.b <= 2", {1.9, 2}, {2.1, nan}},
      {"a.b > 2", {2.1}, {2, 1.9, nan}},
      {"a.b >= 2", {2, 2.1}, {1.9, nan}},
      {"a.b == 2", {2}, {1.9, 2.1, nan}},
      {"a.b != 2", {1.9, 2.1, nan}, {2}},
      {"a.b inside 1..2", {1, 1.5, 2}, {0.9, 2.1, nan}},
      {"a.b outside 1..2", {0.9, 2.1, nan}, {1, 1.5, 2}},
  };
  for (const auto& one : cases) {
    for (const double value : one.holds) EXPECT_TRUE(rule(one.text).holds_for(value)) << one.text;
    for (const double value : one.does_not) {
      EXPECT_FALSE(rule(one.text).holds_for(value)) << one.text << " " << value;
    }
  }
}

// --- fields

struct Wheel {
  double speed;
  std::int32_t ticks[3];
};
DSSM_DESCRIBE(Wheel, speed, ticks)

const StreamId kWheel{"wheel.left", 1, "pc2"};

class Fields {
 public:
  explicit Fields(std::vector<TriggerRule> rules, Duration min_interval = Duration::zero())
      : evaluator_(std::move(rules), min_interval),
        checks_(evaluator_.checks_of(kWheel, type_of<Wheel>().fields)) {}
  std::vector<RecordedTrigger> write(const Wheel& wheel) {
    evaluator_.on_sample(kWheel, {0, time_from_ns(++time_ns_), Duration(), sizeof wheel},
                         std::as_bytes(std::span(&wheel, 1)), checks_);
    return evaluator_.take();
  }
  std::size_t checks() const { return checks_.size(); }

 private:
  TriggerEvaluator evaluator_;
  std::vector<TriggerEvaluator::Check> checks_;
  std::int64_t time_ns_ = 0;
};

TEST(TriggerEvaluator, FiresWhenAFieldGoesOverItsLimitAndNotWhileItStays) {
  Fields fields({rule("fast: wheel.left.speed > 3.5")});
  ASSERT_EQ(fields.checks(), 1U);
  EXPECT_TRUE(fields.write({3.5, {}}).empty());
  const std::vector<RecordedTrigger> fired = fields.write({3.75, {}});
  ASSERT_EQ(fired.size(), 1U);
  EXPECT_EQ(fired[0], (RecordedTrigger{"fast", "speed of 'wheel.left:1@pc2' is 3.75", "pc2",
                                       time_from_ns(2)}));
  EXPECT_TRUE(fields.write({4, {}}).empty());
  EXPECT_TRUE(fields.write({3, {}}).empty());
  EXPECT_EQ(fields.write({4, {}}).size(), 1U);
}

TEST(TriggerEvaluator, DoesNotFireAgainWithinTheMinimumInterval) {
  Fields fields({rule("fast: wheel*.speed > 1"), rule("other: wheel*.speed > 1")}, 1h);
  EXPECT_EQ(fields.write({2, {}}).size(), 2U) << "each trigger has its own";
  EXPECT_TRUE(fields.write({0, {}}).empty());
  EXPECT_TRUE(fields.write({2, {}}).empty());
}

TEST(TriggerEvaluator, ChecksAllElementsOfAnArrayOrTheNamedOne) {
  EXPECT_EQ(Fields({rule("wheel.left.ticks == 7")}).write({0, {1, 2, 7}}).size(), 1U);
  EXPECT_EQ(Fields({rule("wheel.left.ticks[1] == 7")}).write({0, {7, 2, 7}}).size(), 0U);
  EXPECT_EQ(Fields({rule("wheel.left.ticks[1] == 7")}).write({0, {0, 7, 0}}).size(), 1U);
  EXPECT_EQ(Fields({rule("wheel.left.ticks[3] == 0")}).checks(), 0U);
}

TEST(TriggerEvaluator, FindsTheFieldBehindAnyDotOfTheName) {
  for (const char* text :
       {"wheel.left:1.speed > 1", "wheel*.speed > 1", "wheel.left@pc2.speed > 1"}) {
    EXPECT_EQ(Fields({rule(text)}).checks(), 1U) << text;
  }
  for (const char* text : {"wheel.speed > 1", "wheel.left@pc1.speed > 1", "wheel.left.spee > 1"}) {
    EXPECT_EQ(Fields({rule(text)}).checks(), 0U) << text;
  }
}

// --- lists

StreamInfo stream(const std::string& name, StreamState state, std::uint32_t crashed = 0,
                  std::uint64_t incarnation = 1, const std::string& host = "pc1") {
  StreamInfo info;
  info.id = {name, 0, host};
  info.state = state;
  info.incarnation = incarnation;
  info.crashed_writers = crashed;
  info.last_crashed_writer = "driver (pid 12)";
  return info;
}

HostInfo host(const std::string& name, HostState state, const std::string& clock_reason = "") {
  HostInfo info;
  info.name = name;
  info.state = state;
  info.clock_reason = clock_reason;
  return info;
}

class Lists {
 public:
  explicit Lists(const std::string& text, Duration min_interval = Duration::zero())
      : evaluator_({rule(text)}, min_interval) {}
  std::vector<RecordedTrigger> show(const std::vector<StreamInfo>& streams,
                                    const std::vector<HostInfo>& hosts = {
                                        host("pc1", HostState::self)}) {
    evaluator_.on_lists(streams, hosts, time_from_ns(5));
    return evaluator_.take();
  }

 private:
  TriggerEvaluator evaluator_;
};

TEST(TriggerEvaluator, FiresWhenALiveStreamStalls) {
  Lists lists("stalled a");
  EXPECT_TRUE(lists.show({stream("a", StreamState::stalled)}).empty()) << "since when is unknown";
  EXPECT_TRUE(lists.show({stream("a", StreamState::live), stream("b", StreamState::live)}).empty());
  EXPECT_TRUE(
      lists.show({stream("a", StreamState::live), stream("b", StreamState::stalled)}).empty());
  const auto fired = lists.show({stream("a", StreamState::stalled)});
  ASSERT_EQ(fired.size(), 1U);
  EXPECT_EQ(fired[0].time, time_from_ns(5));
  EXPECT_EQ(fired[0].host, "pc1");
  EXPECT_TRUE(lists.show({stream("a", StreamState::stalled)}).empty());
  EXPECT_TRUE(lists.show({stream("a", StreamState::live)}).empty());
  EXPECT_TRUE(lists.show({stream("a", StreamState::no_writer)}).empty()) << "its program ended";
  EXPECT_TRUE(lists.show({stream("a", StreamState::live)}).empty());
  EXPECT_TRUE(lists.show({stream("a", StreamState::unknown)}).empty());
  EXPECT_EQ(lists.show({stream("a", StreamState::stalled)}).size(), 1U);
}

TEST(TriggerEvaluator, FiresWhenALiveStreamLeavesWithItsHostButNotWhenItIsRemoved) {
  const auto there = [](HostState state) {
    return std::vector{host("pc1", HostState::self), host("pc2", state)};
  };
  Lists lists("stalled");
  lists.show({stream("a", StreamState::live, 0, 1, "pc2")}, there(HostState::up));
  EXPECT_TRUE(lists.show({}, there(HostState::up)).empty());
  lists.show({stream("a", StreamState::live, 0, 1, "pc2")}, there(HostState::up));
  EXPECT_EQ(lists.show({}, there(HostState::down)).size(), 1U);
  EXPECT_TRUE(lists.show({}, there(HostState::down)).empty());
}

TEST(TriggerEvaluator, FiresForEachWriterThatCrashesAndNotForThoseOfBefore) {
  Lists lists("crashed a*");
  EXPECT_TRUE(lists.show({stream("a", StreamState::live, 3)}).empty());
  const auto fired =
      lists.show({stream("a", StreamState::live, 4), stream("b", StreamState::live)});
  ASSERT_EQ(fired.size(), 1U);
  EXPECT_EQ(fired[0].reason, "driver (pid 12) ended without closing 'a:0@pc1'");
  EXPECT_TRUE(
      lists.show({stream("a", StreamState::live, 4), stream("b", StreamState::live, 1)}).empty());
  EXPECT_TRUE(lists.show({stream("a", StreamState::unknown, 2)}).empty()) << "no answer in time";
  EXPECT_TRUE(lists.show({stream("a", StreamState::live, 4)}).empty());
  EXPECT_TRUE(lists.show({stream("a", StreamState::live, 0)}).empty()) << "dssmd was restarted";
  EXPECT_EQ(lists.show({stream("a", StreamState::live, 1)}).size(), 1U);
  EXPECT_TRUE(lists.show({stream("a", StreamState::live, 2, 2)}).empty()) << "another ring";
}

TEST(TriggerEvaluator, FiresForEachReaderThatCrashes) {
  Lists lists("crashed a");
  StreamInfo a = stream("a", StreamState::live);
  a.crashed_readers = 3;
  a.last_crashed_reader = "localizer (pid 34)";
  EXPECT_TRUE(lists.show({a}).empty());
  ++a.crashed_readers;
  const auto fired = lists.show({a});
  ASSERT_EQ(fired.size(), 1U);
  EXPECT_EQ(fired[0].reason, "localizer (pid 34) ended without closing 'a:0@pc1'");
  EXPECT_TRUE(lists.show({a}).empty());
}

TEST(TriggerEvaluator, HasAMinimumIntervalForEachProgramByItself) {
  Lists lists("crashed", 1h);
  StreamInfo a = stream("a", StreamState::live), b = stream("b", StreamState::live);
  lists.show({a, b});
  ++a.crashed_writers;
  EXPECT_EQ(lists.show({a, b}).size(), 1U);
  ++b.crashed_readers;
  b.last_crashed_reader = "localizer (pid 34)";
  EXPECT_EQ(lists.show({a, b}).size(), 1U) << "of another program";
  ++a.crashed_writers;
  EXPECT_TRUE(lists.show({a, b}).empty());
}

TEST(TriggerEvaluator, RemembersTheCrashesOfAHostThatWasAway) {
  Lists lists("crashed");
  const std::vector away{host("pc2", HostState::down)}, here{host("pc2", HostState::up)};
  lists.show({stream("a", StreamState::live, 3, 1, "pc2")}, here);
  lists.show({}, away);
  EXPECT_TRUE(lists.show({stream("a", StreamState::live, 3, 1, "pc2")}, here).empty());
  lists.show({}, away);
  EXPECT_EQ(lists.show({stream("a", StreamState::live, 4, 1, "pc2")}, here).size(), 1U);
}

TEST(TriggerEvaluator, FiresWhenAGoodClockGetsBad) {
  Lists lists("clock pc*");
  const auto with = [](HostState state, const std::string& reason) {
    return std::vector{host("pc1", HostState::self), host("pc2", state, reason),
                       host("other", state, reason)};
  };
  EXPECT_TRUE(lists.show({}, with(HostState::up, "not known yet")).empty());
  EXPECT_TRUE(lists.show({}, with(HostState::up, "")).empty());
  const auto fired = lists.show({}, with(HostState::up, "it may be 3 ms apart"));
  ASSERT_EQ(fired.size(), 1U);
  EXPECT_EQ(fired[0].reason, "the clock of host 'pc2' is not good: it may be 3 ms apart");
  EXPECT_TRUE(lists.show({}, with(HostState::up, "it may be 4 ms apart")).empty());
  lists.show({}, with(HostState::up, ""));
  lists.show({}, with(HostState::down, ""));
  EXPECT_TRUE(lists.show({}, with(HostState::up, "not known yet")).empty()) << "it just connected";
}

TEST(TriggerEvaluator, FiresForTheClockOfThisPc) {
  Lists lists("clock");
  HostInfo own = host("pc1", HostState::self);
  own.clock = ClockSnapshot{};
  own.clock->status = ClockStatus::synchronized;
  EXPECT_TRUE(lists.show({}, {own}).empty());
  own.clock->status = ClockStatus::holdover;
  EXPECT_TRUE(lists.show({}, {own}).empty());
  own.clock->status = ClockStatus::out_of_bounds;
  EXPECT_EQ(lists.show({}, {own}).size(), 1U);
}

TEST(TriggerEvaluator, TakesTextsOfRequestsUpToTheirEnds) {
  TriggerEvaluator evaluator({}, Duration::zero());
  TriggerRequest request{};
  std::fill(std::begin(request.name), std::end(request.name), 'n');
  std::fill(std::begin(request.reason), std::end(request.reason), 'r');
  evaluator.on_request(request, time_from_ns(7));
  evaluator.on_request(TriggerRequest{"a\n\xff", "", ""}, time_from_ns(8));
  evaluator.on_request(TriggerRequest{}, time_from_ns(9));
  const std::vector<RecordedTrigger> fired = evaluator.take();
  ASSERT_EQ(fired.size(), 3U);
  EXPECT_EQ(fired[0].name, std::string(sizeof request.name, 'n'));
  EXPECT_EQ(fired[0].reason, std::string(sizeof request.reason, 'r'));
  EXPECT_EQ(fired[0].time, time_from_ns(7));
  EXPECT_EQ(fired[1].name, "a\\n\\xff");
  EXPECT_EQ(fired[2].name, "request");
}

TEST(TriggerEvaluator, DoesNotRememberNamesWithoutALimit) {
  TriggerEvaluator evaluator({}, 1h);
  std::size_t fired = 0;
  for (int i = 0; i < 3000; ++i) {
    TriggerRequest request{};
    std::to_string(i).copy(request.name, sizeof request.name - 1);
    evaluator.on_request(request, time_from_ns(7));
    fired += evaluator.take().size();
  }
  EXPECT_EQ(fired, 1024U);
}

}  // namespace
}  // namespace dssm::ctl
