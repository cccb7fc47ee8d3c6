// SPDX-License-Identifier: Apache-2.0
//
// The thread that talks to Avahi: keeps a client connected, lets it announce and browse, and
// reports to the mailbox. Any call in here may take as long as the timeout of D-Bus (25 s).
#pragma once

#include <avahi-client/client.h>

#include <memory>
#include <string>

#include "daemon/fleet/mdns/avahi_poll.hpp"
#include "daemon/fleet/mdns/host_browser.hpp"
#include "daemon/fleet/mdns/interface_filter.hpp"
#include "daemon/fleet/mdns/mdns.hpp"
#include "daemon/fleet/mdns/service_publisher.hpp"
#include "daemon/link/interface_watch.hpp"

namespace dssm::daemon {

class MdnsWorker {
 public:
  // loop and mailbox outlive it; loop is its own.
  MdnsWorker(EventLoop& loop, const Mdns::Options& options, MdnsMailbox& mailbox);
  MdnsWorker(const MdnsWorker&) = delete;
  MdnsWorker& operator=(const MdnsWorker&) = delete;
  ~MdnsWorker();  // withdraws all

  void run();  // until MdnsMailbox::stop()

  // --- for the publisher and the browser

  // Something that is reported has changed.
  void on_avahi_change();
  // The client cannot be used any more; it is freed after this, not inside.
  void on_avahi_failure(int error);
  void log(LogLevel level, std::string text) { mailbox_.log(level, std::move(text)); }
  // Whether to end quickly, without more calls to Avahi.
  bool stopping() const noexcept { return mailbox_.stopping(); }

 private:
  static void on_client(AvahiClient* client, AvahiClientState state, void* self);
  void on_orders();
  void on_settled();
  bool take_orders();
  void connect();
  void disconnect();
  void follow_state();
  void wait_for_avahi(int error);
  void reopen();
  void choose_interfaces();
  void report();

  EventLoop& loop_;
  MdnsMailbox& mailbox_;
  const InterfaceFilter filter_;
  LoopAvahiPoll poll_;
  ServicePublisher publisher_;
  HostBrowser browser_;
  AvahiClient* client_ = nullptr;
  MdnsInfo state_;
  std::string interface_error_;
  int failure_ = 0;              // of the client, to be dealt with outside its callbacks
  bool renamed_ = false;         // this PC got another name since the last follow_state()
  bool logged_waiting_ = false;  // that Avahi is not available
  Duration pause_;               // before the next attempt to connect
  std::unique_ptr<InterfaceWatch> interfaces_;
  EventSource orders_, settle_, connect_, follow_, report_;
};

}  // namespace dssm::daemon
