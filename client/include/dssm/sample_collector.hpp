// SPDX-License-Identifier: Apache-2.0
//
// SampleCollector: the samples of another PC's stream, collected in this process. A thread receives
// the subscription of a PConnector into a ring, and the program reads them there, by tid and by
// time, without the network. For a process without a dssmd on its own PC; where one runs, a Session
// does the same with one copy for all programs of the PC.
//
//   threads     any thread may call the const functions at any time, also from a signal handler
//   cost        a read takes no lock and makes no system call, like a read of a stream of this PC;
//               the thread copies each sample once more than PConnector::read_next()
//   memory      about depth * (payload_bytes + 160), taken from the system by start()
//   connection  when it breaks, the thread reconnects until it succeeds and continues with the next
//               tid. What the owner's ring no longer holds by then is lost: of what was collected,
//               only the samples after such a gap stay readable
//   restart     when the owner's ring was replaced by a new one, whose tids start at 0 again, tids
//               here keep rising: the new ring's tid 0 gets the tid after the newest one here. No
//               read returns `restarted`
//   waiting     not here: a program that waits for each sample calls PConnector::read_next()
//   fork        a forked child may read what its parent collects. Its copy of the object does not
//               stop the thread, which runs in the parent only
//   moved       a moved-from object may only be assigned to or destroyed
#pragma once

#include <cstddef>
#include <dssm/pconnector.hpp>
#include <functional>
#include <memory>
#include <span>

namespace dssm::detail {
struct SampleCollectorState;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

struct SampleCollectorOptions {
  // Slots of the ring, which holds one sample less; 0: as many as the owner's ring has.
  std::uint64_t depth = 0;
  // Called in the collector's thread when receiving fails, and not again before it has succeeded.
  // The thread tries again by itself. It must not throw, nor destroy the collector.
  std::function<void(const Error&)> on_error = {};
};

class SampleCollector {
 public:
  // Subscribes, takes over `connector` and begins to collect.
  //   fails  as PConnector::subscribe(); invalid_argument (depth), no_memory, system
  static Result<SampleCollector> start(PConnector connector, const Subscription& what,
                                       SampleCollectorOptions options = {});

  SampleCollector(SampleCollector&&) noexcept;
  SampleCollector& operator=(SampleCollector&&) noexcept;
  ~SampleCollector();  // ends the thread

  // --- reading

  // `payload` is exactly payload_bytes() long, another length ends the program. Its first
  // info.payload_bytes are the sample; the rest, and all of it unless the result is ok, is
  // unspecified. `info` is set only when the result is ok.

  // Copies the newest sample.
  //   returns  ok | not_yet (nothing has arrived) | lapped
  ReadStatus read_newest(std::span<std::byte> payload, SampleInfo& info) const noexcept;
  // Copies sample number `tid`.
  //   returns  ok | not_yet (tid > newest_tid()) | too_old (tid < oldest_tid())
  ReadStatus read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) const noexcept;
  // Copies the newest sample with time <= `t`.
  //   max_age  >= 0: of the sample at `t`, which is t - info.time
  //   returns  ok | not_yet (nothing has arrived) | too_old (all samples are later) | lapped |
  //            stale (the sample is older than `max_age`)
  ReadStatus read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                     Duration max_age = kAnyAge) const noexcept;
  // Copies the newest sample if its tid is above `than`.
  //   returns  ok | not_yet | lapped
  ReadStatus read_newer(Tid than, std::span<std::byte> payload, SampleInfo& info) const noexcept;

  // The tids of the newest and of the oldest readable sample; kNoTid while nothing has arrived.
  Tid newest_tid() const noexcept;
  Tid oldest_tid() const noexcept;
  // Tid of the newest sample with time <= t; kNoTid when there is none.
  Tid find(Time t) const noexcept;

  // As PConnector's functions of these names.
  std::uint64_t lost_samples() const noexcept;
  std::uint64_t restarts() const noexcept;

  // --- about the stream and the ring

  const StreamId& id() const noexcept;  // with its owner's host
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;  // of the ring here

 private:
  explicit SampleCollector(std::unique_ptr<detail::SampleCollectorState> state) noexcept;
  std::unique_ptr<detail::SampleCollectorState> state_;
};

}  // namespace dssm
#pragma GCC visibility pop
