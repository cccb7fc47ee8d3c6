// SPDX-License-Identifier: Apache-2.0
//
// The memory side of a mirror. MirrorRing is the ring while it is being filled: it takes the
// owner's samples. MirrorClock knows what the times of these samples are worth. Neither knows the
// connection.
//
// Promises to the ring's readers: the window has no holes but one, which is filled (ring-layout.md
// "Hole"), a sample is visible once it is complete, and one that was not complete (torn, cut off)
// never is.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "core/channel/channel_client.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/clock_assessment.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/slot_writer.hpp"
#include "core/wire/clock_report.hpp"
#include "core/wire/frame_decoder.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/fleet/clock_assessor.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

// The only writer of its ring, so it takes no lock, and a slot may stay half filled for as long as
// the network takes.
class MirrorRing {
 public:
  // Continues after what `stream`, a mirror's ring, holds, and repairs what a dssmd left that died
  // while it filled the ring. The budget outlives it.
  static Result<std::unique_ptr<MirrorRing>> open(std::shared_ptr<Stream> stream,
                                                  MemoryBudget& budget);
  MirrorRing(const MirrorRing&) = delete;
  MirrorRing& operator=(const MirrorRing&) = delete;

  const std::shared_ptr<Stream>& stream() const noexcept { return stream_; }

  // The request for the samples of the hole from the first one that is missing, also for those in
  // it that are here, and for those that follow on the newest one; for all, if the owner never sent
  // where this ring begins. The newest first.
  //   newest_first  the owner has that feature; else what is missing in the hole will never come
  //   with_history  false: only for the newest sample and those that follow. Those before are in
  //                 the hole until resume() asks for them. Without newest_first always true
  void resume(bool newest_first, bool with_history, net::Subscribe& out);
  // The owner will not send what is missing in the hole: it counts as lost.
  void end_filling() noexcept;

  // As in SampleCursor.
  Result<void> on_subscribed_untrusted(Tid first, bool newest_first, Tid oldest);
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count);
  // Where the payload of this sample goes, until end() or another begin_untrusted().
  //   fails  protocol: its tid may not come now
  Result<std::byte*> begin_untrusted(const wire::IncomingSample& sample);
  // The payload is in place. Of the samples between the newest one and it, those that were reported
  // as lost are marked so, and the others become the hole. Without newest_first, the samples before
  // such a gap leave the ring, as in the owner's.
  void end(const wire::IncomingSample& sample, bool torn);
  // How this PC's readers may use the samples' times.
  void set_clock(const ring::ClockAssessment& assessment) noexcept {
    mapping_->header().clock.store(assessment);
  }
  // Wakes readers when a sample has come since the last call.
  void wake() noexcept;

  Tid newest() const noexcept { return slots_.newest(); }
  Time newest_time() const noexcept;  // of that sample; 0: none
  std::uint64_t gap_samples() const noexcept { return cursor_.lost() + lost_late_; }
  // The length of the hole, as far as it is in the window.
  std::uint64_t filling_samples() const noexcept;
  // What was written in the last 3 s before the newest sample, at most kMaxRecent of them.
  struct Recent {
    std::uint64_t samples = 0, lost = 0;
  };
  Recent recent() const noexcept;
  static constexpr Tid kMaxRecent = 10'000;
  // Ranges of lost samples after the newest one here; with one more, what is between also counts as
  // lost.
  static constexpr std::size_t kMaxLostAhead = 64;
  std::uint64_t received_samples() const noexcept { return received_samples_; }
  std::uint64_t received_bytes() const noexcept { return received_bytes_; }

 private:
  MirrorRing(std::shared_ptr<Stream> stream, std::shared_ptr<const ring::RingMapping> mapping,
             std::shared_ptr<ring::Bell> bell, MemoryBudget& budget);
  bool would_overwrite_window(Tid tid) const noexcept;
  Tid depth() const noexcept;
  // Of the window, when `newest` is the newest sample.
  Tid oldest_beside(Tid newest) const noexcept { return newest - depth() + 2; }
  bool is_missing(Tid tid) const noexcept;
  Tid first_missing(Tid from) const noexcept;
  std::byte* begin_late(const wire::IncomingSample& sample) noexcept;
  void lose_late(ring::TidRange range) noexcept;
  std::uint64_t count_missing(ring::TidRange range) const noexcept;
  void lose_ahead(ring::TidRange range);
  void count_what_leaves(Tid tid) noexcept;
  void publish_after_gap(const SampleInfo& info) noexcept;
  void count_what_is_passed_over(ring::TidRange range) noexcept;
  void allocate_aside(std::size_t bytes);
  void drop_aside() noexcept;

  std::shared_ptr<Stream> stream_;
  std::shared_ptr<const ring::RingMapping> mapping_;  // read-write
  std::shared_ptr<ring::Bell> bell_;
  MemoryBudget& budget_;
  ring::SlotWriter slots_;
  ring::RingReader reader_;
  channel::SampleCursor cursor_;
  bool newest_first_ = false;  // the owner sends so
  bool with_history_ = true;   // the present request
  Tid wanted_from_ = 0;        // earlier ones do not count as lost: not asked for
  Tid has_place_from_ = 0;     // beside the newest one that the owner named last
  Tid begins_at_ = 0;          // an empty ring: earlier ones were never asked for
  Tid backlog_from_ = 0;       // earlier ones are history, written before it was filled
  std::vector<ring::TidRange> lost_ahead_;  // of those after the newest one here; rising
  bool is_dropped_ = false;             // the sample in the hole that arrives, which is not missing
  bool late_pending_ = false;           // the hole has become smaller since the last wake()
  bool wake_pending_ = false;           // sleeping readers are still to be woken
  std::unique_ptr<std::byte[]> aside_;  // the payload under way, when it must not go to its slot
  MemoryShare aside_share_;
  std::uint64_t lost_late_ = 0;  // of what newer samples were sent before
  std::uint64_t received_samples_ = 0, received_bytes_ = 0;
};

// What the times in one mirror are worth, from what its owner reported of its clock, and when.
// Knows which samples are suspect: those that arrived while the owner's clock was not known, and
// those stamped against another reference than the present one. And those that arrive just after
// the owner's clock was slewed anew: their clock errors are by what chronyd stated before that.
class MirrorClock {
 public:
  using Report = std::shared_ptr<const wire::ClockReport>;

  // assessor: nullptr: all times are good. Both outlive it.
  MirrorClock(const ClockAssessor* assessor, const StreamId& id) noexcept
      : assessor_(assessor), id_(id) {}

  // chronyd's usual corrections are less.
  static constexpr Duration kSlewed = std::chrono::microseconds(100);
  // The owner asks chronyd once a second, and samples need some time.
  static constexpr Duration kStaleFor = std::chrono::seconds(3);

  // What the owner says on the stream's channel, with a report.
  struct OnChannel {
    Tid newest = kNoTid;  // in the owner's ring
    bool has_other_clocks = false;
  };

  // The owner's report (nullptr: none), received at `now`, when `newest` was the newest sample
  // here. Reports come on two connections: one that was overtaken by a later one has no effect.
  void on_owner(Report report, Tid newest, MonoTime now,
                const std::optional<OnChannel>& on_channel = std::nullopt);
  // Ends what was suspect for a time; about once a second.
  void on_time(Tid newest, MonoTime now) noexcept;
  // The mirror continues with another ring, whose samples all arrive from now on.
  void on_new_ring() noexcept;

  // Whether the owner has reported. Until then the assessment by the dssmd before this one stays,
  // as long as it is valid: readers of a mirror do not notice that dssmd restarts.
  bool has_report() const noexcept { return has_report_; }

  ring::ClockAssessment assessment() const;
  // Whether the stream may be opened; always, until the owner has reported.
  //   fails  clock_out_of_bounds
  Result<void> check_opening() const;
  // Why its times are not good; empty: they are.
  std::string reason() const;
  // Whether reads by time refuse such samples.
  bool refuses() const { return assessment().policy == ClockPolicy::enforce; }

 private:
  Error refusal() const;
  // Of a clock that was set back: which samples are of that setting.
  struct Settled {
    std::int64_t setting = 0;
    Time from;
    Tid first_tid = 0;

    bool is_of(const wire::ClockReport& report) const noexcept {
      return setting == report.setting && from == report.settled_from;
    }
  };

  ring::ClockAssessment assess(bool by_measurement) const;
  bool is_suspect_now() const noexcept { return suspect_last_ == INT64_MAX; }
  bool is_stale(MonoTime now) const noexcept { return slewed_at_ && now - *slewed_at_ < kStaleFor; }

  const ClockAssessor* assessor_;
  const StreamId& id_;
  Report report_;
  bool has_report_ = false;
  std::optional<MonoTime> slewed_at_;
  Tid suspect_first_ = 0, suspect_last_ = kNoTid;
  std::optional<Settled> settled_;
  std::optional<bool> has_other_clocks_;  // nothing: not known yet
  std::string boot_id_;                   // of the owner
  Tid boot_first_ = 0;                    // earlier samples were stamped in another boot
};

}  // namespace dssm::daemon
