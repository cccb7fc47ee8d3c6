// SPDX-License-Identifier: Apache-2.0
//
// dssmd's side: passes on what is to be announced, and reports what has changed of what was found.
#include "daemon/fleet/mdns/mdns.hpp"

#include <signal.h>

#include <thread>
#include <utility>

#include "core/base/quiet_thread.hpp"
#include "core/base/try.hpp"
#include "daemon/fleet/mdns/mdns_worker.hpp"

namespace dssm::daemon {
namespace {

// How long a hung Avahi daemon may delay dssmd's end.
constexpr Duration kEndTimeout = std::chrono::milliseconds(900);

}  // namespace

Mdns::Mdns(const EventLoop& loop, const Options& options, HostFinderObserver& observer,
           Logger& logger)
    : observer_(observer), logger_(logger) {
  state_.phase = MdnsPhase::waiting;
  if (const Result<void> started = start(loop, options); !started) {
    state_.error = started.error().message;
    logger.error("mDNS is not available, only configured peers are found: " +
                 started.error().message);
  }
}

Result<void> Mdns::start(const EventLoop& main_loop, const Options& options) {
  const std::string what = "start the thread for mDNS";
  mailbox_ = DSSM_TRY(MdnsMailbox::open(), what);
  EventLoop thread_loop = DSSM_TRY(EventLoop::open(), what);
  updates_ = EventSource::readable(main_loop, mailbox_->updates_fd(), [this] { on_update(); });
  updates_.enable();
  // The thread has nothing of ours but the mailbox, which it owns as well: see ~Mdns().
  thread_ = DSSM_TRY(
      quiet_thread("mDNS", [box = mailbox_, loop = std::move(thread_loop), options]() mutable {
        {
          MdnsWorker worker(loop, options, *box);
          worker.run();
        }
        box->done();
      }));
  return {};
}

// A thread that waits for an answer by D-Bus can neither be woken nor ended. It is detached then:
// it finds the request to stop in the mailbox as soon as D-Bus gives up, and everything that it
// uses until then is its own.
Mdns::~Mdns() {
  if (!thread_.joinable()) return;
  mailbox_->stop();
  if (mailbox_->wait_until_done(kEndTimeout)) {
    thread_.join();
  } else {
    thread_.detach();
  }
}

void Mdns::announce(std::vector<ServiceRecord> records) {
  if (mailbox_) mailbox_->want(std::move(records));
}

void Mdns::on_update() {
  MdnsMailbox::Update update = mailbox_->take_update();
  for (const auto& [level, text] : update.lines) logger_.write(level, text, {});
  if (update.hosts) {
    const FoundHosts before = std::exchange(reported_, *std::move(update.hosts));
    for (const auto& [id, host] : before) {
      if (!reported_.contains(id)) observer_.on_host_lost(id);
    }
    for (const auto& [id, host] : reported_) {
      const auto known = before.find(id);
      if (known == before.end() || known->second != host) observer_.on_host_found(host);
    }
  }
  if (update.state && *update.state != state_) {
    state_ = *std::move(update.state);
    observer_.on_mdns_state(state_);
  }
}

}  // namespace dssm::daemon
