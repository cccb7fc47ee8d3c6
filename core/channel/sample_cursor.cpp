// SPDX-License-Identifier: Apache-2.0
#include "core/channel/sample_cursor.hpp"

#include <fmt/format.h>

#include <algorithm>

namespace dssm::channel {

void SampleCursor::resume(std::uint64_t incarnation, net::Subscribe& out) const {
  if (next_ == kNoTid) return out.set_from_oldest(true);
  out.set_from_tid(next_);
  out.set_incarnation(incarnation);
}

Result<void> SampleCursor::on_subscribed_untrusted(Tid first) {
  if (first < std::max<Tid>(next_, 0) || first > kMaxTid) {
    return Error{Errc::protocol,
                 fmt::format("the owner begins the subscription with sample {}", first)};
  }
  if (next_ != kNoTid && !is_thinned_) lost_ += static_cast<std::uint64_t>(first - next_);
  next_ = first;
  return {};
}

Error SampleCursor::unexpected(Tid tid) const {
  return {Errc::protocol,
          fmt::format("sample {} came instead of sample {} or a later one", tid, next_)};
}

Result<void> SampleCursor::on_gap_untrusted(Tid first, std::uint64_t count) {
  if (first < 0 || first > kMaxTid || count > static_cast<std::uint64_t>(kMaxTid - first)) {
    return Error{
        Errc::protocol,
        fmt::format("the owner reports a gap of {} samples from sample {} on", count, first)};
  }
  const Tid end = first + static_cast<Tid>(count);
  if (end <= next_) {
    return Error{Errc::protocol,
                 fmt::format("the owner reports the samples before {} as lost, but sample {} has "
                             "come already",
                             end, next_ - 1)};
  }
  lost_ += static_cast<std::uint64_t>(end - (is_thinned_ ? std::max(first, next_) : next_));
  next_ = end;
  return {};
}

}  // namespace dssm::channel
