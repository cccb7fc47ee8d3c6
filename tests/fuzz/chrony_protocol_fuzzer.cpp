// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary datagrams as answers of chronyd, and what the estimator of this PC's clock makes of
// them, one a second: a reading within the limits or none, and no number overflows. An input is a
// list of records: 1 byte that says what happens to the clocks until the answer, and a datagram of
// the length of a report. The last one may be shorter.
#include <algorithm>
#include <cstdlib>

#include "core/base/text.hpp"
#include "daemon/clock/chrony_protocol.hpp"
#include "tests/fuzz/fuzzer.hpp"

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

void require(bool holds) {
  if (!holds) std::abort();
}

// The clocks of a PC, and what it knows of them.
struct Pc {
  clock::Instant now{MonoTime(1000s), time_from_ns(1'795'323'570'000'000'000), 1us, RawTime(1000s)};
  clock::ClockEstimator estimator{{}};

  void pass(Duration time) {
    now.mono += time;
    now.wall += time;
    now.raw += time;
  }
  void check() const {
    const ClockSnapshot state = estimator.at(now.mono);
    require(state.bound >= Duration::zero() && estimator.own_bound() >= Duration::zero());
    require(state.age >= Duration::zero() && estimator.corrected() >= Duration::zero());
  }
};

void answer_untrusted(Pc& pc, std::span<const std::byte> datagram) {
  require(!answers_untrusted(datagram.first(std::min<std::size_t>(datagram.size(), 27)), 0));
  static_cast<void>(answers_untrusted(datagram, 0));
  const Result<TrackingReply> reply = tracking_untrusted(datagram);
  if (!reply) {
    const Error& error = reply.error();
    require(error.code == Errc::protocol || error.code == Errc::no_permission ||
            error.code == Errc::system);
    require(is_utf8(error.message));
    return;
  }
  const MonoTime asked = pc.now.mono;
  pc.pass(1ms);
  static_cast<void>(pc.estimator.observe(pc.now));
  static_cast<void>(pc.estimator.take_untrusted(reply->tracking, asked, pc.now));
  // This chronyd follows the reference PC, or gives time to the others.
  pc.estimator.on_reference(
      clock::ReferenceReport{reply->tracking.reference_id, reply->tracking.root}, pc.now.mono);
}

// Longer than any PC runs, and shorter than the 292 years that nanoseconds count.
constexpr MonoTime kLastInstant{std::chrono::hours(24 * 365 * 100)};

void run(std::span<const std::uint8_t> input) {
  Pc pc;
  while (!input.empty() && pc.now.mono < kLastInstant) {
    const unsigned event = input[0];
    input = input.subspan(1);
    const auto datagram = std::as_bytes(input.first(std::min(input.size(), kTrackingBytes)));
    input = input.subspan(datagram.size());
    pc.pass(1s);
    if (event & 1) pc.now.wall += std::chrono::milliseconds(event) - 100ms;
    if (event & 2) pc.estimator.on_source_step();
    if (event & 4) pc.estimator.on_source_correction(std::chrono::microseconds(event * event));
    if (event & 8) pc.estimator.on_no_chronyd();
    if (event & 16) pc.estimator.on_reference({}, pc.now.mono);
    if (event & 32) pc.pass(std::chrono::hours(24 * 365));
    static_cast<void>(pc.estimator.observe(pc.now));
    pc.check();
    answer_untrusted(pc, datagram);
    pc.check();
  }
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::daemon::run(input); }
