// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/mdns/mdns.hpp"

#include <poll.h>
#include <signal.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <thread>
#include <utility>

#include "core/base/quiet_thread.hpp"
#include "core/base/try.hpp"
#include "daemon/fleet/mdns/mdns_worker.hpp"

namespace dssm::daemon {
namespace {

// Lines that dssmd's loop has not taken yet; beyond them lines are dropped.
constexpr std::size_t kMaxPendingLines = 64;

void ring_bell(const UniqueFd& bell) {
  const std::uint64_t one = 1;
  // Fails only when it has been rung 2^64 times.
  [[maybe_unused]] const ssize_t written = ::write(bell.get(), &one, sizeof one);
}

void clear_bell(const UniqueFd& bell) {
  std::uint64_t count;
  // Fails only when it has not been rung.
  [[maybe_unused]] const ssize_t n = ::read(bell.get(), &count, sizeof count);
}

// How long a hung Avahi daemon may delay dssmd's end.
constexpr Duration kEndTimeout = std::chrono::milliseconds(900);

}  // namespace

// --- the mailbox

Result<std::shared_ptr<MdnsMailbox>> MdnsMailbox::open() {
  std::shared_ptr<MdnsMailbox> made(new MdnsMailbox);
  for (UniqueFd* bell : {&made->orders_, &made->updates_, &made->done_}) {
    bell->reset(::eventfd(0, EFD_CLOEXEC | EFD_NONBLOCK));
    if (!*bell) return os_error("make an eventfd");
  }
  return made;
}

void MdnsMailbox::want(std::vector<ServiceRecord> records) {
  {
    const std::lock_guard lock(mutex_);
    wanted_ = std::move(records);
  }
  ring_bell(orders_);
}

void MdnsMailbox::stop() {
  stopping_.store(true);
  ring_bell(orders_);
}

MdnsMailbox::Update MdnsMailbox::take_update() {
  clear_bell(updates_);
  const std::lock_guard lock(mutex_);
  return std::exchange(pending_, {});
}

bool MdnsMailbox::wait_until_done(Duration timeout) const {
  pollfd bell{done_.get(), POLLIN, 0};
  const auto ms = std::chrono::duration_cast<std::chrono::milliseconds>(timeout).count();
  return ::poll(&bell, 1, static_cast<int>(ms)) > 0;
}

std::optional<std::vector<ServiceRecord>> MdnsMailbox::take_wanted() {
  clear_bell(orders_);
  const std::lock_guard lock(mutex_);
  return std::exchange(wanted_, std::nullopt);
}

void MdnsMailbox::report(FoundHosts hosts, MdnsInfo state) {
  {
    const std::lock_guard lock(mutex_);
    pending_.hosts = std::move(hosts);
    pending_.state = std::move(state);
  }
  ring_bell(updates_);
}

void MdnsMailbox::log(LogLevel level, std::string text) {
  {
    const std::lock_guard lock(mutex_);
    if (pending_.lines.size() < kMaxPendingLines)
      pending_.lines.emplace_back(level, std::move(text));
  }
  ring_bell(updates_);
}

void MdnsMailbox::done() { ring_bell(done_); }

// --- dssmd's side

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
