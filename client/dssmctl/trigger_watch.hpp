// SPDX-License-Identifier: Apache-2.0
//
// What a black box waits for: conditions on streams and hosts, and requests of `dssmctl trigger`.
//
//   TriggerRule   a condition as a person writes it
//   TriggerEvaluator  decides from samples and lists what fires; without a session, for tests
//   TriggerWatch  feeds an evaluator: lists streams and hosts each second, and reads each sample of
//                 the streams on whose fields there is a condition
//
// A trigger fires when its condition begins to hold, for each stream, program or host by itself,
// and not again for the same one within the minimum interval, so that a value at its limit does not
// fill the disk.
#pragma once

#include <condition_variable>
#include <cstdint>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <map>
#include <mutex>
#include <optional>
#include <set>
#include <span>
#include <string>
#include <string_view>
#include <thread>
#include <tuple>
#include <utility>
#include <vector>

#include "client/dssmctl/black_box_streams.hpp"

namespace dssm::ctl {

struct TriggerRule {
  enum class Kind : unsigned char { field, stalled, crashed, clock };
  enum class Compare : unsigned char {
    less,
    less_or_equal,
    greater,
    greater_or_equal,
    equal,
    not_equal,
    inside,
    outside
  };

  std::string name;  // of the trigger
  Kind kind = Kind::field;
  std::string target = "*";  // pattern of streams, or of hosts; of a field: STREAM.FIELD
  // Of a field: inside and outside of low .. high, or compared with low.
  Compare compare = Compare::less;
  double low = 0, high = 0;

  // Reads "[NAME: ]CONDITION", where the condition is one of
  //   STREAM.FIELD < NUMBER (also <= > >= == !=), STREAM.FIELD inside LOW..HIGH (also outside),
  //   stalled [STREAM], crashed [STREAM], clock [HOST]
  // STREAM and HOST are shell patterns. Without a name, it is the first word of the condition.
  //   fails  invalid_argument
  static Result<TriggerRule> parse(std::string_view text);

  bool holds_for(double value) const;
};

// One thread at a time.
class TriggerEvaluator {
 public:
  TriggerEvaluator(std::vector<TriggerRule> rules, Duration min_interval)
      : rules_(std::move(rules)), min_interval_(min_interval) {}

  // A field of a stream on which there is a condition.
  struct Check {
    std::size_t rule = 0;
    Field field;
    std::optional<std::uint64_t> element;  // empty: any of them
    bool held = false;                     // for the last sample
  };
  // Those of a stream; without `fields` its type is not described.
  std::vector<Check> checks_of(const StreamId& stream, const std::vector<Field>& fields) const;
  bool has_rule_on(const StreamId& stream) const;  // on a field, if it has that
  // The names of rules that are about the stream and that none of its `checks` is for. Those for
  // any stream (with a wildcard) only if there are no checks at all.
  std::vector<std::string> rules_without(const StreamId& stream,
                                         const std::vector<Check>& checks) const;

  void on_sample(const StreamId& stream, const SampleInfo& info, std::span<const std::byte> payload,
                 std::vector<Check>& checks);
  // `streams` and `hosts` as Session lists them.
  void on_lists(const std::vector<StreamInfo>& streams, const std::vector<HostInfo>& hosts,
                Time now);
  void on_request(const TriggerRequest& request, Time time);

  // What fired since the last call.
  std::vector<RecordedTrigger> take() { return std::exchange(fired_, {}); }

 private:
  //   subject  the stream, host or program that it is about
  void fire(RecordedTrigger trigger, const std::string& subject);
  // Those after which the minimum interval has passed, when there are many.
  void forget_old();
  // What the last lists had of a stream.
  struct Known {
    StreamId id;
    std::uint64_t incarnation = 0;
    std::uint32_t crashed_writers = 0, crashed_readers = 0;
    bool live = false;  // it had samples, and was not reported as stalled
  };
  void check_stream(const TriggerRule& rule, const StreamInfo& stream, const Known& before,
                    Time now);
  void check_clocks(const std::vector<HostInfo>& hosts, Time now);

  // Further requests are ignored while so many triggers are within their minimum interval.
  static constexpr std::size_t kMaxRemembered = 1024;

  std::vector<TriggerRule> rules_;
  Duration min_interval_;
  std::vector<RecordedTrigger> fired_;
  // By the trigger's name and what it was about.
  std::map<std::pair<std::string, std::string>, MonoTime> fired_at_;
  std::map<std::string, Known> streams_;     // by name with host
  std::map<std::string, bool> good_clocks_;  // of hosts that were up
};

class TriggerWatch {
 public:
  // Begins. Creates kTriggerStream on this host.
  TriggerWatch(Session session, std::vector<TriggerRule> rules, Duration min_interval);
  TriggerWatch(const TriggerWatch&) = delete;
  TriggerWatch& operator=(const TriggerWatch&) = delete;
  ~TriggerWatch();

  std::vector<RecordedTrigger> take_fired();
  // What does not work, for people; each only once.
  std::vector<std::string> take_notices();

 private:
  void run();
  void subscribe_requests();
  void check_lists();
  void report_rules_without_field(const StreamId& stream, const std::vector<Field>& fields,
                                  const std::vector<TriggerEvaluator::Check>& checks);
  void subscribe_fields(const std::vector<StreamInfo>& streams);
  void notice(const std::string& text);

  static constexpr Duration kPeriod = std::chrono::seconds(1);
  static constexpr Duration kRetryPeriod = std::chrono::seconds(5);

  Session session_;

  std::mutex mutex_;
  std::condition_variable stopped_;
  bool stop_ = false;
  TriggerEvaluator evaluator_;
  std::vector<std::string> notices_;
  std::set<std::string> noticed_;

  // --- of the thread
  std::optional<StreamCallback> requests_;
  StreamId request_stream_;
  // Incarnation of that stream and its newest request when this began: for a recorder before it.
  std::optional<std::pair<std::uint64_t, Tid>> earlier_requests_;
  // Of a stream that may have fields with conditions. One that has none may be described later.
  struct FieldWatch {
    std::optional<StreamCallback> subscription;
    MonoTime retry_at{};
  };
  std::map<std::pair<std::string, std::uint64_t>, FieldWatch> fields_;  // by name and incarnation
  std::thread thread_;
};

}  // namespace dssm::ctl
