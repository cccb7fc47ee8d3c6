// SPDX-License-Identifier: Apache-2.0
//
// With which sample a remote writer goes on after its connection broke, so that each is written
// once. Mostly the owner knows. When its dssmd was restarted it has forgotten, and its ring may
// hold more of our samples than it could still tell us. But we know of one sample of ours which of
// theirs it became, and our ring knows it when we are restarted too: those that follow it there are
// read and compared with our next ones, by their stamps. Samples of other publishers in between are
// passed over.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <optional>

#include "core/ring/ring_reader.hpp"
#include "daemon/channel/outgoing_ring.hpp"
#include "network.pb.h"

namespace dssm::daemon {

// Each function returns the request to send next; nothing: what is known is in the ring's next().
class PublishingPoint {
 public:
  // So many samples are compared; beyond that the first ones may be written twice.
  static constexpr Tid kMostCompared = 4096;
  using Request = std::optional<net::Frame>;

  // The ring outlives it.
  explicit PublishingPoint(OutgoingRing& ring) : ring_(ring), reader_(ring.mapping()) {}

  // Nothing of the ring was sent yet; otherwise, of a ring that a program kept, it may have been.
  void begin() noexcept { started_ = false; }

  net::Frame start() const;  // StartPublishing
  Result<Request> on_publishing_untrusted(const net::Publishing& publishing);
  Result<Request> on_range_untrusted(const net::Range& range);
  Result<Request> on_sample(const SampleInfo& theirs);
  Result<Request> on_no_sample();

  // While publishing: what the owner has written by now.
  //   fails  protocol: that was not sent
  Result<void> on_published_untrusted(const net::Published& published);

 private:
  Request compare_next();
  Result<void> note_untrusted(Tid last, Tid tid);

  OutgoingRing& ring_;
  ring::RingReader reader_;
  Tid compared_ = kNoTid, last_compared_ = kNoTid;
  bool started_ = true;  // samples may have been sent
};

}  // namespace dssm::daemon
