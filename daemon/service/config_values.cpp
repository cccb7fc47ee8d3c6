// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/config_values.hpp"

#include <fmt/format.h>
#include <fnmatch.h>
#include <grp.h>
#include <net/if.h>
#include <pwd.h>
#include <sys/types.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <charconv>
#include <string>
#include <vector>

#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "daemon/service/config.hpp"

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxInterfacePatternBytes = 63;

constexpr Duration kMinClockLimit = std::chrono::microseconds(10);
constexpr Duration kMaxClockLimit = std::chrono::seconds(10);
constexpr std::size_t kMaxStreamPatternBytes = 63;
constexpr std::uint64_t kMaxDriftPpm = 1000;
constexpr std::uint64_t kMaxMirrorHz = 100'000;
constexpr Duration kMinMirrorHistory = std::chrono::milliseconds(1);
constexpr Duration kMaxMirrorHistory = std::chrono::hours(24);

Error invalid(std::string why) { return Error{Errc::invalid_argument, std::move(why)}; }

// a * b, or the greatest number there is: out of every range.
std::uint64_t product(std::uint64_t a, std::uint64_t b) noexcept {
  std::uint64_t result = 0;
  return __builtin_mul_overflow(a, b, &result) ? UINT64_MAX : result;
}

// A whole number and what follows it, without the blanks between them.
struct Quantity {
  std::uint64_t number = 0;
  std::string_view unit;
};

Result<Quantity> parse_quantity(std::string_view text) {
  Quantity quantity;
  const char* end = text.data() + text.size();
  const auto [rest, error] = std::from_chars(text.data(), end, quantity.number);
  if (error == std::errc::result_out_of_range) return invalid(in_quotes(text) + " is too large");
  if (error != std::errc()) return invalid(in_quotes(text) + " does not begin with a whole number");
  quantity.unit = std::string_view(rest, static_cast<std::size_t>(end - rest));
  while (quantity.unit.starts_with(' ')) quantity.unit.remove_prefix(1);
  return quantity;
}

Error out_of_range(std::string_view text, std::uint64_t min, std::uint64_t max,
                   std::string_view unit) {
  return invalid(fmt::format("{} is outside of {} to {}{}", in_quotes(text), min, max, unit));
}

// By wire::Priority.
constexpr std::array<std::string_view, 3> kPriorityNames = {"high", "normal", "low"};

template <class Exception>
const Exception* first_for(const StreamId& id, const std::vector<Exception>& exceptions) {
  const auto found =
      std::find_if(exceptions.begin(), exceptions.end(),
                   [&](const Exception& exception) { return names_stream(exception.pattern, id); });
  return found != exceptions.end() ? &*found : nullptr;
}

// One of those of a stream: "at_once", "10 Hz", "2 s".
Result<void> take_demand(std::string_view text, MirrorDemands::Exception& out) {
  if (const Result<bool> history = parse_mirror_history(text)) {
    out.history_at_once = *history;
    return {};
  }
  const Result<Quantity> quantity = parse_quantity(text);
  if (!quantity) {
    return invalid(in_quotes(text) + " is neither when_read nor at_once, nor a rate or a time");
  }
  if (quantity->unit != "Hz") {
    out.max_history = DSSM_TRY(parse_duration(text, kMinMirrorHistory, kMaxMirrorHistory));
    return {};
  }
  if (quantity->number < 1 || quantity->number > kMaxMirrorHz) {
    return out_of_range(text, 1, kMaxMirrorHz, " Hz");
  }
  out.max_rate_hz = static_cast<double>(quantity->number);
  return {};
}

// The pattern for streams before the last '='; returns what is wrong with it, or "".
std::string take_pattern(std::string_view text, std::string& out) {
  const std::size_t equals = text.rfind('=');
  if (equals == text.npos) return "has no '='";
  out = text.substr(0, equals);
  if (out.empty()) return "names no stream";
  if (out.size() > kMaxStreamPatternBytes) return "names a stream too long to be one";
  if (out.find('\0') != std::string::npos) return "holds a zero byte";
  return {};
}

}  // namespace

bool names_stream(const std::string& pattern, const StreamId& id) {
  const std::string full = fmt::format("{}:{}", id.name, id.id);
  return !::fnmatch(pattern.c_str(), id.name.c_str(), 0) ||
         !::fnmatch(pattern.c_str(), full.c_str(), 0);
}

ClockDemand ClockPolicies::demand_for(const StreamId& id) const {
  const Exception* found = first_for(id, exceptions);
  if (!found) return general;
  return {found->policy, found->limit == Duration::zero() ? general.limit : found->limit};
}

MirrorDemand MirrorDemands::demand_for(const StreamId& id) const {
  const Exception* found = first_for(id, exceptions);
  if (!found) return general;
  return {found->history_at_once.value_or(general.history_at_once), found->max_rate_hz,
          found->max_history};
}

SendingDemand SendingDemands::demand_for(const StreamId& id, std::uint64_t payload_bytes) const {
  if (const Exception* found = first_for(id, exceptions)) return found->demand;
  return {payload_bytes < kSmallBytes ? wire::Priority::high : wire::Priority::normal};
}

Result<std::uint64_t> parse_count(std::string_view text, std::uint64_t min, std::uint64_t max) {
  const Quantity quantity = DSSM_TRY(parse_quantity(text));
  if (!quantity.unit.empty()) return invalid(in_quotes(text) + " is not a whole number");
  if (quantity.number < min || quantity.number > max) {
    return out_of_range(text, min, max, "");
  }
  return quantity.number;
}

Result<std::uint64_t> parse_bytes(std::string_view text, std::uint64_t min, std::uint64_t max) {
  const Quantity quantity = DSSM_TRY(parse_quantity(text));
  std::uint64_t bytes = quantity.number;
  if (quantity.unit == "%") {
    if (quantity.number > 100) return invalid(in_quotes(text) + " is more than the whole memory");
    bytes = memory_of_the_machine() / 100 * quantity.number;
  } else if (quantity.unit == "KiB") {
    bytes = product(bytes, 1ULL << 10);
  } else if (quantity.unit == "MiB") {
    bytes = product(bytes, 1ULL << 20);
  } else if (quantity.unit == "GiB") {
    bytes = product(bytes, 1ULL << 30);
  } else if (quantity.unit == "TiB") {
    bytes = product(bytes, 1ULL << 40);
  } else if (!quantity.unit.empty()) {
    return invalid(in_quotes(text) + " has an unknown unit; write bytes, KiB, MiB, GiB, TiB or %");
  }
  if (bytes < min || bytes > max) return out_of_range(text, min, max, " bytes");
  return bytes;
}

Result<Duration> parse_duration(std::string_view text, Duration min, Duration max) {
  const Quantity quantity = DSSM_TRY(parse_quantity(text));
  std::uint64_t ns = quantity.number;
  if (quantity.unit == "us") {
    ns = product(ns, 1'000);
  } else if (quantity.unit == "ms") {
    ns = product(ns, 1'000'000);
  } else if (quantity.unit == "s") {
    ns = product(ns, 1'000'000'000);
  } else {
    return invalid(in_quotes(text) + " needs a unit: 'us', 'ms' or 's'");
  }
  if (ns < static_cast<std::uint64_t>(to_ns(min)) || ns > static_cast<std::uint64_t>(to_ns(max))) {
    const bool fine = min % std::chrono::milliseconds(1) != Duration::zero();
    const std::int64_t unit = fine ? 1'000 : 1'000'000;
    return out_of_range(text, static_cast<std::uint64_t>(to_ns(min) / unit),
                        static_cast<std::uint64_t>(to_ns(max) / unit), fine ? " us" : " ms");
  }
  return Duration(static_cast<std::int64_t>(ns));
}

Result<bool> parse_mirror_history(std::string_view text) {
  if (text == "at_once" || text == "when_read") return text == "at_once";
  return invalid(in_quotes(text) + " is neither \"when_read\" nor \"at_once\"");
}

Result<ClockPolicy> parse_clock_policy(std::string_view text) {
  for (const ClockPolicy policy : {ClockPolicy::enforce, ClockPolicy::mark, ClockPolicy::off}) {
    if (text == name_of(policy)) return policy;
  }
  return Error{Errc::invalid_argument,
               in_quotes(text) + " is not a policy; it is \"enforce\", \"mark\" or \"off\""};
}

Result<Duration> parse_clock_limit(std::string_view text) {
  return parse_duration(text, kMinClockLimit, kMaxClockLimit);
}

Result<ClockPolicies::Exception> parse_clock_exception(std::string_view text) {
  const auto wrong = [&](const std::string& why) {
    return Error{Errc::invalid_argument,
                 fmt::format("{} {}; write \"STREAM=POLICY\" or \"STREAM=POLICY LIMIT\", such as "
                             "\"gps=off\" or \"camera*=mark 5 ms\"",
                             in_quotes(text), why)};
  };
  ClockPolicies::Exception exception;
  const std::string why = take_pattern(text, exception.pattern);
  if (!why.empty()) return wrong(why);
  const std::string_view demand = text.substr(exception.pattern.size() + 1);
  const std::size_t blank = std::min(demand.find(' '), demand.size());
  const Result<ClockPolicy> policy = parse_clock_policy(demand.substr(0, blank));
  if (!policy) return wrong("has a policy that is none: " + policy.error().message);
  exception.policy = *policy;
  if (blank == demand.size()) return exception;
  const Result<Duration> limit = parse_clock_limit(demand.substr(blank + 1));
  if (!limit) return wrong("has a limit that is none: " + limit.error().message);
  exception.limit = *limit;
  return exception;
}

Result<MirrorDemands::Exception> parse_mirror_exception(std::string_view text) {
  const auto wrong = [&](const std::string& why) {
    return Error{
        Errc::invalid_argument,
        fmt::format("{} {}; write \"STREAM=WHAT\" or \"STREAM=WHAT, WHAT\", such as "
                    "\"map=at_once\", \"camera*=10 Hz\" or \"camera*=when_read, 10 Hz, 2 s\"",
                    in_quotes(text), why)};
  };
  MirrorDemands::Exception exception;
  const std::string why = take_pattern(text, exception.pattern);
  if (!why.empty()) return wrong(why);
  std::string_view rest = text.substr(exception.pattern.size() + 1);
  for (bool is_last = false; !is_last;) {
    const std::size_t comma = rest.find(',');
    is_last = comma == rest.npos;
    std::string_view what = rest.substr(0, comma);
    if (!is_last) rest.remove_prefix(comma + 1);
    while (what.starts_with(' ')) what.remove_prefix(1);
    const Result<void> taken = take_demand(what, exception);
    if (!taken) return wrong("is wrong: " + taken.error().message);
  }
  return exception;
}

Result<SendingDemands::Exception> parse_sending_exception(std::string_view text) {
  const auto wrong = [&](const std::string& why) {
    return Error{Errc::invalid_argument,
                 fmt::format("{} {}; write \"STREAM=PRIORITY\" or \"STREAM=PRIORITY SHARE\", such "
                             "as \"encoder*=high\" or \"camera*=low 30%\"",
                             in_quotes(text), why)};
  };
  SendingDemands::Exception exception;
  const std::string why = take_pattern(text, exception.pattern);
  if (!why.empty()) return wrong(why);
  const std::string_view demand = text.substr(exception.pattern.size() + 1);
  const std::size_t blank = std::min(demand.find(' '), demand.size());
  const std::string_view name = demand.substr(0, blank);
  const auto priority = std::find(kPriorityNames.begin(), kPriorityNames.end(), name);
  if (priority == kPriorityNames.end()) {
    return wrong("has a priority that is none: " + in_quotes(name) +
                 " is neither high, normal nor low");
  }
  exception.demand.priority =
      static_cast<wire::Priority>(std::distance(kPriorityNames.begin(), priority));
  if (blank == demand.size()) return exception;
  const std::string_view text_of_share = demand.substr(blank + 1);
  const Result<std::uint64_t> share = parse_percent(text_of_share);
  if (!share) return wrong("has a share that is none: " + share.error().message);
  exception.demand.history_percent = static_cast<int>(*share);
  return exception;
}

Result<std::uint64_t> parse_percent(std::string_view text) {
  const Result<Quantity> share = parse_quantity(text);
  if (share && share->unit == "%" && share->number >= 1 && share->number <= 100) {
    return share->number;
  }
  return invalid(in_quotes(text) + " is not 1% to 100%");
}

Result<clock::PartsPerBillion> parse_drift(std::string_view text) {
  const Quantity quantity = DSSM_TRY(parse_quantity(text));
  if (quantity.unit != "ppm") return invalid(in_quotes(text) + " needs the unit 'ppm'");
  if (quantity.number < 1 || quantity.number > kMaxDriftPpm) {
    return out_of_range(text, 1, kMaxDriftPpm, " ppm");
  }
  return static_cast<clock::PartsPerBillion>(quantity.number) * 1000;
}

Result<mode_t> parse_mode(std::string_view text) {
  unsigned mode = 0;
  const char* end = text.data() + text.size();
  const auto [rest, error] = std::from_chars(text.data(), end, mode, 8);
  if (error != std::errc() || rest != end || mode > 0777) {
    return invalid(in_quotes(text) + " are not permissions; write them in octal, e.g. \"0660\"");
  }
  if (!(mode & 0200)) {
    return invalid(in_quotes(text) +
                   " would lock out even dssmd's own user; connecting takes write permission, "
                   "e.g. \"0660\"");
  }
  return mode;
}

namespace {

// The entry of `name` by getgrnam_r() or getpwnam_r(), in `space`; nullptr: there is none.
template <class Entry>
Result<const Entry*> find_entry(std::string_view what, std::string_view name, Entry& entry,
                                std::vector<char>& space,
                                int (*find)(const char*, Entry*, char*, std::size_t, Entry**)) {
  const std::string wanted(name);
  space.resize(16384);  // enough for one entry without the members of a group
  for (;;) {
    Entry* found = nullptr;
    const int failed = find(wanted.c_str(), &entry, space.data(), space.size(), &found);
    if (failed == ERANGE && space.size() < (16U << 20)) {
      space.resize(space.size() * 2);
      continue;
    }
    if (failed) return os_error(fmt::format("find the {} {}", what, in_quotes(name)), failed);
    return found;
  }
}

}  // namespace

Result<gid_t> parse_group(std::string_view name) {
  group entry{};
  std::vector<char> space;
  if (DSSM_TRY(find_entry("group", name, entry, space, &::getgrnam_r))) return entry.gr_gid;
  return invalid(fmt::format("there is no group {}; create it with `groupadd --system {}`",
                             in_quotes(name), printable(name)));
}

Result<uid_t> parse_user(std::string_view name) {
  passwd entry{};
  std::vector<char> space;
  if (DSSM_TRY(find_entry("user", name, entry, space, &::getpwnam_r))) return entry.pw_uid;
  return invalid(fmt::format("there is no user {}", in_quotes(name)));
}

Result<bool> parse_boolean(std::string_view text) {
  if (text == "true") return true;
  if (text == "false") return false;
  return invalid(in_quotes(text) + " is neither true nor false");
}

Result<std::string> parse_interface(std::string_view text) {
  const bool is_pattern = text.find_first_of("*?[\\") != text.npos;
  const std::size_t max = is_pattern ? kMaxInterfacePatternBytes : IFNAMSIZ - 1;
  if (text.empty() || text.size() > max) {
    return invalid(
        fmt::format("{} is {} bytes long; {} takes 1 to {}", in_quotes(text), text.size(),
                    (is_pattern ? "a pattern" : "the name of a network interface"), max));
  }
  for (const char c : text) {
    if (static_cast<unsigned char>(c) <= 0x20 || c == 0x7f || c == '/') {
      return invalid(in_quotes(text) +
                     " holds a blank, a control character or '/', which no network interface has "
                     "in its name; `ip link` lists those of this PC");
    }
  }
  return std::string(text);
}

Result<LogLevel> parse_log_level(std::string_view text) {
  if (text == "error") return LogLevel::error;
  if (text == "warning") return LogLevel::warning;
  if (text == "notice") return LogLevel::notice;
  if (text == "info") return LogLevel::info;
  if (text == "debug") return LogLevel::debug;
  return invalid(in_quotes(text) + " is not a level; write error, warning, notice, info or debug");
}

std::uint64_t memory_of_the_machine() noexcept {
  const long pages = ::sysconf(_SC_PHYS_PAGES), page_bytes = ::sysconf(_SC_PAGESIZE);
  if (pages <= 0 || page_bytes <= 0) return 0;
  return static_cast<std::uint64_t>(pages) * static_cast<std::uint64_t>(page_bytes);
}

}  // namespace dssm::daemon
