// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/owner_connection.hpp"

#include <utility>

namespace dssm::daemon {

OwnerConnection::OwnerConnection(const ChannelParts& parts, std::string stream, Observer& observer)
    : parts_(parts),
      stream_(std::move(stream)),
      observer_(observer),
      retry_timer_(EventSource::timer(parts.loop, [this] { try_again(); })) {}

void OwnerConnection::connect(const KnownHost& host) {
  owner_ = host.greeting.host_id;
  if (!dialer_) {
    address_ = host.address;
    dialer_.reset(new Dialer(parts_.loop, parts_.resolver, {{address_}, parts_.self}, *this));
    return;
  }
  if (address_ != host.address) {
    address_ = host.address;
    dialer_->set_addresses({address_});
    dialer_->restart({Errc::unavailable, host.str() + " is reached at another address now"});
  }
  dialer_->retry_now();
}

void OwnerConnection::on_owner_down(const Error& why) {
  if (dialer_) dialer_->restart(why);
}

void OwnerConnection::try_again() {
  retry_timer_.disable();
  if (!dialer_) return;
  if (dialer_->link()) {
    anew_ = true;
    dialer_->restart({Errc::closed, "stream '" + stream_ + "' is to be opened anew"});
  }
  dialer_->retry_now();
}

void OwnerConnection::on_up(FrameConnection& link, const wire::Greeting& them) {
  if (them.host_id == *owner_) return observer_.on_up(link, them);
  dialer_->restart({Errc::conflict, "at '" + address_.str() + "' answers " + them.str() +
                                        ", which is another PC than the owner of '" + stream_ +
                                        "'"});
}

void OwnerConnection::on_down(const Error& why) {
  retry_timer_.disable();
  if (std::exchange(anew_, false)) return observer_.on_reopen();
  observer_.on_down(why);
}

}  // namespace dssm::daemon
