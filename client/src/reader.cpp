// SPDX-License-Identifier: Apache-2.0
//
// RawReader on top of ring::RingReader: cursor, counting of losses, waiting.
#include <algorithm>
#include <array>
#include <dssm/reader.hpp>

#include "client/src/client.hpp"
#include "client/src/states.hpp"
#include "core/base/check.hpp"
#include "core/clock/coarse_now.hpp"

namespace dssm {
namespace {

// Waits until ready() or the deadline: look, announce, look again, sleep. An interruption is
// reported only when there is nothing to report otherwise.
template <class Ready>
WaitStatus wait_until(ring::Bell& bell, MonoTime deadline, Ready ready) noexcept {
  if (ready()) return WaitStatus::ready;
  if (deadline != kNever && MonoClock::now() >= deadline) return WaitStatus::timeout;
  for (;;) {
    const std::uint32_t announced = bell.announce();
    if (ready()) return WaitStatus::ready;
    const WaitStatus status = bell.sleep(announced, deadline);
    if (ready()) return WaitStatus::ready;
    if (status != WaitStatus::ready) return status;
  }
}

// The closer one of two stamps, the earlier sample when both are equally close. Unsigned, because
// the distance of two int64 may not fit into one.
Tid closer(Time t, const SampleInfo& before, const SampleInfo& after) noexcept {
  const auto distance = [](Time early, Time late) {
    return static_cast<std::uint64_t>(to_ns(late)) - static_cast<std::uint64_t>(to_ns(early));
  };
  return distance(t, after.time) < distance(before.time, t) ? after.tid : before.tid;
}

// Assessments are valid for seconds, so a coarse clock is precise enough.
using clock::coarse_now;

// Whether reads by time must not deliver that sample.
bool is_refused(const ring::ClockAssessment& clock, const SampleInfo& info) noexcept {
  return clock.policy == ClockPolicy::enforce && !clock.is_good(info, coarse_now());
}
bool is_refused(const ring::RingReader& ring, const SampleInfo& info) noexcept {
  return is_refused(ring.clock(), info);
}

// The same by tid; for a read by time, before the sample is copied.
//   returns  ok | too_old | not_yet | clock_out_of_bounds
ReadStatus check_clock(const ring::RingReader& ring, Tid tid) noexcept {
  const ring::ClockAssessment clock = ring.clock();
  if (clock.policy != ClockPolicy::enforce) return ReadStatus::ok;
  SampleInfo info;
  const ReadStatus status = ring.stamp(tid, info);
  if (status != ReadStatus::ok) return status;
  return is_refused(clock, info) ? ReadStatus::clock_out_of_bounds : ReadStatus::ok;
}

}  // namespace

bool BorrowedSample::still_valid() const noexcept {
  return sequence_ &&
         ring::RingReader::still_valid(*sequence_, ring::published_sequence(info_.tid));
}

namespace detail {

bool ReaderState::restart() noexcept {
  const MonoTime now = MonoClock::now();
  Client& client = *stream->client;
  // While dssmd is away nobody can give the new ring, and a read must not wait for it.
  if (to_ns(now.time_since_epoch()) < next_attempt_ns || !client.connected()) return false;
  next_attempt_ns = to_ns((now + kRestartPause).time_since_epoch());
  auto anew = client.open_reader(stream->asked, stream->tag);
  if (!anew) return false;
  if (Result<void> usable = (*anew)->type.check_usable_as(stream->type); !usable) {
    next_attempt_ns = INT64_MAX;
    trouble =
        std::move(usable).error().context("go on with the new ring of '" + (*anew)->id.str() + "'");
    return false;
  }
  if ((*anew)->ring == stream->ring) return false;  // asked too early: try again
  // A mirror that was made anew, because dssmd lost the old one, has the same samples with the same
  // tids: nobody needs to be told.
  const bool same_samples = (*anew)->ring->mapping->identity().incarnation ==
                            stream->ring->mapping->identity().incarnation;
  previous = stream->ring;
  {
    const std::lock_guard guard(stream_mutex);
    stream = *std::move(anew);
  }
  ring = ring::RingReader(*stream->ring->mapping);
  next_attempt_ns = 0;
  if (!same_samples) {
    cursor = kNoTid;  // read_next() goes on with the first sample there; a fresh reader stays so
    ++restarts;
  }
  if (ready) client.notifiers().follow(*ready, {stream->ring, stream->superseded, cursor});
  return !same_samples;
}

std::shared_ptr<OpenStream> ReaderState::stream_now() const {
  const std::lock_guard guard(stream_mutex);
  return stream;
}

bool ReaderState::restart_wakes(const OpenStream& on) const noexcept {
  return on.superseded->load(std::memory_order_acquire) &&
         to_ns(MonoClock::now().time_since_epoch()) >= next_attempt_ns;
}

}  // namespace detail

RawReader::RawReader(std::unique_ptr<detail::ReaderState> state) noexcept
    : state_(std::move(state)) {}
RawReader::RawReader(RawReader&&) noexcept = default;
RawReader& RawReader::operator=(RawReader&&) noexcept = default;
RawReader::~RawReader() = default;

[[gnu::hot]] ReadStatus RawReader::read_newest(std::span<std::byte> payload,
                                               SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  DSSM_CHECK(payload.size() == payload_bytes());
  const ReadStatus status = state_->ring.read_newest(payload, info);
  if (status == ReadStatus::ok) state_->took(info.tid);
  return status;
}

ReadStatus RawReader::read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  DSSM_CHECK(payload.size() == payload_bytes());
  const ReadStatus status = state_->ring.read(tid, payload, info);
  if (status == ReadStatus::ok) state_->took(tid);
  return status;
}

[[gnu::hot]] ReadStatus RawReader::read_next(std::span<std::byte> payload,
                                             SampleInfo& info) noexcept {
  if (state_->fresh) return read_newest(payload, info);
  DSSM_CHECK(payload.size() == payload_bytes());
  Tid wanted = state_->cursor + 1;
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    const ReadStatus status = state_->ring.read(wanted, payload, info);
    if (status == ReadStatus::not_yet) {
      // Only now: what the old ring held is read first.
      return state_->restart_due() && state_->restart() ? ReadStatus::restarted : status;
    }
    if (status == ReadStatus::ok) {
      state_->lost += static_cast<std::uint64_t>(wanted - (state_->cursor + 1));
      state_->took(wanted);
      return status;
    }
    wanted = std::max(wanted, state_->ring.oldest());  // lapped: go on with the oldest there is
  }
  return ReadStatus::lapped;
}

ReadStatus RawReader::read_previous(std::span<std::byte> payload, SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  if (state_->cursor < 0) return ReadStatus::not_yet;
  return read_tid(state_->cursor - 1, payload, info);
}

ReadStatus RawReader::read_at(Time t, std::span<std::byte> payload, SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  DSSM_CHECK(payload.size() == payload_bytes());
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    Tid found = kNoTid;
    const ReadStatus status = state_->ring.find(t, found);
    if (status != ReadStatus::ok) return status;
    const ReadStatus checked = check_clock(state_->ring, found);
    if (checked == ReadStatus::clock_out_of_bounds) return checked;
    if (state_->ring.read(found, payload, info) == ReadStatus::ok) {
      state_->took(found);
      return ReadStatus::ok;
    }
  }
  return ReadStatus::lapped;
}

ReadStatus RawReader::read_at_or_after(Time t, std::span<std::byte> payload,
                                       SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    // Behind the newest sample before `t` all samples have time >= t.
    Tid before = kNoTid;
    const ReadStatus found =
        to_ns(t) == INT64_MIN ? ReadStatus::too_old : state_->ring.find(t - Duration(1), before);
    if (found == ReadStatus::not_yet || found == ReadStatus::lapped) return found;
    const Tid wanted = found == ReadStatus::too_old ? state_->ring.oldest() : before + 1;
    const ReadStatus checked = check_clock(state_->ring, wanted);
    if (checked == ReadStatus::clock_out_of_bounds) return checked;
    const ReadStatus status = read_tid(wanted, payload, info);
    if (status != ReadStatus::too_old) return status;
  }
  return ReadStatus::lapped;
}

ReadStatus RawReader::read_nearest(Time t, std::span<std::byte> payload,
                                   SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    Tid before = kNoTid;
    const ReadStatus found = state_->ring.find(t, before);
    if (found == ReadStatus::not_yet || found == ReadStatus::lapped) return found;
    Tid wanted = before;
    if (found == ReadStatus::too_old) {
      wanted = state_->ring.oldest();
    } else {
      SampleInfo left, right;
      if (state_->ring.stamp(before, left) != ReadStatus::ok) continue;
      if (state_->ring.stamp(before + 1, right) == ReadStatus::ok) wanted = closer(t, left, right);
    }
    const ReadStatus checked = check_clock(state_->ring, wanted);
    if (checked == ReadStatus::clock_out_of_bounds) return checked;
    const ReadStatus status = read_tid(wanted, payload, info);
    if (status != ReadStatus::too_old) return status;
  }
  return ReadStatus::lapped;
}

ReadStatus RawReader::find_neighbours(Time t, Neighbours& out) const noexcept {
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    Tid before = kNoTid;
    const ReadStatus found = state_->ring.find(t, before);
    if (found != ReadStatus::ok) return found;
    Neighbours seen;
    const ReadStatus right = state_->ring.stamp(before + 1, seen.after);
    if (right == ReadStatus::not_yet) return right;
    if (right != ReadStatus::ok) continue;
    if (state_->ring.stamp(before, seen.before) != ReadStatus::ok) continue;
    // A sample that ran backwards may have come between: then it is the newest with time <= t.
    if (seen.after.time <= t) continue;
    if (is_refused(state_->ring, seen.before) || is_refused(state_->ring, seen.after)) {
      return ReadStatus::clock_out_of_bounds;
    }
    out = seen;
    return ReadStatus::ok;
  }
  return ReadStatus::lapped;
}

Duration RawReader::clock_error(const SampleInfo& info) const noexcept {
  return state_->ring.clock().distance(info, coarse_now());
}

bool RawReader::clock_in_bounds(const SampleInfo& info) const noexcept {
  return state_->ring.clock().is_good(info, coarse_now());
}

JointRead read_joint_at(Time t, std::span<JointSample> samples, Duration max_error) noexcept {
  for (const JointSample& sample : samples) {
    detail::ReaderState& state = *sample.reader->state_;
    if (state.restart_due() && state.restart()) {
      return {ReadStatus::restarted, static_cast<std::size_t>(&sample - samples.data()),
              kUnknownClockError};
    }
  }
  JointRead read;
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    read = {ReadStatus::ok, 0, Duration::zero()};
    for (std::size_t i = 0; i < samples.size(); ++i) {
      const RawReader& reader = *samples[i].reader;
      const ReadStatus status = reader.find(t, samples[i].info);
      if (status != ReadStatus::ok) return {status, i, kUnknownClockError};
      const Duration error = reader.clock_error(samples[i].info);
      if (error > read.clock_error) read = {ReadStatus::ok, i, error};
    }
    if (read.clock_error > max_error) read.status = ReadStatus::clock_out_of_bounds;
    for (std::size_t i = 0; i < samples.size() && read.status == ReadStatus::ok; ++i) {
      JointSample& sample = samples[i];
      DSSM_CHECK(sample.payload.size() == sample.reader->payload_bytes());
      const ring::RingReader& ring = sample.reader->state_->ring;
      if (ring.read(sample.info.tid, sample.payload, sample.info) == ReadStatus::ok) continue;
      read = {ReadStatus::lapped, i, kUnknownClockError};
    }
    if (read.status != ReadStatus::lapped) break;
  }
  if (read.status != ReadStatus::ok) return read;
  for (const JointSample& sample : samples) sample.reader->state_->took(sample.info.tid);
  return read;
}

Tid RawReader::newest_tid() const noexcept { return state_->ring.newest(); }
Tid RawReader::oldest_tid() const noexcept { return state_->ring.oldest(); }

ReadStatus RawReader::read_info(Tid tid, SampleInfo& info) const noexcept {
  return state_->ring.stamp(tid, info);
}

ReadStatus RawReader::find(Time t, SampleInfo& info) const noexcept {
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    Tid found = kNoTid;
    const ReadStatus status = state_->ring.find(t, found);
    if (status != ReadStatus::ok) return status;
    SampleInfo seen;
    if (state_->ring.stamp(found, seen) != ReadStatus::ok) continue;
    if (is_refused(state_->ring, seen)) return ReadStatus::clock_out_of_bounds;
    info = seen;
    return ReadStatus::ok;
  }
  return ReadStatus::lapped;
}

Tid RawReader::cursor() const noexcept { return state_->cursor; }

void RawReader::seek(Tid tid) noexcept { state_->took(std::max(tid, kNoTid)); }

std::uint64_t RawReader::lost_samples() const noexcept { return state_->lost; }
std::uint64_t RawReader::restarts() const noexcept { return state_->restarts; }
std::optional<Error> RawReader::restart_error() const { return state_->trouble; }

ReadStatus RawReader::borrow(Tid tid, BorrowedSample& out) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  ring::RingReader::Place place{};
  const ReadStatus status = state_->ring.locate(tid, place, out.info_);
  if (status != ReadStatus::ok) return status;
  out.payload_ = {place.payload, payload_bytes()};
  out.sequence_ = place.sequence;
  state_->took(tid);
  return ReadStatus::ok;
}

[[gnu::hot]] WaitStatus RawReader::wait(MonoTime deadline) noexcept {
  return wait_for_tid(state_->cursor + 1, deadline);
}

[[gnu::hot]] WaitStatus RawReader::wait_for_tid(Tid tid, MonoTime deadline) noexcept {
  const std::shared_ptr<detail::OpenStream> stream = state_->stream_now();
  const ring::RingReader ring(*stream->ring->mapping);
  return wait_until(*stream->ring->bell, deadline,
                    [&] { return ring.newest() >= tid || state_->restart_wakes(*stream); });
}

WaitStatus wait_any(std::span<RawReader* const> readers, MonoTime deadline) noexcept {
  DSSM_CHECK(!readers.empty() && readers.size() <= kMaxWaitAny);
  const auto ready = [&] {
    return std::any_of(readers.begin(), readers.end(), [](const RawReader* reader) {
      return reader->newest_tid() > reader->cursor() ||
             reader->state_->restart_wakes(*reader->state_->stream);
    });
  };
  std::array<ring::Bell*, kMaxWaitAny> bells;
  std::array<std::uint32_t, kMaxWaitAny> announced;
  if (ready()) return WaitStatus::ready;
  if (deadline != kNever && MonoClock::now() >= deadline) return WaitStatus::timeout;
  for (;;) {
    for (std::size_t i = 0; i < readers.size(); ++i) {
      bells[i] = readers[i]->state_->stream->ring->bell.get();
      announced[i] = bells[i]->announce();
    }
    if (ready()) return WaitStatus::ready;
    const WaitStatus status =
        ring::Bell::sleep_any(std::span(bells).first(readers.size()), announced, deadline);
    if (ready()) return WaitStatus::ready;
    if (status != WaitStatus::ready) return status;
  }
}

Result<int> RawReader::ready_fd() noexcept {
  if (!state_->ready) {
    auto ready = state_->stream->client->notifiers().watch(
        {state_->stream->ring, state_->stream->superseded, state_->cursor});
    if (!ready) return std::move(ready).error();
    state_->ready = std::move(*ready);
  }
  return state_->ready->fd();
}

void RawReader::clear_ready() noexcept {
  if (state_->ready) state_->ready->clear();
}

const StreamId& RawReader::id() const noexcept { return state_->stream->id; }
const TypeInfo& RawReader::type() const noexcept { return state_->stream->type; }

std::uint64_t RawReader::payload_bytes() const noexcept {
  return state_->stream->ring->mapping->geometry().payload_bytes;
}
std::uint64_t RawReader::depth() const noexcept {
  return state_->stream->ring->mapping->geometry().depth;
}
Duration RawReader::cycle() const noexcept {
  return state_->stream->ring->mapping->identity().cycle;
}
std::uint64_t RawReader::incarnation() const noexcept {
  return state_->stream->ring->mapping->identity().incarnation;
}

Result<std::vector<std::byte>> RawReader::property() const {
  return detail::get_property(*state_->stream->client, id());
}

}  // namespace dssm
