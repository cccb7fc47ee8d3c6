// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/playback_clock_owner.hpp"

#include <algorithm>
#include <cmath>

#include "core/base/sealed_memory.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"
#include "daemon/streams/memory_files.hpp"

namespace dssm::daemon {
namespace {

constexpr std::size_t kMaxDriverNameBytes = 63;

Result<clock::PlaybackRun> run_untrusted(const proto::PlaybackRun& message) {
  for (const double number : {message.offset_s(), message.speed(), message.paused_at_s()}) {
    if (!std::isfinite(number)) {
      return Error{Errc::invalid_argument, "a playback clock with a number that is not finite"};
    }
  }
  return clock::PlaybackRun{message.offset_s(), message.speed(), message.paused() ? 1U : 0U,
                            message.paused_at_s()};
}

Result<clock::PlaybackSetting> setting_untrusted(const proto::Playback& message) {
  const clock::PlaybackRun run = DSSM_TRY(run_untrusted(message.run()));
  const clock::PlaybackRun before = DSSM_TRY(run_untrusted(message.before()));
  const double now_s = static_cast<double>(to_ns(WallClock::now())) * 1e-9;
  const double max_s = std::chrono::duration<double>(PlaybackClockOwner::kLease).count();
  // By a clock that is wrong by more than that, it would be late for ever.
  if (!(message.change_s() <= now_s + max_s)) {
    return Error{Errc::invalid_argument,
                 "a change of the playback clock that is more than 5 s to come; are the clocks of "
                 "both hosts right? See `dssmctl clock`"};
  }
  return clock::PlaybackSetting{run, std::max(message.change_s(), 0.0), before};
}

void to_message(const clock::PlaybackRun& run, proto::PlaybackRun& out) {
  out.set_offset_s(run.offset_s);
  out.set_speed(run.speed);
  out.set_paused(run.paused != 0);
  out.set_paused_at_s(run.paused_at_s);
}

}  // namespace

Result<void> PlaybackClockOwner::adopt_untrusted(UniqueFd offered) {
  if (clock_) {
    if (same_file(offered.get(), clock_.get())) return {};
    return Error{Errc::conflict, "another playback clock is in use by now"};
  }
  DSSM_TRY(check_own_memory_file(offered.get(), kSizeSeals, "playback clock"));
  DSSM_TRY(clock::PlaybackRecord::open_untrusted(offered.get()));
  take(std::move(offered));
  return {};
}

Result<UniqueFd> PlaybackClockOwner::get() {
  if (!clock_) {
    take(DSSM_TRY(clock::create_playback_clock()));
  }
  return duplicate(clock_.get());
}

void PlaybackClockOwner::take(UniqueFd clock) {
  clock_ = std::move(clock);
  if (on_new_clock_) on_new_clock_(clock_.get());
}

Result<clock::PlaybackRecord*> PlaybackClockOwner::record() {
  if (!record_) {
    const UniqueFd clock = DSSM_TRY(get());
    record_ = DSSM_TRY(clock::PlaybackRecord::open_untrusted(clock.get()));
  }
  return record_.get();
}

Result<void> PlaybackClockOwner::renew(const proto::FollowPlayback& request,
                                       const std::string& name, MonoTime now) {
  if (request.driver() == 0) {
    return Error{Errc::invalid_argument, "a playback clock is to follow a driver without a number"};
  }
  if (driver_ != 0 && driver_ != request.driver() && now < lease_end_ && !is_driver_gone_) {
    return Error{Errc::conflict,
                 "its playback clock follows " + in_quotes(driver_name_) + "; end that first"};
  }
  driver_ = request.ends() ? 0 : request.driver();
  driver_name_ = name.substr(0, kMaxDriverNameBytes);
  lease_end_ = now + kLease;
  is_driver_gone_ = false;
  if (on_lease_) on_lease_();
  return {};
}

Result<proto::FollowPlayback> PlaybackClockOwner::lead(const proto::FollowPlayback& request,
                                                       std::string driver_name, ClientNumber client,
                                                       MonoTime now) {
  clock::PlaybackRecord* const own = DSSM_TRY(record());
  DSSM_TRY(renew(request, driver_name, now));
  follows_ = false;
  client_ = client;
  proto::FollowPlayback out;
  out.set_driver(request.driver());
  out.set_driver_name(std::move(driver_name));
  out.set_ends(request.ends());
  const clock::PlaybackSetting setting = own->load();
  to_message(setting.run, *out.mutable_playback()->mutable_run());
  out.mutable_playback()->set_change_s(setting.change_s);
  to_message(setting.before, *out.mutable_playback()->mutable_before());
  return out;
}

void PlaybackClockOwner::on_client_gone(ClientNumber client) noexcept {
  if (driver_ != 0 && !follows_ && client_ == client) is_driver_gone_ = true;
}

Result<void> PlaybackClockOwner::follow_untrusted(const proto::FollowPlayback& request,
                                                  MonoTime now) {
  const clock::PlaybackSetting setting = DSSM_TRY(setting_untrusted(request.playback()));
  clock::PlaybackRecord* const own = DSSM_TRY(record());
  DSSM_TRY(renew(request, request.driver_name(), now));
  follows_ = true;
  const bool is_set = own->try_update([&](const clock::PlaybackSetting&) {
    return request.ends() ? clock::PlaybackSetting{} : setting;
  });
  if (is_set) return {};
  return Error{Errc::unavailable, "a program of that host is changing its playback clock"};
}

std::string PlaybackClockOwner::followed_driver(MonoTime now) const {
  // The name comes from another host, and may have been cut within a character.
  return follows_ && driver_ != 0 && now < lease_end_ ? printable(driver_name_) : "";
}

MonoTime PlaybackClockOwner::check_lease(MonoTime now) noexcept {
  if (driver_ == 0) return kNever;
  if (now < lease_end_) return lease_end_;
  driver_ = 0;
  // A program that holds the lock sets it as it wants it.
  if (record_) record_->try_update([](const auto&) { return clock::PlaybackSetting{}; });
  return kNever;
}

}  // namespace dssm::daemon
