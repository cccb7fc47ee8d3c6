// SPDX-License-Identifier: Apache-2.0
#include "daemon/base/turn_queue.hpp"

#include <algorithm>
#include <new>
#include <utility>

namespace dssm::daemon {

TurnQueue::Turn::Turn(TurnQueue& queue, std::string account, std::function<void()> take)
    : queue_(queue),
      requests_(account, Reason::request),
      events_(std::move(account), Reason::event),
      take_(std::move(take)) {}

bool TurnQueue::Turn::may_begin(Reason reason) {
  if (is_called_ || (queue_.waiting_.empty() && queue_.used_ < kMaxTurn)) return true;
  wait(reason);
  return false;
}

void TurnQueue::Turn::wait(Reason reason) {
  if (is_waiting_ && reason >= reason_) return;
  stop();
  const Account& account = reason == Reason::event ? events_ : requests_;
  of_account_ = queue_.waiting_.try_emplace(account).first;
  used_ = std::max(used_, queue_.least_);
  try {
    place_ = of_account_->second.emplace(used_, this);
  } catch (const std::bad_alloc&) {
    if (of_account_->second.empty()) queue_.waiting_.erase(of_account_);  // run() expects one
    throw;
  }
  is_waiting_ = true;
  reason_ = reason;
  queue_.next_.enable_in(Duration::zero());
}

void TurnQueue::Turn::stop() noexcept {
  if (!std::exchange(is_waiting_, false)) return;
  of_account_->second.erase(place_);
  if (of_account_->second.empty()) queue_.waiting_.erase(of_account_);
}

void TurnQueue::run() {
  used_ = {};
  while (!waiting_.empty() && used_ < kMaxTurn) {
    auto of_account = waiting_.upper_bound(last_);
    if (of_account == waiting_.end()) of_account = waiting_.begin();
    last_ = of_account->first;
    const MonoTime begin = MonoClock::now();
    do {
      call(*of_account->second.begin()->second);
      of_account = waiting_.find(last_);
    } while (of_account != waiting_.end() && MonoClock::now() - begin < kMaxVisit);
  }
  if (!waiting_.empty()) next_.enable_in(Duration::zero());
}

void TurnQueue::call(Turn& turn) {
  turn.stop();
  least_ = std::max(least_, turn.used_);
  turn.is_called_ = true;
  const Duration before = used_;
  turn.take_();
  turn.used_ += used_ - before;
  turn.is_called_ = false;
  if (!turn.is_waiting_) return;
  // Now by what it has used, in the memory that it has: nobody would catch bad_alloc here.
  turn.used_ = std::max(turn.used_, least_);
  auto& of_account = turn.of_account_->second;
  auto place = of_account.extract(turn.place_);
  place.key() = turn.used_;
  turn.place_ = of_account.insert(std::move(place));
}

}  // namespace dssm::daemon
