// SPDX-License-Identifier: Apache-2.0
//
// dssmctl ls --watch: what is there, then each stream that comes or goes, a line for each, until
// Ctrl-C. dssmd sends events, nothing is polled. While dssmd is unavailable there are none; when it
// is available again, only what has changed meanwhile is shown.
#include "client/dssmctl/ls_watch.hpp"

#include <condition_variable>
#include <mutex>
#include <set>

#include "client/dssmctl/stop_signal.hpp"
#include "client/dssmctl/stream_json.hpp"
#include "client/dssmctl/text.hpp"

namespace dssm::ctl {
namespace {

// Events of the session's thread that this program has not shown yet. It grows only while our
// output is not read, by the streams that are added and removed meanwhile.
class EventQueue {
 public:
  void put(const StreamEvent& event) {
    const std::lock_guard lock(mutex_);
    events_.push_back(event);
    came_.notify_one();
  }

  // All that came; waits for the first one, but not for longer than kStopCheckPeriod.
  std::vector<StreamEvent> take() {
    std::unique_lock lock(mutex_);
    came_.wait_for(lock, kStopCheckPeriod, [this] { return !events_.empty(); });
    return std::exchange(events_, {});
  }

 private:
  std::mutex mutex_;
  std::condition_variable came_;
  std::vector<StreamEvent> events_;
};

// Prints a line for each stream that comes or goes.
class StreamLog {
 public:
  StreamLog(const LsOptions& options, const StreamFilter& filter, Output& out)
      : json_(options.json), filter_(filter), out_(out) {}

  void on_event(const StreamEvent& event) {
    if (!filter_.takes(event.stream.id)) return;
    const std::string name = event.stream.id.str();
    if (event.kind == StreamEvent::Kind::removed) {
      shown_.erase(name);
      return print_removed(event.stream.id);
    }
    // A stream that was recreated while dssmd was unavailable is reported as added only.
    if (!shown_.insert(name).second) print_removed(event.stream.id);
    print_added(event.stream);
  }

 private:
  void print_added(const StreamInfo& stream) {
    if (json_) {
      Json json = {{"event", "added"}};
      json.update(stream_json(stream, WallClock::now()));
      return out_.add(json_line(json));
    }
    out_.add("+ " + escaped(stream.id.str()) + " " + std::to_string(stream.type.payload_bytes) +
             " bytes, depth " + std::to_string(stream.depth) + ", cycle " +
             duration_text(stream.cycle) +
             (stream.type.name.empty() ? "" : ", " + escaped(stream.type.name)) + "\n");
  }

  void print_removed(const StreamId& id) {
    if (!json_) return out_.add("- " + escaped(id.str()) + "\n");
    out_.add(json_line({{"event", "removed"},
                        {"stream", id.str()},
                        {"name", id.name},
                        {"id", id.id},
                        {"host", id.host}}));
  }

  bool json_;
  const StreamFilter& filter_;
  Output& out_;
  std::set<std::string> shown_;  // full names
};

}  // namespace

Result<void> watch_streams(Session& session, const LsOptions& options, const StreamFilter& filter,
                           Output& out) {
  catch_stop_signals();
  const auto queue = std::make_shared<EventQueue>();
  const Result<Session::Watch> watch =
      session.watch([queue](const StreamEvent& event) { queue->put(event); });
  if (!watch) return watch.error();
  StreamLog log(options, filter, out);
  do {
    for (const StreamEvent& event : queue->take()) log.on_event(event);
  } while (out.flush() && !out.reader_ended() && !stop_requested());
  return {};
}

}  // namespace dssm::ctl
