// SPDX-License-Identifier: Apache-2.0
//
// A subscription as its client sees it: which sample is due next, where the bytes of the one that
// is arriving go, what was lost, and where to go on after a cut.
//
// Samples go straight into the memory of who waits for one (set_target), or into a queue while the
// program does something else with the connection (keep), or they stay in the connection's input
// buffer, and behind it in the owner's ring, until somebody asks.
#pragma once

#include <cstddef>
#include <dssm/pconnector.hpp>
#include <dssm/result.hpp>
#include <optional>

#include "client/src/sample_queue.hpp"
#include "network.pb.h"

namespace dssm::detail {

// A value; one thread.
class Subscriber {
 public:
  explicit Subscriber(std::size_t payload_bytes);

  // A subscription as the user asked for it; what is left of another one is forgotten.
  void begin(const Subscription& what);
  void end();
  bool active() const noexcept { return what_.has_value(); }
  bool granted() const noexcept { return resumes_; }  // on_subscribed() came since begin()

  // The request that begins it, or after a cut goes on with it.
  void to_message(std::uint64_t incarnation, net::Subscribe& out) const;

  // --- what the connection brings

  // From here on samples are this subscription's.
  Result<void> on_subscribed(const net::Subscribed& message);
  void on_gap(const net::Gap& message) noexcept;
  // The owner's ring was replaced; comes before on_subscribed().
  void on_restart() noexcept;
  // The connection is gone, and with it what had come of a sample.
  void on_down() noexcept;

  // A sample begins: where it goes (nullptr: nowhere), or false: it has to wait.
  Result<bool> on_sample_begin(const SampleInfo& info, std::byte*& out);
  void on_sample_end(const SampleInfo& info, bool torn) noexcept;

  // --- what the user gets

  // Whether samples that nobody waits for are kept in the queue.
  void keep(bool keep) noexcept { keep_ = keep; }
  // Where the next sample goes: all of its payload's bytes; nullptr: nowhere.
  void set_target(std::byte* target) noexcept { target_ = target; }
  // Whether a sample came into the target; once.
  bool taken(SampleInfo& info) noexcept;
  // Whether one has begun to.
  bool is_filling_target() const noexcept { return arriving_ == Arriving::in_target; }
  // Where the one that fills the target shall go on, because the target is needed back.
  std::byte* leave_target();

  bool has_kept() const noexcept { return !queue_.empty() || must_tell_restart(); }
  // From what was kept: a sample, or the news that the ring was replaced.
  std::optional<ReadStatus> take_kept(std::span<std::byte> payload, SampleInfo& info) noexcept;

  std::uint64_t lost() const noexcept { return lost_ + queue_.dropped(); }
  // Copied out of the queue.
  std::uint64_t copied_bytes() const noexcept { return copied_bytes_; }

 private:
  enum class Arriving : unsigned char { nothing, in_target, in_queue, nowhere };

  bool must_tell_restart() const noexcept { return restart_at_ && *restart_at_ <= queue_.gone(); }
  bool is_thinned() const noexcept { return what_ && what_->max_rate_hz > 0; }

  std::optional<Subscription> what_;
  bool live_ = false;     // this connection brings it
  bool resumes_ = false;  // some connection did
  Tid due_ = 0;           // tid of the next sample
  std::uint64_t lost_ = 0, copied_bytes_ = 0;

  bool keep_ = false;
  std::byte* target_ = nullptr;
  std::optional<SampleInfo> taken_;
  Arriving arriving_ = Arriving::nothing;
  SampleQueue queue_;
  std::optional<std::uint64_t> restart_at_;  // to be told when so many are gone from the queue
};

}  // namespace dssm::detail
