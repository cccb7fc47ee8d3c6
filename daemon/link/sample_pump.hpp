// SPDX-License-Identifier: Apache-2.0
//
// Sends a ring's samples over a connection from a given one on: each once, in the order of their
// tids, as fast as the connection takes them, until it has caught up; then it waits to be called
// again. Samples that the ring no longer holds when their turn comes are reported as a gap. Knows
// neither subscriptions nor doorbells: StreamChannel and RemoteWriter use it at the two ends of a
// channel.
//
// With Plan::newest_first, a receiver that shows what is now does not wait for what was: samples
// that wait for long are passed over, and sent when no newer ones wait, the newest of them first.
// Small ones that are no history go in their order, for those who read each of them, and newer
// small ones wait until the turn is over. When the network carries fewer samples than are written,
// what was passed over would never be sent: it is reported as lost after some seconds, or when the
// ring will soon hold it no more.
//
// Work is cut into turns of about kBytesPerTurn or kSamplesPerTurn.
#pragma once

#include <cstddef>
#include <cstdint>
#include <deque>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>

#include "core/channel/channel_client.hpp"
#include "core/ring/ring_reader.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/link/sample_sender.hpp"

namespace dssm::daemon {

// The newest sample that may be sent; kNoTid: none.
Tid newest_untrusted(const ring::RingReader& reader) noexcept;

// What has to happen before pump() has something to do.
enum class PumpWait : std::uint8_t {
  sample,  // a sample newer than known()
  output,  // on_output_empty() of the connection
  pace,    // a sample newer than known(), or due(): history has its pace
  turn,    // the next turn, after others had theirs
  time,    // due() comes
  ended,   // nothing: it has ended
};

// The mapping, connection, sender and observer outlive it. pump() may call the observer and send on
// the connection.
class SamplePump {
 public:
  // With newest_first: so much is sent in the order of their tids all the same, and at least one
  // sample; more when the network carries more in that time. Of small samples all, when the kernel
  // has sent everything: then hundreds wait because this PC is busy, and not for the network.
  static constexpr std::size_t kInOrderBytes = 64U << 10;
  // Of what was there when the subscription began only so much, or what the network carries in
  // kInOrderFor: as many at 1 MB/s.
  static constexpr std::size_t kOldInOrderBytes = 4U << 10;
  static constexpr Duration kInOrderFor = std::chrono::milliseconds(4);
  static constexpr Duration kSmallInOrderFor = std::chrono::milliseconds(20);
  static constexpr std::size_t kHeaderBytes = 32;  // of a sample's frame, about
  // So much waits in the kernel, where nothing newer can take its place; less when the network
  // needs longer than that for it. Half as much made sending slower on a fast link. On a busy PC it
  // has to last until dssmd runs again: twice as much each time that nothing was left by then.
  static constexpr std::size_t kUnsentBytes = 128U << 10, kMinUnsentBytes = 16U << 10;
  static constexpr std::size_t kMostUnsentBytes = 4U << 20;
  static constexpr double kMostUnsentFactor = 256;
  static constexpr Duration kUnsentFor = std::chrono::milliseconds(2);
  // When samples were passed over for so long and so often, and more of them wait than before, the
  // network carries less than is written. Once may be a pause of the network.
  static constexpr Duration kOverloadedAfter = std::chrono::seconds(3);
  static constexpr int kOverloadedSamples = 4;
  // What the ring still holds for that long, and was written within kSparedFor, may come later: a
  // PC may be busy only for some seconds.
  static constexpr Duration kKeptFor = std::chrono::seconds(5);
  static constexpr Duration kSparedFor = std::chrono::seconds(30);
  // Ranges of what was passed over. When there are more, what is between the newest two comes
  // again.
  static constexpr std::size_t kMaxPassedOver = 4096;
  static constexpr int kSamplesPerTurn = 1024;
  static constexpr std::size_t kBytesPerTurn = 1U << 20;

  class Observer {
   public:
    // Samples [first, first + count) are lost. Frames may be sent on the connection.
    virtual void on_gap(Tid first, std::uint64_t count) = 0;
    // Samples that are in the ring now may be sent next. Frames may be sent on the connection.
    virtual void before_samples() {}
    // All samples up to Plan::caught_up_at were sent or lost.
    virtual void on_caught_up() {}
    // After end_at(): all samples up to that one were sent or lost.
    virtual void on_end() {}

   protected:
    ~Observer() = default;
  };

  struct Plan {
    Tid first = 0;  // >= 0; may lie before what the ring holds (a gap), or in the future
    Tid caught_up_at = kNoTid;
    // > 0: at most so many samples per second: the newest one at each time. What is left out is no
    // gap; with newest_first it is lost, but history, up to caught_up_at, comes as without a rate.
    // Above 1000 the loop's timers, which count milliseconds, make it less when samples come faster
    // than that.
    double max_rate_hz = 0;
    bool newest_first = false;
    // With newest_first: none of these is sent, the receiver has them.
    ring::TidRange held = {};
    // With newest_first: samples before this one are history. kNoTid: all that the ring holds now.
    Tid backlog_from = kNoTid;
  };

  SamplePump(const ring::RingMapping& mapping, FrameConnection& connection, SampleSender& sender,
             Observer& observer, const Plan& plan);
  SamplePump(const SamplePump&) = delete;
  SamplePump& operator=(const SamplePump&) = delete;

  // Whether it leaves samples out, to keep to a rate.
  bool thins() const noexcept { return plan_.max_rate_hz > 0; }

  // Sends one turn's samples. now: only for rates and with newest_first. The sender must not be
  // busy with the sample of another user.
  //   only_under_way  begins no other sample: another user wants to send in between
  //   fails           limit_exceeded (the peer's memory is used up, and it does not know "torn")
  Result<PumpWait> pump(MonoTime now, bool only_under_way = false);

  // No sample after `last` is sent.
  void end_at(Tid last) noexcept { last_ = last; }

  // The newest sample that was sent or lost; PumpWait::sample waits for a newer one.
  Tid known() const noexcept { return next_ - 1; }
  MonoTime due() const noexcept { return wake_at_; }
  std::uint64_t lost() const noexcept { return lost_; }

 private:
  enum class Next : std::uint8_t { ready, wait_for_sample, wait_for_time, end };
  Next choose_next(MonoTime now);
  Next choose_newest_first(MonoTime now);
  // Whether a newer sample may take the place of one that is not sent yet.
  bool decides_late() const noexcept { return plan_.newest_first || thins(); }
  // The sample that is sent, or is to be sent next.
  Tid& chosen() noexcept { return fills_ ? back_fill_.begin : next_; }
  SampleSender::SliceLimits limits_now(MonoTime now);
  // The history of small samples is small, and those who read them in order wait for it.
  bool has_pace() const noexcept { return sender_.sends_in_place(); }
  PumpWait wait_for_pace() noexcept;
  bool has_due_sample(MonoTime now, Tid newest) const noexcept;
  Tid last_of_run() const noexcept;
  Tid first_within(std::size_t bytes, ring::TidRange range) const noexcept;
  bool takes_long(ring::TidRange samples) const noexcept;
  void pass_over(Tid next, MonoTime now);
  void choose_back_fill();
  void return_back_fill();
  void leave_out(Tid newest);
  void give_up_what_is_never_carried(MonoTime now);
  bool is_spared(Tid first, MonoTime now) const noexcept;
  void fit_unsent_limit();
  void limit_unsent(const std::optional<wire::Progress>& progress);
  void lose_passed_over(Tid before);
  void lose_up_to(Tid next);
  void lose(ring::TidRange range);
  void after_sample(MonoTime now);

  ring::RingReader reader_;
  std::size_t payload_bytes_;
  Tid depth_;
  FrameConnection& connection_;
  SampleSender& sender_;
  Observer& observer_;
  Plan plan_;
  Tid next_;
  Tid last_;
  std::deque<ring::TidRange> passed_over_;  // and not sent yet; rising
  ring::TidRange back_fill_;                // taken from these: what is sent next
  bool fills_ = false;  // the sample that is sent is the first one of back_fill_
  // Small samples that were passed over were sent in this turn: newer ones wait for the next turn.
  // Sent in between, a few at a time, they would be more packets than all the others.
  bool has_filled_ = false;
  bool has_kept_up_ = false;  // once, no newer sample waited
  // How often samples were passed over since none of them waited, or since they were counted last:
  // when, which, and how many waited.
  int passed_over_since_ = 0;
  MonoTime behind_since_{}, passed_over_at_{};
  bool gives_up_ = false;  // at once, because the network carries less than is written
  Tid behind_from_ = 0, waiting_before_ = 0, next_before_ = 0;
  std::size_t unsent_limit_ = 0;  // of what waits in the kernel
  double unsent_factor_ = 1;      // so much more than usual lasts until dssmd runs again
  bool under_way_ = false;        // the sender is busy with it
  bool caught_up_ = false;
  MonoTime due_{};  // the next sample, with a rate
  MonoTime wake_at_{};
  std::uint64_t lost_ = 0;
};

}  // namespace dssm::daemon
