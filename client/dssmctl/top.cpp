// SPDX-License-Identifier: Apache-2.0
//
// dssmctl top: streams, hosts and programs of the vehicle, redrawn each second. On a terminal a
// thread of its own asks dssmd, which may wait for other hosts, so that keys are followed at once;
// what is drawn is TopDisplay's. Elsewhere the rows of one view, or all as JSON, again and again.
#include <fmt/format.h>
#include <signal.h>

#include <condition_variable>
#include <mutex>
#include <thread>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/nodes.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/screen.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/top_display.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// What a state has besides hosts and streams.
struct TopRequest {
  bool programs = false;
  std::optional<StreamId> details;
  friend bool operator==(const TopRequest&, const TopRequest&) = default;
};

Result<TopState> read_state(Session& session, const TopRequest& request) {
  TopState state;
  state.hosts = DSSM_TRY(session.list_hosts());
  state.streams = DSSM_TRY(session.list_streams());
  if (request.programs) state.programs = DSSM_TRY(session.list_nodes());
  if (request.details) {
    // One that was removed meanwhile is not an error.
    if (Result<StreamInfo> details = session.stream_info(*request.details)) {
      state.details = std::move(*details);
    }
  }
  state.time = WallClock::now();
  return state;
}

// --- on a terminal

// Reads a state each `period`, and when the request changes.
class StateReader {
 public:
  StateReader(Session session, Duration period, TopRequest request)
      : session_(std::move(session)), period_(period), request_(std::move(request)) {
    // The signals are for the thread that waits for keys.
    sigset_t all, before;
    ::sigfillset(&all);
    ::pthread_sigmask(SIG_SETMASK, &all, &before);
    thread_ = std::thread([this] { run(); });
    ::pthread_sigmask(SIG_SETMASK, &before, nullptr);
  }
  StateReader(const StateReader&) = delete;
  StateReader& operator=(const StateReader&) = delete;
  ~StateReader() {
    {
      const std::lock_guard lock(mutex_);
      is_to_stop_ = true;
      changed_.notify_one();
    }
    thread_.join();
  }

  // What the next states are to have; held: none until that changes.
  void request(TopRequest request, bool is_held) {
    const std::lock_guard lock(mutex_);
    if (request == request_ && is_held == is_held_) return;
    request_ = std::move(request);
    is_held_ = is_held;
    is_asked_ = true;
    changed_.notify_one();
  }

  // A state now, and not after the period.
  void ask() {
    const std::lock_guard lock(mutex_);
    is_asked_ = true;
    changed_.notify_one();
  }

  // The newest state that was not taken yet.
  std::optional<TopState> take() {
    const std::lock_guard lock(mutex_);
    return std::exchange(state_, std::nullopt);
  }

 private:
  void run() {
    std::unique_lock lock(mutex_);
    MonoTime next = deadline_in(period_);
    while (!is_to_stop_) {
      const Duration rest = is_held_ ? kHeldPeriod : next - MonoClock::now();
      const bool is_asked =
          changed_.wait_for(lock, rest, [this] { return is_to_stop_ || is_asked_; });
      if (is_to_stop_) return;
      if (!is_asked && is_held_) continue;
      is_asked_ = false;
      // dssmd is unavailable: a request would only wait until it answers again.
      if (!session_.is_connected()) {
        next = deadline_in(period_);
        continue;
      }
      const TopRequest request = request_;
      lock.unlock();
      Result<TopState> state = read_state(session_, request);
      next = deadline_in(period_);
      if (!state) {
        TopState failed;
        failed.error = state.error().message;
        state = std::move(failed);
      }
      lock.lock();
      state_ = std::move(*state);
    }
  }

  static constexpr Duration kHeldPeriod = std::chrono::hours(1);

  Session session_;
  const Duration period_;
  std::mutex mutex_;
  std::condition_variable changed_;
  TopRequest request_;
  bool is_held_ = false, is_asked_ = false, is_to_stop_ = false;
  std::optional<TopState> state_;
  std::thread thread_;
};

Result<void> show_on_terminal(const Session& session, TopState state, const TopOptions& options,
                              Output& out) {
  TopDisplay display(options);
  display.set_state(std::move(state));
  const auto wanted = [&] {
    return TopRequest{display.wants_programs(), display.wanted_details()};
  };
  StateReader reader(session, options.interval, wanted());
  Screen screen(out);  // the terminal is restored before the reader ends, which may have to wait
  constexpr Key kDrawAgain{'L' - '@'};  // Ctrl-L
  bool was_connected = true, is_changed = true;
  ScreenSize drawn_size;
  for (std::uint64_t updates = 1; !out.must_stop();) {
    if (auto newer = reader.take()) {
      display.set_state(std::move(*newer));
      is_changed = true;
      if (!display.is_held()) ++updates;
    }
    const bool is_connected = session.is_connected();
    if (std::exchange(was_connected, is_connected) != is_connected) {
      display.set_connected(is_connected);
      is_changed = true;
      if (is_connected) reader.ask();
    }
    const ScreenSize size = Screen::size();
    if (is_changed || size != drawn_size || screen.is_blank()) {
      if (!screen.draw(display.lines(size), size)) return {};
      is_changed = false;
      drawn_size = size;
    }
    if (options.count && updates >= *options.count) return {};
    if (const auto key = screen.wait(deadline_in(kStopCheckPeriod))) {
      if (!display.on_key(*key)) return {};
      if (*key == kDrawAgain) screen.clear();
      reader.request(wanted(), display.is_held());
      is_changed = true;
    }
  }
  return {};
}

// --- elsewhere

void print_rows(const TopState& state, bool is_connected, const TopOptions& options, Output& out) {
  const TopOrder order{options.pattern, options.sort, options.reverse};
  out.add(headline(state, is_connected, options.iso, out.columns()) + "\n");
  if (!is_connected) return;
  switch (options.view) {
    case TopView::streams:
      return stream_table(shown_streams(state, order), out.columns()).print(out);
    case TopView::hosts:
      return host_table(shown_hosts(state, order)).print(out);
    case TopView::programs:
      return print_nodes(shown_programs(state, order), out);
  }
}

// The pattern and the order are those of one view; of the others all is shown.
void print_json(const TopState& state, bool is_connected, const TopOptions& options, Output& out) {
  const auto order = [&](TopView view) {
    return view == options.view ? TopOrder{options.pattern, options.sort, options.reverse}
                                : TopOrder{};
  };
  Json json = {{"time_ns", to_ns(WallClock::now())}, {"error", or_null(state.error)}};
  Json hosts, streams, programs;  // null while they are not known
  if (is_connected) {
    hosts = streams = programs = Json::array();
    for (const HostInfo& host : shown_hosts(state, order(TopView::hosts))) {
      hosts.push_back(host_json(host));
    }
    const StreamListing listing = shown_streams(state, order(TopView::streams));
    for (const StreamInfo& stream : listing.streams) {
      streams.push_back(listed_stream_json(listing, stream));
    }
    for (const NodeInfo& program : shown_programs(state, order(TopView::programs))) {
      programs.push_back(node_json(program));
    }
  }
  json["hosts"] = std::move(hosts);
  json["streams"] = std::move(streams);
  json["programs"] = std::move(programs);
  out.add(json_line(json));
}

Result<void> print_again_and_again(Session session, TopState state, const TopOptions& options,
                                   const TopRequest& request, Output& out) {
  MonoTime next = MonoClock::now();
  for (std::uint64_t updates = 1;; ++updates) {
    const bool is_connected = state.error.empty();
    if (options.json) {
      print_json(state, is_connected, options, out);
    } else {
      if (updates > 1) out.add("\n");
      print_rows(state, is_connected, options, out);
    }
    if (!out.flush() || (options.count && updates >= *options.count)) return {};
    // After a pause of this program not for each period that it missed.
    next = std::max(next + options.interval, MonoClock::now());
    if (!out.sleep_until(next)) return {};
    Result<TopState> newer =
        session.is_connected()
            ? read_state(session, request)
            : Result<TopState>(Error{Errc::unavailable, "dssmd is not available"});
    if (newer) {
      state = std::move(*newer);
    } else {
      state.error = newer.error().message;
    }
  }
}

}  // namespace

Result<void> run(const TopOptions& options, Output& out) {
  const bool is_drawn = out.terminal() && !options.json;
  Session session = DSSM_TRY(connect(options));
  const TopRequest request{options.json || options.view == TopView::programs, std::nullopt};
  TopState state = DSSM_TRY(read_state(session, request));
  catch_stop_signals();
  if (is_drawn) return show_on_terminal(session, std::move(state), options, out);
  return print_again_and_again(std::move(session), std::move(state), options, request, out);
}

}  // namespace dssm::ctl
