// SPDX-License-Identifier: Apache-2.0
#include "daemon/link/sample_pump.hpp"

#include <fmt/format.h>

#include <algorithm>

namespace dssm::daemon {
namespace {

Duration period_of(double rate_hz) {
  constexpr double kMaxNs = 1e18;  // some 30 years
  return Duration(static_cast<std::int64_t>(std::min(1e9 / rate_hz, kMaxNs)));
}

}  // namespace

[[gnu::hot]] Tid newest_untrusted(const ring::RingReader& reader) noexcept {
  const Tid newest = reader.newest();
  return newest <= channel::kMaxTid ? newest : kNoTid;
}

SamplePump::SamplePump(const ring::RingMapping& mapping, FrameConnection& connection,
                       SampleSender& sender, Observer& observer, const Plan& plan)
    : reader_(mapping),
      payload_bytes_(mapping.geometry().payload_bytes),
      connection_(connection),
      sender_(sender),
      observer_(observer),
      plan_(plan),
      next_(std::clamp<Tid>(plan.first, 0, channel::kMaxTid)),
      last_(channel::kMaxTid) {}

[[gnu::hot]] Result<PumpWait> SamplePump::pump(MonoTime now, bool only_under_way) {
  std::size_t bytes = 0;
  for (int samples = 0; samples < kSamplesPerTurn && bytes < kBytesPerTurn;) {
    SendStatus status = SendStatus::sent;
    Tid sent_up_to = next_ + 1;
    if (under_way_) {
      status = sender_.go_on();
      bytes += SampleSender::kSliceBytes;
    } else if (only_under_way) {
      break;
    } else {
      const Next next = choose_next(now);
      if (next != Next::ready) sender_.end_run();
      if (next == Next::end) return PumpWait::ended;
      // A frame that reports a gap, for example, may wait for the socket.
      if (!connection_.output_empty()) return PumpWait::output;
      if (next == Next::wait_for_sample) return PumpWait::sample;
      if (next == Next::wait_for_time) return PumpWait::time;
      const Tid newest = std::min(newest_untrusted(reader_), last_);
      observer_.before_samples();
      if (!connection_.output_empty()) return PumpWait::output;
      if (sender_.sends_in_place()) {
        sent_up_to = next_ + 1;
        status = sender_.send(next_, 0, next_ < newest);
        bytes += std::min(payload_bytes_, SampleSender::kSliceBytes);
      } else {
        // The writer continues meanwhile: the newest sample may not be the newest any more.
        const Tid at_most = next_ + (thins() ? 1 : kSamplesPerTurn - samples) - 1;
        status = sender_.send_many(next_, std::min(newest, at_most), sent_up_to);
        bytes += static_cast<std::size_t>(sent_up_to - next_) * payload_bytes_;
      }
    }
    under_way_ = sender_.busy();
    switch (status) {
      case SendStatus::sent:
        samples += static_cast<int>(sent_up_to - next_);
        next_ = sent_up_to;
        after_sample(now);
        break;
      case SendStatus::torn:  // it is outside of the window now: choose_next() reports the gap
        ++samples;
        break;
      case SendStatus::not_in_ring:
        // Overwritten since choose_next(), or the slot holds invalid values.
        ++samples;
        if (!thins() && next_ >= reader_.oldest()) lose_up_to(next_ + 1);
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

void SamplePump::lose_up_to(Tid next) {
  const auto count = static_cast<std::uint64_t>(next - next_);
  lost_ += count;
  sender_.end_run();
  observer_.on_gap(next_, count);
  next_ = next;
}

void SamplePump::after_sample(MonoTime now) {
  if (!thins()) return;
  // From when it was due, so that the rate holds on the whole although timers come late.
  const Duration period = period_of(plan_.max_rate_hz);
  due_ = (now - due_ < period ? due_ : now) + period;
}

}  // namespace dssm::daemon
