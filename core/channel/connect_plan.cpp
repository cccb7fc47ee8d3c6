// SPDX-License-Identifier: Apache-2.0
#include "core/channel/connect_plan.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace dssm::channel {

void ConnectPlan::begin_round(std::vector<wire::SocketAddress> addresses) {
  addresses_ = std::move(addresses);
  const auto avoided = std::find_if(
      addresses_.begin(), addresses_.end(),
      [this](const wire::SocketAddress& address) { return address.str() == avoided_; });
  if (avoided != addresses_.end()) std::rotate(addresses_.begin(), avoided + 1, addresses_.end());
  current_ = 0;
}

Duration ConnectPlan::connect_timeout() const noexcept {
  const Duration timeout =
      is_recent_ && round_ % kLongRound != 0 ? kRecentTimeout : kConnectTimeout;
  return std::min(timeout, round_time_ / static_cast<std::int64_t>(addresses_.size()));
}

std::string ConnectPlan::no_answer_text() const {
  return fmt::format(
      "connect to '{}': no answer; is that PC on, and do both reach each other (`ping`)?",
      address().str());
}

bool ConnectPlan::next_address() noexcept {
  if (current_ + 1 == addresses_.size()) return false;
  ++current_;
  return true;
}

Duration ConnectPlan::end_round(MonoTime now, bool avoid_address) {
  avoided_ = avoid_address ? address().str() : std::string();
  // One that greets and then refuses is not connected to a hundred times a second.
  const auto up_since = std::exchange(up_since_, std::nullopt);
  if (up_since && now - *up_since >= kUsefulTime) {
    pause_ = kFirstPause;
    lost_at_ = is_fast_ ? std::optional(now) : std::nullopt;
    round_ = 0;
  } else if (up_since || avoid_address) {
    lost_at_.reset();  // it is there, and does not want this connection
  }
  ++round_;
  is_recent_ = lost_at_ && now - *lost_at_ < kRecentTime;
  const Duration pause = std::min(pause_, is_recent_ ? kRecentPause : kMaxPause);
  pause_ = std::min(2 * pause_, kMaxPause);
  return pause;
}

}  // namespace dssm::channel
