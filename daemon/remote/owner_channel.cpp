// SPDX-License-Identifier: Apache-2.0
#include "daemon/remote/owner_channel.hpp"

#include <utility>

namespace dssm::daemon {

OwnerChannel::OwnerChannel(const ChannelParts& parts, std::string stream, User& user)
    : parts_(parts),
      stream_(std::move(stream)),
      user_(user),
      retry_timer_(EventSource::timer(parts.loop, [this] { try_again(); })) {}

void OwnerChannel::connect(const KnownHost& host) {
  owner_ = host.greeting.host_id;
  if (!dialer_) {
    address_ = host.address;
    dialer_.reset(new Dialer(parts_.loop, parts_.resolver, {{address_}, parts_.self}, *this));
    return;
  }
  if (address_ != host.address) {
    address_ = host.address;
    dialer_->set_addresses({address_});
    dialer_->restart({Errc::daemon_away, host.str() + " is reached at another address now"});
  }
  dialer_->hurry();
}

void OwnerChannel::on_owner_down(const Error& why) {
  if (dialer_) dialer_->restart(why);
}

void OwnerChannel::try_again() {
  retry_timer_.disable();
  if (!dialer_) return;
  if (dialer_->link()) {
    anew_ = true;
    dialer_->restart({Errc::closed, "stream '" + stream_ + "' is to be opened anew"});
  }
  dialer_->hurry();
}

void OwnerChannel::on_up(FrameLink& link, const wire::Greeting& them) {
  if (them.host_id == *owner_) return user_.on_up(link, them);
  dialer_->restart({Errc::conflict, "at '" + address_.str() + "' answers " + them.str() +
                                        ", which is another PC than the owner of '" + stream_ +
                                        "'"});
}

void OwnerChannel::on_down(const Error& why) {
  retry_timer_.disable();
  if (std::exchange(anew_, false)) return user_.on_anew();
  user_.on_down(why);
}

}  // namespace dssm::daemon
