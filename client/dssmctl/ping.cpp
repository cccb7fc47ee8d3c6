// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ping: sends a heartbeat to the dssmd of another host, over the connection that this PC's
// dssmd keeps to it, in the manner of ping(8). The time is from dssmd to dssmd: how long a
// request of one to the other takes.
#include <fmt/format.h>

#include <algorithm>
#include <cmath>
#include <future>
#include <optional>
#include <thread>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/statistics.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// For the summary; of more answers the newest ones.
constexpr std::size_t kKeptAnswers = 1'000'000;

class Ping {
 public:
  Ping(const PingOptions& options, Output& out)
      : host_(options.host), json_(options.json), out_(out) {}

  void on_answer(const RoundTrip& answer) {
    ++asked_;
    ++answered_;
    times_.add(answer.round_trip);
    const std::string address = answer.address.empty() ? "this PC" : answer.address;
    if (json_) {
      return out_.add(json_line({{"host", host_},
                                 {"seq", asked_},
                                 {"address", answer.address.empty() ? Json() : Json(address)},
                                 {"round_trip_ns", to_ns(answer.round_trip)}}));
    }
    out_.add(fmt::format("answer from {} ({}): seq={} time={}\n", escaped(host_), escaped(address),
                         asked_, duration_text(answer.round_trip)));
  }

  // A stop signal came before the answer.
  void on_stop() { ++asked_; }

  void on_no_answer(const Error& error) {
    ++asked_;
    if (json_) {
      return out_.add(json_line(
          {{"host", host_}, {"seq", asked_}, {"round_trip_ns", Json()}, {"error", error.message}}));
    }
    out_.add(fmt::format("no answer: seq={}: {}\n", asked_, escaped_message(error.message)));
  }

  void summary() {
    const Statistics times = times_.statistics();
    if (json_) {
      const auto known = [&](auto value) { return times.count > 0 ? Json(value) : Json(); };
      return out_.add(json_line({{"host", host_},
                                 {"asked", asked_},
                                 {"answered", answered_},
                                 {"round_trip_min_ns", known(to_ns(times.min))},
                                 {"round_trip_mean_ns", known(times.mean_ns)},
                                 {"round_trip_max_ns", known(to_ns(times.max))},
                                 {"round_trip_std_dev_ns", known(times.std_dev_ns)}}));
    }
    out_.add(fmt::format("--- {}: asked {}, answered {} ---\n", escaped(host_), asked_, answered_));
    if (times.count == 0) return;
    out_.add(fmt::format("round trip min/avg/max/mdev: {} / {} / {} / {}\n",
                         duration_text(times.min), ns_text(times.mean_ns), duration_text(times.max),
                         ns_text(times.std_dev_ns)));
  }

  std::uint64_t asked() const { return asked_; }
  std::uint64_t answered() const { return answered_; }

 private:
  const std::string& host_;
  bool json_;
  Output& out_;
  std::uint64_t asked_ = 0, answered_ = 0;
  Window times_{kKeptAnswers};
};

// Whether dssmd knows a host of that name, even if it does not answer.
bool is_known(Session& session, const std::string& name) {
  const Result<std::vector<HostInfo>> hosts = session.list_hosts();
  return hosts && std::any_of(hosts->begin(), hosts->end(),
                              [&](const HostInfo& host) { return host.name == name; });
}

// Asks in a thread of its own, because it takes seconds until a host counts as not answering, and
// Ctrl-C must not wait for that: nothing then.
std::optional<Result<RoundTrip>> ask(const Session& session, const std::string& host, Output& out) {
  std::packaged_task<Result<RoundTrip>()> question(
      [asked = session, host]() mutable { return asked.ping(host); });
  std::future<Result<RoundTrip>> answer = question.get_future();
  std::thread(std::move(question)).detach();
  while (answer.wait_for(kStopCheckPeriod) != std::future_status::ready) {
    if (out.must_stop()) return std::nullopt;
  }
  return answer.get();
}

}  // namespace

Result<void> run(const PingOptions& options, Output& out) {
  catch_stop_signals();
  Session session = DSSM_TRY(connect(options));
  Ping ping(options, out);
  MonoTime due = MonoClock::now();
  do {
    const std::optional<Result<RoundTrip>> answer = ask(session, options.host, out);
    if (!answer) {
      ping.on_stop();
      break;
    }
    if (*answer) {
      ping.on_answer(**answer);
    } else if (ping.asked() == 0 && !is_known(session, options.host)) {
      return answer->error();
    } else {
      ping.on_no_answer(answer->error());
    }
    due = std::max(due + options.interval, MonoClock::now());
  } while (out.flush() && ping.asked() != options.count && out.sleep_until(due));
  ping.summary();
  if (ping.answered() > 0) return {};
  return Error{Errc::unavailable,
               fmt::format("host '{}' did not answer; see `dssmctl hosts`", options.host)};
}

}  // namespace dssm::ctl
