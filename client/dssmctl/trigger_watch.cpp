// SPDX-License-Identifier: Apache-2.0
//
// See trigger_watch.hpp. Requests to dssmd, which may take as long as another host does not answer,
// come from the thread of the watch; samples come from the session's thread. Both use the evaluator
// under one lock, and neither calls the session with it.
#include "client/dssmctl/trigger_watch.hpp"

#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>
#include <array>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

using Kind = TriggerRule::Kind;
using Compare = TriggerRule::Compare;

// The longer ones first: "<=" is not "<".
constexpr std::pair<std::string_view, Compare> kComparisons[] = {
    {"<=", Compare::less_or_equal}, {">=", Compare::greater_or_equal},
    {"==", Compare::equal},         {"!=", Compare::not_equal},
    {"<", Compare::less},           {">", Compare::greater},
    {" inside ", Compare::inside},  {" outside ", Compare::outside}};

std::string_view trimmed(std::string_view text) {
  const std::size_t begin = text.find_first_not_of(" \t");
  if (begin == text.npos) return {};
  return text.substr(begin, text.find_last_not_of(" \t") - begin + 1);
}

bool is_about(const std::string& pattern, const StreamId& stream) {
  return !is_of_black_box(stream) && StreamFilter({}, {pattern}).takes(stream);
}

// Printable: it comes into files, whose texts are UTF-8, and into the journal.
template <std::size_t N>
std::string text_untrusted(const char (&text)[N]) {
  return escaped(text_in(text));
}

}  // namespace

// --- rules

Result<TriggerRule> TriggerRule::parse(std::string_view text) {
  TriggerRule rule;
  const auto wrong = [&](const std::string& what) {
    return Error{
        Errc::invalid_argument,
        fmt::format("trigger '{}': {}; it is 'STREAM.FIELD < NUMBER' (or <=, >, >=, ==, "
                    "!=), 'STREAM.FIELD inside LOW..HIGH' (or outside), 'stalled STREAM', "
                    "'crashed STREAM' or 'clock HOST', after 'NAME: ' if it is to have one",
                    escaped(text), what)};
  };
  std::string_view rest = trimmed(text);
  if (const std::size_t colon = rest.find(": "); colon != rest.npos) {
    rule.name = trimmed(rest.substr(0, colon));
    rest = trimmed(rest.substr(colon + 2));
    if (rule.name.empty()) return wrong("its name is empty");
  }
  const auto comparison = std::ranges::find_if(
      kComparisons, [&](const auto& one) { return rest.find(one.first) != rest.npos; });
  if (comparison == std::end(kComparisons)) {
    const std::size_t space = rest.find(' ');
    const std::string_view word = rest.substr(0, space);
    if (space != rest.npos) rule.target = trimmed(rest.substr(space));
    if (word == "stalled") {
      rule.kind = Kind::stalled;
    } else if (word == "crashed") {
      rule.kind = Kind::crashed;
    } else if (word == "clock") {
      rule.kind = Kind::clock;
    } else {
      return wrong("there is no such condition");
    }
    if (rule.target.find(' ') != rule.target.npos) return wrong("it has one word too many");
    if (rule.name.empty()) rule.name = word;
    return rule;
  }
  const std::size_t at = rest.find(comparison->first);
  rule.compare = comparison->second;
  rule.target = trimmed(rest.substr(0, at));
  if (splits_at_dots(rule.target).empty() ||
      rule.target.find_first_of("<>=!") != rule.target.npos) {
    return wrong("STREAM.FIELD is missing");
  }
  if (rule.name.empty()) rule.name = rule.target;
  std::string_view low = trimmed(rest.substr(at + comparison->first.size()));
  std::string_view high = low;
  if (rule.compare == Compare::inside || rule.compare == Compare::outside) {
    const std::size_t dots = low.find("..");
    if (dots == low.npos) return wrong("the range LOW..HIGH is missing");
    high = trimmed(low.substr(dots + 2));
    low = trimmed(low.substr(0, dots));
  }
  const Result<double> from = parse_real(low), to = parse_real(high);
  if (!from) return wrong(from.error().message);
  if (!to) return wrong(to.error().message);
  rule.low = *from;
  rule.high = *to;
  if (rule.low > rule.high) return wrong("the first number of the range is greater");
  return rule;
}

bool TriggerRule::holds_for(double value) const {
  switch (compare) {
    case Compare::less:
      return value < low;
    case Compare::less_or_equal:
      return value <= low;
    case Compare::greater:
      return value > low;
    case Compare::greater_or_equal:
      return value >= low;
    case Compare::equal:
      return value == low;
    case Compare::not_equal:
      return value != low;
    case Compare::inside:
      return value >= low && value <= high;
    case Compare::outside:
      return !(value >= low && value <= high);  // NaN is outside
  }
  return false;
}

// --- what fires

bool TriggerEvaluator::has_rule_on(const StreamId& stream) const {
  return !rules_without(stream, {}).empty();
}

std::vector<std::string> TriggerEvaluator::rules_without(const StreamId& stream,
                                                         const std::vector<Check>& checks) const {
  std::vector<std::string> names;
  for (std::size_t i = 0; i < rules_.size(); ++i) {
    const TriggerRule& rule = rules_[i];
    if (rule.kind != Kind::field || std::ranges::count(checks, i, &Check::rule) > 0) continue;
    const auto is_for_it = [&](const auto& part) {
      const bool is_for_any = part.first.find_first_of("*?[") != part.first.npos;
      return is_about(part.first, stream) && (checks.empty() || !is_for_any);
    };
    if (std::ranges::any_of(splits_at_dots(rule.target), is_for_it)) {
      names.push_back(rule.name);
    }
  }
  return names;
}

std::vector<TriggerEvaluator::Check> TriggerEvaluator::checks_of(
    const StreamId& stream, const std::vector<Field>& fields) const {
  std::vector<Check> checks;
  for (std::size_t rule = 0; rule < rules_.size(); ++rule) {
    if (rules_[rule].kind != Kind::field) continue;
    for (const auto& [pattern, wanted] : splits_at_dots(rules_[rule].target)) {
      if (!is_about(pattern, stream)) continue;
      if (const auto found = find_field(fields, wanted)) {
        checks.push_back({rule, found->field, found->element, false});
      }
    }
  }
  return checks;
}

void TriggerEvaluator::on_sample(const StreamId& stream, const SampleInfo& info,
                                 std::span<const std::byte> payload, std::vector<Check>& checks) {
  for (Check& check : checks) {
    const TriggerRule& rule = rules_[check.rule];
    std::optional<double> found;
    const std::uint64_t first = check.element.value_or(0);
    const std::uint64_t end = check.element ? first + 1 : check.field.count;
    for (std::uint64_t i = first; i < end && !found; ++i) {
      const std::optional<double> value = element_number(payload, check.field, i);
      if (value && rule.holds_for(*value)) found = value;
    }
    if (found && !check.held) {
      fire({rule.name,
            fmt::format("{} of '{}' is {}", escaped(check.field.name), stream.str(), *found),
            stream.host, info.time},
           stream.str());
    }
    check.held = found.has_value();
  }
}

void TriggerEvaluator::on_request(const TriggerRequest& request, Time time) {
  forget_old();
  if (fired_at_.size() >= kMaxRemembered) return;  // names that programs make up
  const std::string name = text_untrusted(request.name), host = text_untrusted(request.host);
  fire({name.empty() ? "request" : name, text_untrusted(request.reason), host, time}, host);
}

void TriggerEvaluator::on_lists(const std::vector<StreamInfo>& streams,
                                const std::vector<HostInfo>& hosts, Time now) {
  std::set<std::string> listed;
  for (const StreamInfo& stream : streams) {
    const std::string name = stream.id.str();
    listed.insert(name);
    const auto [at, is_new] = streams_.try_emplace(name);
    Known& known = at->second;
    // What happened before it was seen is unknown.
    if (is_new || known.incarnation != stream.incarnation) {
      known = {stream.id, stream.incarnation, stream.crashed_writers, stream.crashed_readers,
               false};
    }
    for (const TriggerRule& rule : rules_) check_stream(rule, stream, known, now);
    // Of a host that does not answer just now, the list has an earlier number. (A lower one counts
    // otherwise: its dssmd was restarted.)
    const bool is_earlier = stream.state == StreamState::unknown && stream.newest == kNoTid;
    if (!is_earlier) {
      known.crashed_writers = stream.crashed_writers;
      known.crashed_readers = stream.crashed_readers;
    }
    known.live = stream.state == StreamState::live || (known.live && !is_silent(stream));
  }
  // A host that is lost takes its streams from the list.
  for (auto entry = streams_.begin(); entry != streams_.end();) {
    const std::string& name = entry->first;
    Known& known = entry->second;
    if (listed.contains(name)) {
      ++entry;
      continue;
    }
    const bool is_removed = std::any_of(hosts.begin(), hosts.end(), [&](const HostInfo& host) {
      return host.name == known.id.host && is_up(host.state);
    });
    for (const TriggerRule& rule : rules_) {
      if (is_removed || !known.live || rule.kind != Kind::stalled) continue;
      if (!is_about(rule.target, known.id)) continue;
      fire({rule.name, fmt::format("'{}' is lost: its host does not answer", name), known.id.host,
            now},
           known.id.host);
    }
    known.live = false;
    entry = is_removed ? streams_.erase(entry) : std::next(entry);
  }
  check_clocks(hosts, now);
}

void TriggerEvaluator::check_stream(const TriggerRule& rule, const StreamInfo& stream,
                                    const Known& before, Time now) {
  if (!is_about(rule.target, stream.id)) return;
  if (rule.kind == Kind::stalled && stream.state == StreamState::stalled && before.live) {
    fire({rule.name,
          fmt::format("'{}' is stalled: no sample for {}", stream.id.str(), age_text(stream)),
          stream.id.host, now},
         stream.id.str());
  }
  const auto check_crashed = [&](std::uint32_t crashed, std::uint32_t earlier,
                                 const std::string& last) {
    if (rule.kind != Kind::crashed || crashed <= earlier) return;
    fire({rule.name, fmt::format("{} ended without closing '{}'", last, stream.id.str()),
          stream.id.host, now},
         stream.id.host + ' ' + last);
  };
  check_crashed(stream.crashed_writers, before.crashed_writers, stream.last_crashed_writer);
  check_crashed(stream.crashed_readers, before.crashed_readers, stream.last_crashed_reader);
}

// The clock of a host that was good and is not. One that was not there before is unknown at first.
void TriggerEvaluator::check_clocks(const std::vector<HostInfo>& hosts, Time now) {
  std::map<std::string, bool> good;
  for (const HostInfo& host : hosts) {
    if (!is_up(host.state)) continue;
    const bool is_own = host.state == HostState::self;
    const bool is_good_now =
        is_own ? !host.clock || is_good(*host.clock) : host.clock_reason.empty();
    good[host.name] = is_good_now;
    const auto before = good_clocks_.find(host.name);
    if (is_good_now || before == good_clocks_.end() || !before->second) continue;
    for (const TriggerRule& rule : rules_) {
      if (rule.kind != Kind::clock || ::fnmatch(rule.target.c_str(), host.name.c_str(), 0) != 0) {
        continue;
      }
      fire({rule.name,
            fmt::format("the clock of host '{}' is not good: {}", host.name,
                        is_own ? status_text(*host.clock) : host.clock_reason),
            host.name, now},
           host.name);
    }
  }
  good_clocks_ = std::move(good);
}

void TriggerEvaluator::forget_old() {
  if (fired_at_.size() < kMaxRemembered) return;
  const MonoTime now = MonoClock::now();
  std::erase_if(fired_at_, [&](const auto& entry) { return now - entry.second >= min_interval_; });
}

void TriggerEvaluator::fire(RecordedTrigger trigger, const std::string& subject) {
  forget_old();
  const MonoTime now = MonoClock::now();
  const auto [last, is_new] = fired_at_.try_emplace({trigger.name, subject}, now);
  if (!is_new && now - last->second < min_interval_) return;
  last->second = now;
  fired_.push_back(std::move(trigger));
}

// --- watching

TriggerWatch::TriggerWatch(Session session, std::vector<TriggerRule> rules, Duration min_interval)
    : session_(std::move(session)), evaluator_(std::move(rules), min_interval) {
  thread_ = std::thread([this] { run(); });
}

TriggerWatch::~TriggerWatch() {
  {
    const std::lock_guard lock(mutex_);
    stop_ = true;
  }
  stopped_.notify_one();
  if (thread_.joinable()) thread_.join();
}

std::vector<RecordedTrigger> TriggerWatch::take_fired() {
  const std::lock_guard lock(mutex_);
  return evaluator_.take();
}

std::vector<std::string> TriggerWatch::take_notices() {
  const std::lock_guard lock(mutex_);
  return std::exchange(notices_, {});
}

void TriggerWatch::notice(const std::string& text) {
  const std::lock_guard lock(mutex_);
  if (noticed_.insert(text).second) notices_.push_back(text);
}

void TriggerWatch::run() {
  const auto is_stopped = [&] {
    const std::lock_guard lock(mutex_);
    return stop_;
  };
  while (!is_stopped()) {
    if (!requests_) subscribe_requests();
    check_lists();
    std::unique_lock lock(mutex_);
    stopped_.wait_for(lock, kPeriod, [&] { return stop_; });
  }
  // Before the lock that their callbacks use.
  requests_.reset();
  fields_.clear();
}

void TriggerWatch::subscribe_requests() {
  const auto report = [this](const Error& error) {
    notice(fmt::format("`dssmctl trigger` does not reach this recorder: {}",
                       escaped_message(error.message)));
  };
  // It is only opened for reading then: requests come from others.
  const Result<Writer<TriggerRequest>> created = session_.create<TriggerRequest>(
      kTriggerStream, History{64, kPeriod}, {.keep_existing = true});
  if (!created) return report(created.error());
  // Not by time: a host that sends a request may have a clock that is behind.
  if (!earlier_requests_) {
    earlier_requests_.emplace(created->incarnation(), created->newest_tid());
  }
  SubscribeOptions options;
  options.which = WhichSamples::each_from_oldest;
  options.on_error = report;
  Result<StreamCallback> requests = session_.subscribe<TriggerRequest>(
      created->id().str(),
      [this](const Sample<TriggerRequest>& sample, Reader<TriggerRequest>& reader) {
        const auto [ring, newest] = *earlier_requests_;
        if (reader.incarnation() == ring && sample.tid() <= newest) return;
        const std::lock_guard lock(mutex_);
        evaluator_.on_request(sample.value, sample.time());
      },
      options);
  if (!requests) return report(requests.error());
  requests_ = *std::move(requests);
  request_stream_ = created->id();
}

void TriggerWatch::check_lists() {
  const Result<std::vector<StreamInfo>> streams = session_.list_streams();
  const Result<std::vector<HostInfo>> hosts = session_.list_hosts();
  // While dssmd restarts, nothing is known, and nothing has changed.
  if (!streams || !hosts) return;
  {
    const std::lock_guard lock(mutex_);
    evaluator_.on_lists(*streams, *hosts, WallClock::now());
  }
  subscribe_fields(*streams);
  // `dssmctl rm` removes it, too; then it is created again.
  if (std::ranges::find(*streams, request_stream_, &StreamInfo::id) == streams->end()) {
    requests_.reset();
  }
}

void TriggerWatch::report_rules_without_field(const StreamId& stream,
                                              const std::vector<Field>& fields,
                                              const std::vector<TriggerEvaluator::Check>& checks) {
  const std::vector<std::string> rules = evaluator_.rules_without(stream, checks);
  if (rules.empty()) return;
  constexpr std::size_t kMaxNamed = 20;
  std::vector<std::string> names, quoted;
  names.reserve(fields.size());
  quoted.reserve(rules.size());
  for (const Field& field : fields) names.push_back(escaped(field.name));
  for (const std::string& rule : rules) quoted.push_back(fmt::format("'{}'", escaped(rule)));
  const std::string name = escaped(stream.str());
  notice(fmt::format(
      "no trigger {} on '{}': {}", list_text(quoted), name,
      fields.empty()
          ? fmt::format("it is not described; `dssmctl describe '{}'` gives it fields", name)
          : fmt::format("it has no such field; there are {}", list_text(names, kMaxNamed))));
}

void TriggerWatch::subscribe_fields(const std::vector<StreamInfo>& streams) {
  std::set<std::pair<std::string, std::uint64_t>> listed;
  for (const StreamInfo& stream : streams) {
    if (!evaluator_.has_rule_on(stream.id)) continue;
    const std::pair key(stream.id.str(), stream.incarnation);
    listed.insert(key);
    FieldWatch& watch = fields_[key];
    if (watch.subscription || MonoClock::now() < watch.retry_at) continue;
    TypeInfo type = stream.type;
    if (type.fields.empty()) {  // lists leave out the fields of many types
      const Result<StreamInfo> info = session_.stream_info(stream.id);
      if (!info) continue;
      type = info->type;
    }
    watch.retry_at = deadline_in(kRetryPeriod);
    const std::vector<Field> fields = readable_fields_untrusted(type);
    std::vector<TriggerEvaluator::Check> checks = evaluator_.checks_of(stream.id, fields);
    report_rules_without_field(stream.id, fields, checks);
    if (checks.empty()) continue;
    SubscribeOptions options;
    options.on_error = [this, name = stream.id.str()](const Error& error) {
      notice(fmt::format("no trigger on '{}': {}", escaped(name), escaped_message(error.message)));
    };
    Result<StreamCallback> subscribed = session_.subscribe_raw(
        stream.id,
        [this, checks = std::move(checks)](std::span<const std::byte> payload,
                                           const SampleInfo& info, RawReader& reader) mutable {
          const std::lock_guard lock(mutex_);
          evaluator_.on_sample(reader.id(), info, payload, checks);
        },
        options, &type);
    if (subscribed) {
      watch.subscription = *std::move(subscribed);
    } else {
      options.on_error(subscribed.error());
    }
  }
  std::erase_if(fields_, [&](const auto& entry) { return !listed.contains(entry.first); });
}

}  // namespace dssm::ctl
