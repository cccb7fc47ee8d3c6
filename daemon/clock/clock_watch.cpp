// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/clock_watch.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <array>
#include <cstdio>
#include <utility>

#include "daemon/base/message_ids.hpp"

namespace dssm::daemon {
namespace {

using clock::Instant;

// "1.234 ms", "12.345 s"; without the sign.
std::string length_text(Duration d) {
  const double seconds = std::chrono::abs(std::chrono::duration<double>(d)).count();
  std::array<char, 48> text{};
  std::snprintf(text.data(), text.size(), seconds < 1 ? "%.3f ms" : "%.3f s",
                seconds < 1 ? seconds * 1000 : seconds);
  return text.data();
}

std::string left_out_text(std::uint64_t count, const char* what) {
  return count ? fmt::format(" ({} {} before this were left out)", count, what) : "";
}

}  // namespace

ClockWatch::ClockWatch(const EventLoop& loop, const Options& options, Observer& observer,
                       Logger& logger)
    : where_("chronyd at '" + options.chronyd.str() + "'"),
      observer_(observer),
      logger_(logger),
      now_(options.now),
      tick_(options.tick),
      estimator_(options.settings),
      client_(loop, options.chronyd, *this, options.now, options.period) {
  Result<std::unique_ptr<StepWatch>> watch = StepWatch::open(loop, [this] { on_set(); });
  if (watch) {
    step_watch_ = *std::move(watch);
  } else {
    logger_.warning(watch.error().message +
                    "; steps of this PC's clock are noticed within a second, not at once");
  }
}

Instant ClockWatch::base() {
  observe(now_());
  return *estimator_.base();
}

ClockSnapshot ClockWatch::state() {
  const Instant now = now_();
  observe(now);
  ClockSnapshot state = estimator_.at(now.mono);
  if (last_) state.update_interval = last_->tracking.update_interval;
  // Before its first answer, the reason is still that it is absent.
  if (state.status == ClockStatus::unknown && absent_) state.reason = ClockReason::no_chronyd;
  return state;
}

[[gnu::hot]] bool ClockWatch::may_differ() {
  const clock::Tick tick = tick_();
  if (seen_tick_ && tick.difference == seen_tick_->difference &&
      tick.mono - seen_tick_->mono < kMaxDelay) {
    return false;
  }
  seen_tick_ = tick;
  return true;
}

std::optional<wire::IpAddress> ClockWatch::source() const noexcept {
  return last_ ? last_->source : std::nullopt;
}

std::uint32_t ClockWatch::reference_id() {
  return state().bound == kUnknownClockError ? 0 : estimator_.reference_id();
}

void ClockWatch::on_reference(const std::optional<clock::ReferenceReport>& report) noexcept {
  estimator_.on_reference(report, now_().mono);
}

void ClockWatch::on_source_step(const std::string& name) {
  estimator_.on_source_step();
  const auto steps = step_lines_.admit(now_().mono);
  if (!steps) return;
  logger_.warning(
      fmt::format("the clock of '{}', which this PC's chronyd follows, was set{}; what chronyd "
                  "states is not used until it has measured that clock {} times again",
                  name, left_out_text(*steps - 1, "steps"),
                  clock::ClockEstimator::kUpdatesAfterStep),
      {.peer = name, .message_id = message_id::kClockStepped});
}

void ClockWatch::on_answer(const TrackingReply& reply, MonoTime asked, const Instant& answered) {
  observe(answered);
  if (estimator_.take_untrusted(reply.tracking, asked, answered) ==
      clock::ClockEstimator::Outcome::nonsense) {
    return on_no_answer(
        {Errc::protocol, "its values are not possible; does `chronyc tracking` show them, too?"});
  }
  last_ = reply;
  absent_ = false;
  waiting_since_.reset();
  observer_.on_clock();
}

void ClockWatch::on_no_chronyd() {
  const Instant now = now_();
  observe(now);
  estimator_.on_no_chronyd();
  last_.reset();
  absent_ = true;
  waiting_since_.reset();
  observer_.on_clock();
}

void ClockWatch::on_no_answer(const Error& why) {
  const Instant now = now_();
  observe(now);
  if (!waiting_since_) waiting_since_ = now.mono;
  last_error_ = why.message;
  observer_.on_clock();
}

void ClockWatch::on_set() {
  const Instant now = now_();
  observe(now);
  observer_.on_clock();
}

void ClockWatch::observe(const Instant& now) {
  const std::optional<Duration> step = estimator_.observe(now);
  if (!step) return;
  const auto steps = step_lines_.admit(now.mono);
  if (!steps) return;
  logger_.warning(
      fmt::format("this PC's clock was set {} by {}{}; it is out of bounds until chronyd "
                  "has measured it {} times again",
                  *step > Duration::zero() ? "forward" : "back", length_text(*step),
                  left_out_text(*steps - 1, "steps"), clock::ClockEstimator::kUpdatesAfterStep),
      {.message_id = message_id::kClockStepped});
}

void ClockWatch::log_change(const ClockSnapshot& state) {
  const MonoTime now = now_().mono;
  const Condition is = condition(state, now);
  if (is != std::exchange(seen_, is)) ++unlogged_changes_;
  // One that comes and goes while the log is limited is counted; one that lasts is logged later.
  if (is != logged_ && change_lines_.wait(now) == Duration::zero()) log(is, state, now);
}

ClockWatch::Condition ClockWatch::condition(const ClockSnapshot& state,
                                            MonoTime now) const noexcept {
  if (absent_ || state.status == ClockStatus::unknown) {
    // A chronyd that is just starting may take a while to answer.
    const bool too_long =
        waiting_since_ && now - *waiting_since_ > clock::ClockEstimator::kSilentAfter;
    return too_long ? Condition::silent : absent_ ? Condition::absent : Condition::unknown;
  }
  if (state.status == ClockStatus::holdover) return Condition::holdover;
  if (state.status == ClockStatus::synchronized) return Condition::good;
  switch (state.reason) {
    case ClockReason::unsynchronized:
      return Condition::unsynchronized;
    case ClockReason::stepped:
      return Condition::stepped;
    case ClockReason::too_far:
      return Condition::too_far;
    case ClockReason::no_chronyd:
    case ClockReason::silent:
    case ClockReason::none:
      break;
  }
  return Condition::silent;
}

void ClockWatch::log(Condition condition, const ClockSnapshot& state, MonoTime now) {
  const bool was_unavailable = logged_ == Condition::absent || logged_ == Condition::silent;
  const bool is_step =
      condition == Condition::stepped && !was_unavailable;  // observe() has logged that
  logged_ = condition;
  if (is_step || condition == Condition::unknown) {
    --unlogged_changes_;
    return;
  }
  change_lines_.take(now);
  const std::string others = left_out_text(std::exchange(unlogged_changes_, 0) - 1, "changes");
  const std::string back = was_unavailable ? where_ + " answers again" + others + "; " : "";
  const std::string after = was_unavailable ? "" : others;
  switch (condition) {
    case Condition::absent:
      return logger_.warning("there is no " + where_ + after +
                                 ": this PC's clock has no bound; is it running (`systemctl status "
                                 "chrony`), and does chrony.conf leave its `cmdport` at that?",
                             {.message_id = message_id::kChronydAway});
    case Condition::silent:
      return logger_.warning(where_ + " does not report the state of this PC's clock" + after +
                                 "; the clock has no bound: " + last_error_,
                             {.message_id = message_id::kChronydAway});
    case Condition::unsynchronized:
      return logger_.warning(back + "chronyd does not know the time" + after +
                                 ", so this PC's clock has no bound; does it reach its sources "
                                 "(`chronyc sources`)?",
                             {.message_id = message_id::kClockOutOfBounds});
    case Condition::stepped:
      return logger_.warning(
          back + "this PC's clock was set, and chronyd has not measured it since" + after,
          {.message_id = message_id::kClockOutOfBounds});
    case Condition::too_far:
      return logger_.warning(back + too_far(state) + after,
                             {.message_id = message_id::kClockOutOfBounds});
    case Condition::holdover:
    case Condition::good:
      return logger_.notice(back + in_bounds(condition, state) + after,
                            {.message_id = message_id::kClockInBounds});
    case Condition::unknown:
      return;
  }
}

std::string ClockWatch::in_bounds(Condition condition, const ClockSnapshot& state) const {
  const char* const from = state.basis == ClockBasis::own ? "the time that it gives to others"
                           : state.basis == ClockBasis::reference ? "the reference PC's"
                                                                  : "the right time";
  std::string text =
      fmt::format("this PC's clock is within {} of {} (limit {})", length_text(state.bound), from,
                  length_text(estimator_.settings().limit));
  if (condition == Condition::holdover) {
    text += fmt::format(
        ", but chronyd has learned nothing for {}: that grows by {} each second; does it reach its "
        "sources (`chronyc sources`)?",
        length_text(state.age), length_text(Duration(state.ageing_ppb)));
  }
  return text;
}

std::string ClockWatch::too_far(const ClockSnapshot& state) const {
  const Duration off = std::chrono::abs(state.offset);
  const Duration aged = state.basis == ClockBasis::own ? Duration::zero()
                                                       : clock::growth(state.age, state.ageing_ppb);
  const Duration of_source = state.bound - off - aged;
  const std::string text =
      fmt::format("this PC's clock may be wrong by {}, more than its limit of {}",
                  length_text(state.bound), length_text(estimator_.settings().limit));
  if (off >= std::max(aged, of_source)) {
    return fmt::format(
        "{}: it is off by {}, which chronyd is slewing away; wait, or step it (`chronyc makestep`)",
        text, length_text(off));
  }
  if (aged >= of_source) {
    return fmt::format(
        "{}: chronyd has learned nothing for {}; does it reach its sources (`chronyc sources`)?",
        text, length_text(state.age));
  }
  return text +
         ": the source that chronyd follows is that far from its root or was just corrected, or "
         "the "
         "network delays its packets (`chronyc ntpdata`); is there a nearer one?";
}

}  // namespace dssm::daemon
