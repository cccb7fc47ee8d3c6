// SPDX-License-Identifier: Apache-2.0
//
// A watch has two event sources, since ours wait for one kind of event each. Hang-ups and errors
// are not distinguished from readiness: the next read or write reports the error, and
// libdbus does.
#include "daemon/fleet/mdns/avahi_poll.hpp"

#include <avahi-common/error.h>

#include <algorithm>

// Types that avahi-common only declares: each implementation of AvahiPoll has its own.
struct AvahiWatch {
  dssm::daemon::LoopAvahiPoll* poll = nullptr;
  int fd = -1;
  AvahiWatchCallback callback = nullptr;
  void* userdata = nullptr;
  AvahiWatchEvent happened{};  // while its callback runs
  bool freed = false;
  dssm::daemon::EventSource readable, writable;

  void on_event(AvahiWatchEvent event) {
    if (freed) return;
    happened = event;
    callback(this, fd, event, userdata);
    happened = AvahiWatchEvent{};  // still there, freed or not: the sweeper comes later
  }
};

struct AvahiTimeout {
  dssm::daemon::LoopAvahiPoll* poll = nullptr;
  AvahiTimeoutCallback callback = nullptr;
  void* userdata = nullptr;
  bool freed = false;
  dssm::daemon::EventSource timer;
};

namespace dssm::daemon {
namespace {

constexpr Duration kMaxDelay = std::chrono::minutes(1);

LoopAvahiPoll* poll_of(const AvahiPoll* api) { return static_cast<LoopAvahiPoll*>(api->userdata); }

void set_enabled(EventSource& source, bool wanted) {
  if (wanted) {
    source.enable();
  } else {
    source.disable();
  }
}

void watch_update(AvahiWatch* watch, AvahiWatchEvent events) {
  set_enabled(watch->readable, (events & AVAHI_WATCH_IN) != 0);
  set_enabled(watch->writable, (events & AVAHI_WATCH_OUT) != 0);
}

AvahiWatch* watch_new(const AvahiPoll* api, int fd, AvahiWatchEvent events,
                      AvahiWatchCallback callback, void* userdata) {
  auto* const watch = new AvahiWatch;
  watch->poll = poll_of(api);
  watch->fd = fd;
  watch->callback = callback;
  watch->userdata = userdata;
  const EventLoop& loop = watch->poll->loop();
  watch->readable = EventSource::readable(loop, fd, [watch] { watch->on_event(AVAHI_WATCH_IN); });
  watch->writable = EventSource::writable(loop, fd, [watch] { watch->on_event(AVAHI_WATCH_OUT); });
  watch_update(watch, events);
  return watch;
}

AvahiWatchEvent watch_get_events(AvahiWatch* watch) { return watch->happened; }

void watch_free(AvahiWatch* watch) {
  watch->freed = true;
  watch->readable.disable();
  watch->writable.disable();
  watch->poll->defer_delete(watch);
}

void timeout_update(AvahiTimeout* timeout, const timeval* when) {
  if (when) {
    timeout->timer.enable_in(delay_until(*when, WallClock::now()));
  } else {
    timeout->timer.disable();
  }
}

AvahiTimeout* timeout_new(const AvahiPoll* api, const timeval* when, AvahiTimeoutCallback callback,
                          void* userdata) {
  auto* const timeout = new AvahiTimeout;
  timeout->poll = poll_of(api);
  timeout->callback = callback;
  timeout->userdata = userdata;
  timeout->timer = EventSource::timer(timeout->poll->loop(), [timeout] {
    if (!timeout->freed) timeout->callback(timeout, timeout->userdata);
  });
  timeout_update(timeout, when);
  return timeout;
}

void timeout_free(AvahiTimeout* timeout) {
  timeout->freed = true;
  timeout->timer.disable();
  timeout->poll->defer_delete(timeout);
}

}  // namespace

bool is_avahi_connection_error(int error) noexcept {
  switch (error) {
    case AVAHI_ERR_DISCONNECTED:
    case AVAHI_ERR_NO_DAEMON:
    case AVAHI_ERR_DBUS_ERROR:  // no answer in time, too
    case AVAHI_ERR_TIMEOUT:
    case AVAHI_ERR_VERSION_MISMATCH:
      return true;
    default:
      return false;
  }
}

Duration delay_until(const timeval& when, Time now) noexcept {
  // Far beyond any real time the sum below would overflow.
  constexpr std::int64_t kMaxSeconds = std::int64_t{1} << 33;
  const std::int64_t seconds = std::clamp<std::int64_t>(when.tv_sec, -kMaxSeconds, kMaxSeconds);
  const Duration since_1970 =
      std::chrono::seconds(seconds) +
      std::chrono::microseconds(std::clamp<std::int64_t>(when.tv_usec, 0, 999'999));
  if (since_1970 <= now.time_since_epoch()) return Duration::zero();
  return std::min(since_1970 - now.time_since_epoch(), kMaxDelay);
}

LoopAvahiPoll::LoopAvahiPoll(const EventLoop& loop) : loop_(loop) {
  api_.userdata = this;
  api_.watch_new = watch_new;
  api_.watch_update = watch_update;
  api_.watch_get_events = watch_get_events;
  api_.watch_free = watch_free;
  api_.timeout_new = timeout_new;
  api_.timeout_update = timeout_update;
  api_.timeout_free = timeout_free;
  sweeper_ = EventSource::timer(loop, [this] {
    freed_watches_.clear();
    freed_timeouts_.clear();
  });
}

LoopAvahiPoll::~LoopAvahiPoll() = default;

void LoopAvahiPoll::defer_delete(AvahiWatch* watch) {
  freed_watches_.emplace_back(watch);
  sweeper_.enable_in(Duration::zero());
}

void LoopAvahiPoll::defer_delete(AvahiTimeout* timeout) {
  freed_timeouts_.emplace_back(timeout);
  sweeper_.enable_in(Duration::zero());
}

}  // namespace dssm::daemon
