// SPDX-License-Identifier: Apache-2.0
#include "daemon/channel/publishing_point.hpp"

#include <algorithm>
#include <string>
#include <utility>

#include "daemon/channel/owner_stream.hpp"
#include "daemon/channel/sample_pump.hpp"

namespace dssm::daemon {
namespace {

// One after another: a serial is used again once it is answered.
constexpr std::uint64_t kSerial = 2;

}  // namespace

net::Frame PublishingPoint::start() const {
  net::Frame frame;
  frame.set_serial(kSerial);
  frame.mutable_start_publishing()->set_publisher(ring_.publisher());
  return frame;
}

Result<PublishingPoint::Request> PublishingPoint::on_publishing_untrusted(
    const net::Publishing& publishing) {
  const bool same_ring = ring_.owner_incarnation_untrusted() == publishing.incarnation();
  if (!same_ring) ring_.set_owner(publishing.incarnation(), kNoTid);
  const bool sent_before = std::exchange(started_, true);
  // It may know less than we do: when it has forgotten us, or has done so once before.
  if (publishing.last() >= ring_.next_untrusted() - 1 && publishing.last() >= 0) {
    if (Result<void> noted = note_untrusted(publishing.last(), publishing.last_tid()); !noted) {
      return std::move(noted).error();
    }
    return Request();
  }
  if (!same_ring || !sent_before || ring_.all_published()) return Request();
  net::Frame frame;
  frame.set_serial(kSerial);
  frame.mutable_get_range();
  return Request(std::move(frame));
}

Result<PublishingPoint::Request> PublishingPoint::on_range_untrusted(const net::Range& range) {
  if (range.newest() > kLastTid) {
    return Error{Errc::protocol,
                 "its newest sample is said to be " + std::to_string(range.newest())};
  }
  compared_ = ring_.owner_tid_untrusted();
  last_compared_ = std::min(range.newest(), compared_ + kMostCompared);
  return compare_next();
}

PublishingPoint::Request PublishingPoint::compare_next() {
  if (compared_ >= last_compared_ || ring_.all_published()) return {};
  net::Frame frame;
  frame.set_serial(kSerial);
  frame.mutable_read()->set_tid(compared_ + 1);
  return frame;
}

Result<PublishingPoint::Request> PublishingPoint::on_sample(const SampleInfo& theirs) {
  if (theirs.tid != compared_ + 1) return untimely("a sample");
  SampleInfo own;
  const Tid next = ring_.next_untrusted();
  if (reader_.stamp(next, own) == ReadStatus::ok && own.time == theirs.time &&
      own.clock_error == theirs.clock_error) {
    ring_.set_next(next + 1);
    ring_.set_owner_tid(theirs.tid);
  }
  return on_no_sample();
}

Result<PublishingPoint::Request> PublishingPoint::on_no_sample() {
  ++compared_;
  return compare_next();
}

Result<void> PublishingPoint::on_published_untrusted(const net::Published& published) {
  return note_untrusted(published.last(), published.last_tid());
}

// Our sample `last` is theirs `tid`.
Result<void> PublishingPoint::note_untrusted(Tid last, Tid tid) {
  const Tid next = ring_.next_untrusted(), newest = ring_.newest_untrusted();
  if (last < next - 1 || last > newest || tid < 0 || tid > kLastTid) {
    return Error{Errc::protocol, "it says that our sample " + std::to_string(last) +
                                     " became its sample " + std::to_string(tid) +
                                     ", and ours to be published are " + std::to_string(next) +
                                     " to " + std::to_string(newest)};
  }
  ring_.set_next(last + 1);
  ring_.set_owner_tid(tid);
  return {};
}

}  // namespace dssm::daemon
