// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/sample_pump.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace dssm::daemon {
namespace {

constexpr SampleSender::SliceLimits kAtOnce{SampleSender::kSliceBytes, true};

// As many bytes as the network carries in that time, when it carries so many each second.
std::size_t bytes_in(Duration time, std::uint64_t carried_per_s) noexcept {
  return static_cast<std::size_t>(std::chrono::duration<double>(time).count() *
                                  static_cast<double>(carried_per_s));
}

Duration period_of(double rate_hz) {
  constexpr double kMaxNs = 1e18;  // some 30 years
  return Duration(static_cast<std::int64_t>(std::min(1e9 / rate_hz, kMaxNs)));
}

}  // namespace

[[gnu::hot]] Tid newest_untrusted(const ring::RingReader& reader) noexcept {
  const Tid newest = reader.newest();
  return newest >= 0 && newest <= channel::kMaxTid ? newest : kNoTid;
}

SamplePump::SamplePump(const ring::RingMapping& mapping, FrameConnection& connection,
                       SampleSender& sender, Observer& observer, const Plan& plan)
    : reader_(mapping),
      payload_bytes_(mapping.geometry().payload_bytes),
      depth_(static_cast<Tid>(mapping.geometry().depth)),
      connection_(connection),
      sender_(sender),
      observer_(observer),
      plan_(plan),
      next_(std::clamp<Tid>(plan.first, 0, channel::kMaxTid)),
      last_(channel::kMaxTid) {
  unsent_limit_ = !decides_late() ? 0 : has_pace() ? kMinUnsentBytes : kUnsentBytes;
  connection_.limit_unsent(unsent_limit_);
  const Tid newest = newest_untrusted(reader_);
  const ring::TidRange held{std::max(plan.held.begin, next_), std::min(plan.held.end, newest + 1)};
  if (plan.backlog_from == kNoTid) plan_.backlog_from = newest + 1;
  if (!plan.newest_first || held.end <= held.begin) return;
  if (held.begin > next_) passed_over_.push_back({next_, held.begin});
  next_ = held.end;
}

[[gnu::hot]] Result<PumpWait> SamplePump::pump(MonoTime now, bool only_under_way) {
  if (decides_late()) fit_unsent_limit();
  has_filled_ = false;
  const std::uint64_t begin = sender_.payload_bytes();
  for (int samples = 0;
       samples < kSamplesPerTurn && sender_.payload_bytes() - begin < kBytesPerTurn;) {
    SendStatus status = SendStatus::sent;
    Tid sent_up_to = chosen() + 1;
    SampleSender::SliceLimits limits = kAtOnce;
    std::uint64_t sent_before = connection_.sent_bytes();
    if (under_way_) {
      if (!only_under_way) limits = limits_now(now);
      if (limits.most_bytes == 0) return wait_for_pace();
      status = sender_.go_on(limits);
    } else if (only_under_way) {
      sender_.end_run();
      return connection_.output_empty() ? PumpWait::turn : PumpWait::output;
    } else {
      const Next next = choose_next(now);
      if (next != Next::ready) sender_.end_run();
      if (next == Next::end) return PumpWait::ended;
      // A frame that reports a gap, for example, may wait for the socket.
      if (!connection_.output_empty()) return PumpWait::output;
      if (next == Next::wait_for_sample) return PumpWait::sample;
      if (next == Next::wait_for_time) {
        wake_at_ = due_;
        return PumpWait::time;
      }
      limits = limits_now(now);
      if (limits.most_bytes == 0) {
        sender_.end_run();
        return wait_for_pace();
      }
      const Tid last = last_of_run();
      observer_.before_samples();
      if (!connection_.output_empty()) return PumpWait::output;
      sent_before = connection_.sent_bytes();
      const Tid at = chosen();
      if (sender_.sends_in_place()) {
        sent_up_to = at + 1;
        status = sender_.send(at, 0, at < last, limits);
      } else {
        // The writer continues meanwhile: the newest sample may not be the newest any more.
        const std::size_t fit = limits.most_bytes / (payload_bytes_ + kHeaderBytes);
        const Tid at_most = at +
                            std::clamp<Tid>(static_cast<Tid>(fit), 1,
                                            thins() && !fills_ ? 1 : kSamplesPerTurn - samples) -
                            1;
        status = sender_.send_many(at, std::min(last, at_most), sent_up_to);
      }
    }
    if (fills_) {
      const bool is_full =
          !limits.may_copy && (status == SendStatus::blocked || !connection_.output_empty());
      connection_.on_history_sent(sent_before, is_full);
    }
    Tid& at = chosen();
    under_way_ = sender_.busy();
    switch (status) {
      case SendStatus::sent:
        samples += static_cast<int>(sent_up_to - at);
        at = sent_up_to;
        after_sample(now);
        break;
      case SendStatus::torn:  // it is outside of the window now: choose_next() reports the gap
        ++samples;
        break;
      case SendStatus::not_in_ring:
        // Overwritten since choose_next(), or the slot holds invalid values.
        ++samples;
        if (at < reader_.oldest()) break;
        if (fills_) {
          lose({at, at + 1});
          back_fill_.begin = at + 1;
        } else if (thins() && !plan_.newest_first) {
          next_ = at + 1;  // no gap: what is left out is not reported
        } else {
          lose_up_to(at + 1);
        }
        break;
      case SendStatus::blocked:
        sender_.end_run();
        return PumpWait::output;
      case SendStatus::unfinished:
        break;
      case SendStatus::no_memory:
        return Error{Errc::limit_exceeded,
                     fmt::format("no memory is left to copy a sample of {} bytes aside; use a "
                                 "client that has the feature 'torn', or raise the key "
                                 "max_peer_memory",
                                 payload_bytes_)};
    }
  }
  sender_.end_run();
  return PumpWait::turn;
}

// Chooses the next sample to send, or what to wait for.
[[gnu::hot]] SamplePump::Next SamplePump::choose_next(MonoTime now) {
  if (plan_.newest_first) return choose_newest_first(now);
  const Tid newest = newest_untrusted(reader_);
  if (!thins() && next_ <= newest) {
    const Tid oldest = reader_.oldest();
    if (next_ < oldest) lose_up_to(std::min({oldest, newest, last_ + 1}));
  }
  if (!caught_up_ && next_ > plan_.caught_up_at) {
    caught_up_ = true;
    sender_.end_run();
    observer_.on_caught_up();
  }
  if (next_ > last_) {
    sender_.end_run();
    observer_.on_end();
    return Next::end;
  }
  if (next_ > newest) return Next::wait_for_sample;
  if (!thins()) return Next::ready;
  if (now < due_) return Next::wait_for_time;
  next_ = std::min(newest, last_);
  return Next::ready;
}

[[gnu::hot]] SamplePump::Next SamplePump::choose_newest_first(MonoTime now) {
  const Tid newest = std::min(newest_untrusted(reader_), last_);
  const Tid oldest = reader_.oldest();
  lose_passed_over(oldest);
  if (next_ < oldest && next_ <= newest) {
    lose_up_to(std::min(oldest, newest + 1));
  }
  Tid lowest = passed_over_.empty() ? next_ : passed_over_.front().begin;
  if (back_fill_.count() > 0) lowest = std::min(lowest, back_fill_.begin);
  if (!caught_up_ && lowest > plan_.caught_up_at) {
    caught_up_ = true;
    sender_.end_run();
    observer_.on_caught_up();
  }
  const bool is_due = has_due_sample(now, newest);
  fills_ = !is_due || (has_filled_ && (back_fill_.count() > 0 || !passed_over_.empty()));
  if (!fills_) {
    if (thins()) {
      leave_out(newest);
    } else if (newest > next_ && takes_long({next_, newest + 1})) {
      pass_over(newest, now);
    }
    return Next::ready;
  }
  // What was sent last still waits for the socket, and pump() with it.
  if (!connection_.output_empty()) return Next::wait_for_sample;
  has_kept_up_ |= !is_due;
  // Otherwise there is time between the samples, but not for all that waits.
  const bool is_overload_known = gives_up_ && now - passed_over_at_ < kOverloadedAfter;
  if (back_fill_.count() == 0 && !is_overload_known &&
      (passed_over_.empty() || passed_over_.back().end <= behind_from_)) {
    passed_over_since_ = 0;
    gives_up_ = false;
  }
  if (back_fill_.count() == 0 && !passed_over_.empty()) choose_back_fill();
  if (back_fill_.count() > 0) {
    has_filled_ = !has_pace();
    return Next::ready;
  }
  fills_ = false;
  if (next_ <= newest) return Next::wait_for_time;
  if (next_ <= last_) return Next::wait_for_sample;
  sender_.end_run();
  observer_.on_end();
  return Next::end;
}

bool SamplePump::has_due_sample(MonoTime now, Tid newest) const noexcept {
  return next_ <= newest && !(thins() && now < due_);
}

// Of the sample that is sent, or is to be sent next. New ones do not wait for the pace.
[[gnu::hot]] SampleSender::SliceLimits SamplePump::limits_now(MonoTime now) {
  if (!fills_ || !has_pace() || has_due_sample(now, std::min(newest_untrusted(reader_), last_))) {
    return kAtOnce;
  }
  return {connection_.history_allowance(), false};
}

PumpWait SamplePump::wait_for_pace() noexcept {
  wake_at_ = connection_.history_due();
  const Tid newest = newest_untrusted(reader_);
  if (next_ > newest) return PumpWait::pace;
  // One waits for its time, or comes after the last one.
  if (next_ <= last_) wake_at_ = std::min(wake_at_, due_);
  return PumpWait::time;
}

// Of those that are sent one after the other.
Tid SamplePump::last_of_run() const noexcept {
  return fills_ ? back_fill_.end - 1 : std::min(newest_untrusted(reader_), last_);
}

// The first of the newest samples of the range that together have at most so many bytes. Of many,
// the length of the newest ones counts for all.
Tid SamplePump::first_within(std::size_t bytes, ring::TidRange range) const noexcept {
  const std::size_t most = payload_bytes_ + kHeaderBytes;
  if (static_cast<std::size_t>(range.count()) * most <= bytes) return range.begin;
  Tid first = range.end;
  for (std::size_t sum = 0; first > range.begin; --first) {
    SampleInfo info;
    info.payload_bytes = payload_bytes_;
    static_cast<void>(reader_.stamp(first - 1, info));
    sum += info.payload_bytes + kHeaderBytes;
    if (sum > bytes) break;
    if (range.end - first == kSamplesPerTurn) {
      return std::max(range.begin, range.end - static_cast<Tid>(bytes / (sum / kSamplesPerTurn)));
    }
  }
  return first;
}

bool SamplePump::takes_long(ring::TidRange samples) const noexcept {
  // What a subscription begins with was not written lately, but is as old as the ring.
  const bool is_old = samples.begin <= plan_.caught_up_at;
  const std::size_t in_order =
      is_old
          ? kOldInOrderBytes
          : std::min(static_cast<std::size_t>(unsent_factor_ * static_cast<double>(kInOrderBytes)),
                     kMostUnsentBytes);
  if (first_within(in_order, samples) == samples.begin) return false;
  const std::optional<wire::Progress> progress = connection_.progress();  // a system call
  if (!progress) return true;
  if (!is_old && !has_pace() && progress->unsent_bytes == 0) return false;
  const Duration time = has_pace() || is_old ? kInOrderFor : kSmallInOrderFor;
  return first_within(bytes_in(time, progress->carried_bytes_per_s), samples) != samples.begin;
}

// Takes one piece of what was passed over: the newest one, or of small samples that are no history
// the oldest one. Newest first, these would leave the ring on a PC that is busy for long.
void SamplePump::choose_back_fill() {
  auto range = passed_over_.end() - 1;
  if (has_pace() || range->end <= plan_.backlog_from) {
    back_fill_ = {std::min(first_within(kInOrderBytes, *range), range->end - 1), range->end};
  } else {
    range = std::find_if(passed_over_.begin(), passed_over_.end(),
                         [&](const ring::TidRange& some) { return some.end > plan_.backlog_from; });
    const Tid first = std::max(range->begin, plan_.backlog_from);
    const auto most = static_cast<Tid>(kInOrderBytes / (payload_bytes_ + kHeaderBytes));
    back_fill_ = {first, std::min(first + std::max<Tid>(most, 1), range->end)};
  }
  const ring::TidRange before{range->begin, back_fill_.begin}, after{back_fill_.end, range->end};
  range = passed_over_.erase(range);
  if (after.count() > 0) range = passed_over_.insert(range, after);
  if (before.count() > 0) passed_over_.insert(range, before);
  if (has_pace()) limit_unsent(connection_.progress());
}

// Puts the rest of the piece back to what waits.
void SamplePump::return_back_fill() {
  if (back_fill_.count() == 0) return;
  const auto after =
      std::find_if(passed_over_.begin(), passed_over_.end(),
                   [&](const ring::TidRange& range) { return range.begin >= back_fill_.end; });
  if (after != passed_over_.end() && after->begin == back_fill_.end) {
    after->begin = back_fill_.begin;
  } else {
    passed_over_.insert(after, back_fill_);
  }
  back_fill_ = {};
}

void SamplePump::pass_over(Tid next, MonoTime now) {
  return_back_fill();
  if (passed_over_.size() < kMaxPassedOver) {
    passed_over_.push_back({next_, next});
  } else {
    passed_over_.back().end = next;
  }
  passed_over_at_ = now;
  next_ = next;
  if (has_pace()) limit_unsent(connection_.progress());
  if (passed_over_since_ == 0) {
    behind_from_ = has_kept_up_ ? passed_over_.back().begin : next;  // history is no overload
  }
  give_up_what_is_never_carried(now);
}

// With a rate: those before sample `newest` are not sent, unless they are history.
void SamplePump::leave_out(Tid newest) {
  const Tid end = std::min(newest, plan_.caught_up_at + 1);
  if (end > next_) {
    return_back_fill();
    passed_over_.push_back({next_, end});
    next_ = end;
  }
  if (next_ < newest) lose_up_to(newest);
}

// How many samples wait that were passed over is measured again and again: when they become more,
// the network carries less than is written. Of small ones the older ones count, too, because they
// go first.
void SamplePump::give_up_what_is_never_carried(MonoTime now) {
  const auto first =
      std::find_if(passed_over_.begin(), passed_over_.end(),
                   [&](const ring::TidRange& range) { return range.begin >= behind_from_; });
  const Tid counted_from = has_pace() ? behind_from_ : plan_.backlog_from;
  Tid waiting = 0;
  for (const ring::TidRange& range : passed_over_) {
    waiting += std::max<Tid>(range.end - std::max(range.begin, counted_from), 0);
  }
  ++passed_over_since_;
  const bool is_measured =
      passed_over_since_ >= kOverloadedSamples && now - behind_since_ >= kOverloadedAfter;
  if (passed_over_since_ == 1 ||
      (is_measured && (waiting <= waiting_before_ || first == passed_over_.end() ||
                       is_spared(first->begin, now)))) {
    passed_over_since_ = 1;
    behind_since_ = now;
    waiting_before_ = waiting;
    next_before_ = next_;
  } else if (is_measured) {
    for (auto range = first; range != passed_over_.end(); ++range) lose(*range);
    passed_over_.erase(first, passed_over_.end());
    waiting_before_ = 0;
    gives_up_ = true;
  }
}

// Whether samples from that one on are not given up yet: it was written within kSparedFor, and the
// ring still holds it after kKeptFor, when as many are written as lately.
bool SamplePump::is_spared(Tid first, MonoTime now) const noexcept {
  if (gives_up_) return false;
  const std::chrono::duration<double> passed = now - behind_since_, kept = kKeptFor,
                                      spared = kSparedFor;
  const double written_per_s = static_cast<double>(next_ - next_before_) / passed.count();
  return static_cast<double>(next_ - first) < written_per_s * spared.count() &&
         static_cast<double>(first + depth_ - next_) > written_per_s * kept.count();
}

void SamplePump::limit_unsent(const std::optional<wire::Progress>& progress) {
  const std::uint64_t carried = progress ? progress->carried_bytes_per_s : 0;
  // On a busy PC the measured rate is too low, and small samples need little time.
  const std::size_t usual =
      has_pace() ? std::clamp(bytes_in(kUnsentFor, carried), kMinUnsentBytes, kUnsentBytes)
                 : kUnsentBytes;
  const std::size_t limit = std::min(
      static_cast<std::size_t>(unsent_factor_ * static_cast<double>(usual)), kMostUnsentBytes);
  if (std::exchange(unsent_limit_, limit) != limit) connection_.limit_unsent(limit);
}

// The connection was full, and takes bytes again.
void SamplePump::fit_unsent_limit() {
  const std::optional<wire::Progress> progress = connection_.progress_when_writable();
  if (!progress) return;
  // Small samples: when none is unsent, the connection could have carried more, also where
  // acknowledgements come late. Large ones: a slow network still holds in its queue what was sent,
  // so it must be acknowledged.
  const std::uint64_t left = has_pace() ? progress->waiting_bytes : progress->unsent_bytes;
  if (left == 0) {
    unsent_factor_ = std::min(2 * unsent_factor_, kMostUnsentFactor);
  } else if (left > unsent_limit_ / 4) {
    unsent_factor_ = std::max(7 * unsent_factor_ / 8, 1.0);
  }
  limit_unsent(progress);
}

// Those before that sample will not be sent.
void SamplePump::lose_passed_over(Tid before) {
  if (back_fill_.begin < before) return_back_fill();
  while (!passed_over_.empty() && passed_over_.front().begin < before) {
    ring::TidRange& front = passed_over_.front();
    const ring::TidRange lost{front.begin, std::min(front.end, before)};
    front.begin = lost.end;
    if (front.count() == 0) passed_over_.pop_front();
    lose(lost);
  }
}

void SamplePump::lose_up_to(Tid next) { lose({std::exchange(next_, next), next}); }

void SamplePump::lose(ring::TidRange range) {
  const auto count = static_cast<std::uint64_t>(range.count());
  lost_ += count;
  sender_.end_run();
  observer_.on_gap(range.begin, count);
}

void SamplePump::after_sample(MonoTime now) {
  if (!thins() || fills_) return;
  // From when it was due, so that the rate holds on the whole although timers come late.
  const Duration period = period_of(plan_.max_rate_hz);
  due_ = (now - due_ < period ? due_ : now) + period;
}

}  // namespace dssm::daemon
