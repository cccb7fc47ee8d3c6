// SPDX-License-Identifier: Apache-2.0
//
// dssmd's side: passes on what is to be announced, and tells what has changed among what was found.
#include "daemon/fleet/mdns/mdns.hpp"

#include <signal.h>

#include <thread>
#include <utility>

#include "core/base/quiet_thread.hpp"
#include "core/base/try.hpp"
#include "daemon/base/rate_limited_logger.hpp"
#include "daemon/fleet/mdns/mdns_mailbox.hpp"
#include "daemon/fleet/mdns/mdns_worker.hpp"

namespace dssm::daemon {
namespace {

// How long a hung Avahi daemon may delay dssmd's end.
constexpr Duration kPatienceAtEnd = std::chrono::milliseconds(900);

}  // namespace

struct Mdns::Impl {
  Impl(HostFinderObserver& observer_, Logger& logger) : observer(observer_), calm(logger) {}

  Result<void> start(const EventLoop& main_loop, const Options& options);
  void on_news();

  HostFinderObserver& observer;
  RateLimitedLogger calm;  // others decide how often there is something to say
  MdnsInfo state;
  FoundHosts told;
  std::shared_ptr<MdnsMailbox> mailbox;
  std::thread thread;
  EventSource news;
};

Mdns::Mdns(const EventLoop& loop, Options options, HostFinderObserver& observer, Logger& logger)
    : impl_(std::make_unique<Impl>(observer, logger)) {
  impl_->state.phase = MdnsPhase::waiting;
  if (const Result<void> started = impl_->start(loop, options); !started) {
    impl_->state.error = started.error().message;
    logger.error("mDNS is not to be had, only configured peers are found: " +
                 started.error().message);
  }
}

Result<void> Mdns::Impl::start(const EventLoop& main_loop, const Options& options) {
  Result<std::shared_ptr<MdnsMailbox>> made = MdnsMailbox::open();
  if (!made) return std::move(made).error().context("start the thread for mDNS");
  Result<EventLoop> opened = EventLoop::open();
  if (!opened) return std::move(opened).error().context("start the thread for mDNS");
  mailbox = *std::move(made);
  news = EventSource::readable(main_loop, mailbox->news_fd(), [this] { on_news(); });
  news.enable();
  // The thread has nothing of ours but the mailbox, which it owns as well: see ~Mdns().
  thread =
      DSSM_TRY(quiet_thread("mDNS", [box = mailbox, loop = *std::move(opened), options]() mutable {
        {
          MdnsWorker worker(loop, options, *box);
          worker.run();
        }
        box->done();
      }));
  return {};
}

// A thread that waits for an answer by D-Bus can neither be woken nor ended. It is left to itself
// then: it finds the word to stop in the mailbox as soon as D-Bus gives up, and everything that it
// uses until then is its own.
Mdns::~Mdns() {
  if (!impl_->thread.joinable()) return;
  impl_->mailbox->stop();
  if (impl_->mailbox->wait_until_done(kPatienceAtEnd)) {
    impl_->thread.join();
  } else {
    impl_->thread.detach();
  }
}

void Mdns::announce(std::vector<ServiceRecord> records) {
  if (impl_->mailbox) impl_->mailbox->want(std::move(records));
}

void Mdns::Impl::on_news() {
  MdnsMailbox::News fresh = mailbox->take_news();
  for (const auto& [level, text] : fresh.lines) calm.write(level, text, {});
  if (fresh.hosts) {
    const FoundHosts before = std::exchange(told, *std::move(fresh.hosts));
    for (const auto& [id, host] : before) {
      if (!told.contains(id)) observer.on_host_lost(id);
    }
    for (const auto& [id, host] : told) {
      const auto known = before.find(id);
      if (known == before.end() || known->second != host) observer.on_host_found(host);
    }
  }
  if (fresh.state && *fresh.state != state) {
    state = *std::move(fresh.state);
    observer.on_mdns_state(state);
  }
}

}  // namespace dssm::daemon
