// SPDX-License-Identifier: Apache-2.0
//
// Which sample of a subscription comes next, and how many never will: what a receiver asks for when
// its connection is back, and what it accepts. For mirrors and for PConnector's subscriptions.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>

#include "network.pb.h"

namespace dssm::channel {

// Greater tids do not exist: they come from a program that wrote invalid values into a ring. Far
// enough from the greatest number to add to them.
inline constexpr Tid kMaxTid = Tid{1} << 62;

// A value; one thread. After an error it is as before.
class SampleCursor {
 public:
  // The tid of the next sample; kNoTid: not known, it is where the owner begins.
  Tid next() const noexcept { return next_; }
  // Samples that this receiver will never get.
  std::uint64_t lost() const noexcept { return lost_; }

  // Continues with that sample, of the ring that the receiver follows now. kNoTid: with whichever
  // comes first.
  void set_next(Tid next) noexcept { next_ = next; }
  // Whether the owner leaves samples out to keep to a rate: then only what it reports is lost.
  void set_thinned(bool thinned) noexcept { is_thinned_ = thinned; }

  // The request that continues with next(), a tid of that ring, else from the oldest sample on.
  void resume(std::uint64_t incarnation, net::Subscribe& out) const;

  // The owner begins with sample `first`; what it left out is lost.
  //   fails  protocol: it has come already, or is no tid
  Result<void> on_subscribed_untrusted(Tid first);
  // Whether sample `tid` may come now. If not: unexpected().
  bool accepts(Tid tid) const noexcept { return tid >= next_ && tid <= kMaxTid; }
  Error unexpected(Tid tid) const;
  // Sample `tid`, which it accepts, has come; those before it are lost.
  void on_sample(Tid tid) noexcept {
    if (!is_thinned_) lost_ += static_cast<std::uint64_t>(tid - next_);
    next_ = tid + 1;
  }
  // The owner's ring no longer has these.
  //   fails  protocol: they have come already, or are no tids
  Result<void> on_gap_untrusted(Tid first, std::uint64_t count);

 private:
  Tid next_ = kNoTid;
  bool is_thinned_ = false;
  std::uint64_t lost_ = 0;
};

}  // namespace dssm::channel
