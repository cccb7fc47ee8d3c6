// SPDX-License-Identifier: Apache-2.0
#include "client/src/stream_watches.hpp"

#include <utility>

namespace dssm::detail {
namespace {

local::Request watch_request() {
  local::Request request;
  request.mutable_watch();
  return request;
}

}  // namespace

Result<std::uint64_t> StreamWatches::add(OnEvent on_event) {
  bool is_first = false;
  std::uint64_t key = 0;
  {
    const std::lock_guard guard(mutex_);
    key = next_key_++;
    for (const auto& [name, stream] : known_) {
      on_event(StreamEvent{StreamEvent::Kind::added, stream, false, {}, false});
    }
    watches_[key] = std::move(on_event);
    is_first = !std::exchange(watching_, true);
  }
  if (!is_first) return key;
  if (auto done = connection_.call(watch_request()); !done) {
    const std::lock_guard guard(mutex_);
    watches_.erase(key);
    // Those that were added meanwhile count on this request: on_connected() repeats it for them.
    watching_ = !watches_.empty();
    return std::move(done).error();
  }
  return key;
}

void StreamWatches::remove(std::uint64_t key) {
  const std::lock_guard guard(mutex_);
  watches_.erase(key);
}

std::vector<StreamId> StreamWatches::known_ids() {
  const std::lock_guard guard(mutex_);
  std::vector<StreamId> ids;
  ids.reserve(known_.size());
  for (const auto& [name, stream] : known_) ids.push_back(stream.id);
  return ids;
}

void StreamWatches::on_connected() {
  {
    const std::lock_guard guard(mutex_);
    if (!watching_) return;
    unconfirmed_ = known_;
  }
  repeated_watch_ = connection_.post(watch_request());
}

void StreamWatches::on_message(const local::Response& message) {
  if (message.serial() == 0) {
    if (message.has_stream_event()) on_event(message.stream_event());
  } else if (message.serial() == repeated_watch_) {
    on_list_complete();
  }
}

void StreamWatches::on_event(const proto::StreamEvent& message) {
  StreamEvent event{message.removed() ? StreamEvent::Kind::removed : StreamEvent::Kind::added,
                    wire::stream_info(message.stream()),
                    false,
                    {},
                    false};
  const std::string name = event.stream.id.str();
  const std::lock_guard guard(mutex_);
  unconfirmed_.erase(name);
  if (message.removed()) {
    if (known_.erase(name) == 0) return;
  } else {
    const auto [entry, is_new] = known_.try_emplace(name, event.stream);
    const StreamInfo known = std::exchange(entry->second, event.stream);
    if (!is_new && known.incarnation == event.stream.incarnation) {
      event.property_set =
          message.property_set() || known.property_bytes != event.stream.property_bytes;
      event.described =
          known.type != event.stream.type && !event.stream.type.is_less_described_than(known.type);
      if (!event.property_set && !event.described) return;
      if (message.property_set()) event.property_after = event.stream.newest;
    }
  }
  for (const auto& [key, callback] : watches_) callback(event);
}

// dssmd answers Watch after the events of all existing streams: what was not among them was removed
// while there was no connection.
void StreamWatches::on_list_complete() {
  const std::lock_guard guard(mutex_);
  for (const auto& [name, stream] : std::exchange(unconfirmed_, {})) {
    known_.erase(name);
    StreamEvent event;
    event.kind = StreamEvent::Kind::removed;
    event.stream.id = stream.id;
    for (const auto& [key, callback] : watches_) callback(event);
  }
}

}  // namespace dssm::detail
