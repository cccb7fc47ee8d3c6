// SPDX-License-Identifier: Apache-2.0
//
// How a connection begins and ends:
//
//   connect()       makes a client. Without D-Bus that fails, and is tried again; without an Avahi
//                   daemon the client waits for it (AVAHI_CLIENT_NO_FAIL)
//   follow_state()  announces and browses as soon as the daemon is there; pauses announcing while
//                   it tries another name for this PC
//   reopen()        frees the client with all that it made when the daemon or D-Bus has ended, and
//                   connects again
//
// Avahi's callbacks only set flags: what follows from them is done by timers without delay, so that
// nothing is freed while it is in use further up the stack. Freeing a client closes its connection
// to D-Bus first and calls nothing else; the Avahi daemon then withdraws what it had announced.
#include "daemon/fleet/mdns/mdns_worker.hpp"

#include <avahi-common/error.h>

#include <algorithm>
#include <utility>

#include "core/base/text.hpp"

namespace dssm::daemon {
namespace {

constexpr Duration kFirstConnectPause = std::chrono::milliseconds(100);
constexpr Duration kMaxConnectPause = std::chrono::seconds(2);
// So that many changes in a row are announced as one.
constexpr Duration kOrdersSettle = std::chrono::milliseconds(50);
constexpr Duration kReportSettle = std::chrono::milliseconds(20);

// Beside Avahi's own, which are negative.
constexpr int kErrorNoBus = 1;

std::string waiting_reason(int error) {
  switch (error) {
    case kErrorNoBus:
      return "the D-Bus system bus cannot be reached: install and start it, and the Avahi daemon "
             "(apt install dbus avahi-daemon; systemctl start dbus avahi-daemon)";
    case AVAHI_ERR_NO_DAEMON:
    case AVAHI_ERR_DISCONNECTED:
      return "the Avahi daemon does not run: install and start it (apt install avahi-daemon; "
             "systemctl start avahi-daemon)";
    case AVAHI_ERR_TIMEOUT:
    case AVAHI_ERR_DBUS_ERROR:
      return "the Avahi daemon cannot be reached by D-Bus (" + std::string(avahi_strerror(error)) +
             "): see that both run (systemctl status dbus avahi-daemon)";
    default:
      return "Avahi cannot be used (" + std::string(avahi_strerror(error)) +
             "): see the log of its daemon (journalctl -u avahi-daemon)";
  }
}

}  // namespace

MdnsWorker::MdnsWorker(EventLoop& loop, const Mdns::Options& options, MdnsMailbox& mailbox)
    : loop_(loop),
      mailbox_(mailbox),
      filter_(options.interfaces, options.avoid_interfaces),
      poll_(loop),
      publisher_(loop, options.port, options.stream_pause, *this),
      browser_(loop, options.self, options.port, filter_, *this),
      pause_(kFirstConnectPause) {
  state_.phase = MdnsPhase::waiting;
  orders_ = EventSource::readable(loop, mailbox.orders_fd(), [this] { on_orders(); });
  settle_ = EventSource::timer(loop, [this] { on_settled(); });
  connect_ = EventSource::timer(loop, [this] { connect(); });
  follow_ = EventSource::timer(loop, [this] { follow_state(); });
  report_ = EventSource::timer(loop, [this] { report(); });
  orders_.enable();
  connect_.enable_in(Duration::zero());
  if (filter_.selects()) {
    interfaces_ = std::make_unique<InterfaceWatch>(loop, [this] { choose_interfaces(); });
    choose_interfaces();
  }
}

MdnsWorker::~MdnsWorker() { disconnect(); }

void MdnsWorker::run() {
  // dssmd continues without mDNS.
  const Result<void> ran = loop_.run();
  if (!ran) log(LogLevel::error, "mDNS ends: " + ran.error().message);
}

// The first list is announced at once; after each there is a moment's rest, in which the mailbox
// keeps the newest of those that come.
void MdnsWorker::on_orders() {
  if (!take_orders()) return;
  orders_.disable();
  settle_.enable_in(kOrdersSettle);
}

void MdnsWorker::on_settled() {
  if (take_orders()) return settle_.enable_in(kOrdersSettle);
  orders_.enable();
}

// Whether there was another list.
bool MdnsWorker::take_orders() {
  std::optional<std::vector<ServiceRecord>> wanted = mailbox_.take_wanted();
  // After the bell was read: it may have been rung for this.
  if (mailbox_.stopping()) {
    loop_.stop();
    return false;
  }
  if (!wanted) return false;
  publisher_.want(*std::move(wanted));
  return true;
}

void MdnsWorker::connect() {
  int error = AVAHI_OK;
  client_ = avahi_client_new(poll_.api(), AVAHI_CLIENT_NO_FAIL, on_client, this, &error);
  // Without an Avahi daemon there is a client all the same: it is the bus that is missing.
  if (!client_) return wait_for_avahi(error == AVAHI_ERR_NO_DAEMON ? kErrorNoBus : error);
  follow_.enable_in(Duration::zero());
}

void MdnsWorker::disconnect() {
  publisher_.forget();
  browser_.forget();
  if (client_) avahi_client_free(std::exchange(client_, nullptr));
  failure_ = AVAHI_OK;
}

// Also called from within avahi_client_new().
void MdnsWorker::on_client(AvahiClient*, AvahiClientState state, void* self) {
  auto& worker = *static_cast<MdnsWorker*>(self);
  // It may have passed before follow_state() runs, and what was announced with the old name with
  // it.
  worker.renamed_ |= state == AVAHI_CLIENT_S_REGISTERING || state == AVAHI_CLIENT_S_COLLISION;
  worker.follow_.enable_in(Duration::zero());
}

void MdnsWorker::on_avahi_failure(int error) {
  failure_ = error;
  follow_.enable_in(Duration::zero());
}

void MdnsWorker::follow_state() {
  if (!client_) return;
  if (failure_ != AVAHI_OK) return reopen();
  const AvahiClientState state = avahi_client_get_state(client_);
  switch (state) {
    case AVAHI_CLIENT_FAILURE:
      failure_ = avahi_client_errno(client_);
      return reopen();
    case AVAHI_CLIENT_CONNECTING:
      state_.phase = MdnsPhase::waiting;
      state_.error = waiting_reason(AVAHI_ERR_NO_DAEMON);
      break;
    case AVAHI_CLIENT_S_RUNNING:
    case AVAHI_CLIENT_S_REGISTERING:
    case AVAHI_CLIENT_S_COLLISION: {
      if (state_.phase != MdnsPhase::running) {
        const char* const version = avahi_client_get_version_string(client_);
        if (!version) {
          failure_ = avahi_client_errno(client_);
          return reopen();
        }
        state_.avahi_version = printable(std::string_view(version).substr(0, 64));
        state_.phase = MdnsPhase::running;
        state_.error.clear();
        pause_ = kFirstConnectPause;
        log(LogLevel::notice, "mDNS works (" + state_.avahi_version + ")");
        logged_waiting_ = false;
      }
      browser_.start(client_);
      if (std::exchange(renamed_, false)) publisher_.pause();
      if (state == AVAHI_CLIENT_S_RUNNING) publisher_.start(client_);
      break;
    }
  }
  report();
}

void MdnsWorker::reopen() {
  const int error = failure_;
  disconnect();
  wait_for_avahi(error);
}

void MdnsWorker::wait_for_avahi(int error) {
  state_.phase = MdnsPhase::waiting;
  state_.error = waiting_reason(error);
  connect_.enable_in(pause_);
  pause_ = std::min(2 * pause_, kMaxConnectPause);
  report();
}

void MdnsWorker::choose_interfaces() {
  std::vector<AvahiIfIndex> chosen;
  for (const auto& [index, name] : filter_.existing()) {
    if (chosen.size() == ServicePublisher::kMaxInterfaces) break;
    chosen.push_back(index);
  }
  interface_error_ = chosen.empty()
                         ? "no network interface matches the configured " + filter_.selection() +
                               ": nothing is announced or found until there is one (ip link)"
                         : "";
  publisher_.use_interfaces(std::move(chosen));
  on_avahi_change();
}

void MdnsWorker::on_avahi_change() { report_.enable_in(kReportSettle); }

void MdnsWorker::report() {
  MdnsInfo state = state_;
  if (state.phase == MdnsPhase::waiting) {
    // Logged once, however often it is tried again.
    if (!std::exchange(logged_waiting_, true)) {
      log(LogLevel::warning,
          "mDNS waits, other hosts are found only as configured peers: " + state.error);
    }
  } else {
    for (const std::string& text : {interface_error_, publisher_.problem(), browser_.problem()}) {
      if (!text.empty()) state.error += (state.error.empty() ? "" : "; ") + text;
    }
    state.announced = publisher_.announced();
    state.own_host_seen = browser_.own_host_seen();
    state.hosts_heard = browser_.hosts_heard();
  }
  state.withheld = publisher_.withheld();
  mailbox_.report(browser_.hosts(), std::move(state));
}

}  // namespace dssm::daemon
