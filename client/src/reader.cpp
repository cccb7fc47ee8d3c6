// SPDX-License-Identifier: Apache-2.0
//
// RawReader on top of ring::RingReader: adds the cursor, the count of lost samples, the check of
// the clock, the switch to a restarted stream's new ring, and waiting.
//
// Each read is an attempt that a writer may overtake; retry() repeats it. All reads by time that
// copy go through read_by_time(): choose a sample, check its clock, copy it.
#include <algorithm>
#include <array>
#include <dssm/reader.hpp>

#include "client/src/client.hpp"
#include "client/src/lockstep.hpp"
#include "client/src/states.hpp"
#include "core/base/check.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"

namespace dssm {
namespace {

// Empty: this program is not run in lockstep.
template <class Ready>
std::optional<WaitStatus> wait_in_lockstep(MonoTime deadline, Ready& ready) noexcept {
  detail::Lockstep* const lockstep = detail::Lockstep::of_process();
  return lockstep ? lockstep->wait_until(deadline, std::ref(ready)) : std::nullopt;
}

// Waits until ready() or the deadline: check, announce, check again, sleep. Returns interrupted
// only while not ready().
template <class Ready>
WaitStatus wait_until(const detail::SharedRing& ring, MonoTime deadline, Ready ready) noexcept {
  if (ready()) return WaitStatus::ready;
  if (deadline != kNever && MonoClock::now() >= deadline) return WaitStatus::timeout;
  if (const auto waited = wait_in_lockstep(deadline, ready)) return *waited;
  ring::SleepTimes times(ring.mapping->identity().cycle);
  for (;;) {
    const std::uint32_t announced = ring.bell->announce();
    if (ready()) return WaitStatus::ready;
    const WaitStatus status = ring.bell->sleep(announced, deadline, times.next(MonoClock::now()));
    if (ready()) return WaitStatus::ready;
    if (status != WaitStatus::ready) return status;
  }
}

// The closer one of two stamps, the earlier sample when both are equally close.
Tid closer(Time t, const SampleInfo& before, const SampleInfo& after) noexcept {
  return distance_ns(t, after.time) < distance_ns(before.time, t) ? after.tid : before.tid;
}

// Assessments are valid for seconds, so a coarse clock is precise enough.

// Whether reads by time must not return that sample.
bool is_refused(const ring::RingReader& ring, const SampleInfo& info) noexcept {
  return ring.enforces_clock() && !ring.clock().is_good(info, coarse_now());
}

// The same by tid, before the sample is copied.
bool is_refused(const ring::RingReader& ring, Tid tid) noexcept {
  SampleInfo info;
  return ring.enforces_clock() && ring.stamp(tid, info) == ReadStatus::ok &&
         !ring.clock().is_good(info, coarse_now());
}

// What an attempt to read returns when a writer overtook it.
constexpr std::optional<ReadStatus> kOvertaken = std::nullopt;

// Repeats `attempt` until no writer overtakes it.
template <class Attempt>
[[gnu::always_inline]] inline ReadStatus retry(Attempt attempt) noexcept {
  for (int i = 0; i < ring::RingReader::kMaxRetries; ++i) {
    if (const std::optional<ReadStatus> done = attempt()) return *done;
  }
  return ReadStatus::lapped;
}

// What a read returns to the program.
[[gnu::always_inline]] inline ReadStatus result(detail::ReaderState& state,
                                                ReadStatus status) noexcept {
  if (status == ReadStatus::arriving) state.want_history();
  return status;
}

// Copies the sample that `choose` finds: std::optional<ReadStatus> choose(Tid& chosen).
template <class Choose>
[[gnu::always_inline]] inline ReadStatus read_by_time(detail::ReaderState& state,
                                                      std::span<std::byte> payload,
                                                      SampleInfo& info, Choose choose) noexcept {
  if (state.restart_due() && state.restart()) return ReadStatus::restarted;
  DSSM_CHECK(payload.size() == state.stream->ring->mapping->geometry().payload_bytes);
  return result(state, retry([&]() -> std::optional<ReadStatus> {
                  Tid chosen = kNoTid;
                  const std::optional<ReadStatus> found = choose(chosen);
                  if (found != ReadStatus::ok) return found;
                  if (is_refused(state.ring, chosen)) return ReadStatus::clock_out_of_bounds;
                  const ReadStatus status = state.ring.read(chosen, payload, info);
                  if (status == ReadStatus::too_old || status == ReadStatus::lost)
                    return kOvertaken;
                  return status;
                }));
}

// The infos of the two samples around `t`.
std::optional<ReadStatus> try_neighbours(const ring::RingReader& ring, Time t,
                                         Neighbours& out) noexcept {
  Tid before = kNoTid;
  const ReadStatus found = ring.find(t, before);
  if (found != ReadStatus::ok) return found;
  const ReadStatus after = ring.stamp(ring.skip_lost(before + 1), out.after);
  if (after == ReadStatus::not_yet) return after;
  if (after != ReadStatus::ok) return kOvertaken;
  if (ring.stamp(before, out.before) != ReadStatus::ok) return kOvertaken;
  // A sample whose time runs backwards was written meanwhile: now it is the newest with time <= t.
  if (out.after.time <= t) return kOvertaken;
  if (is_refused(ring, out.before) || is_refused(ring, out.after)) {
    return ReadStatus::clock_out_of_bounds;
  }
  return ReadStatus::ok;
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
  // Only dssmd can open the new ring, and a read must not wait until dssmd is available.
  if (to_ns(now.time_since_epoch()) < next_attempt_ns || !client.connection().is_up()) return false;
  auto newer = client.open_reader(stream->requested, stream->tag, stream->history);
  const bool is_refused =
      !newer && newer.error().code != Errc::not_found && newer.error().code != Errc::unavailable;
  // After the request, for which a dssmd that hangs may have let this wait.
  next_attempt_ns =
      to_ns((MonoClock::now() + (is_refused ? kRefusedPause : kRestartPause)).time_since_epoch());
  if (!newer) {
    if (newer.error().code == Errc::no_permission) {
      restart_error =
          std::move(newer).error().context("continue to read '" + stream->requested.str() + "'");
    }
    return false;
  }
  if (Result<void> usable = (*newer)->type.check_usable_as(stream->type); !usable) {
    next_attempt_ns = INT64_MAX;
    restart_error = std::move(usable).error().context("continue with the new ring of '" +
                                                      (*newer)->id.str() + "'");
    return false;
  }
  restart_error.reset();
  if ((*newer)->ring == stream->ring) {
    // dssmd has no new ring yet, or had ended the open of this one.
    {
      const std::lock_guard guard(stream_mutex);
      stream = *std::move(newer);
    }
    if (ready) client.notifiers().follow(*ready, {stream->ring, stream->superseded, cursor});
    return false;
  }
  // A mirror that dssmd recreated has the same samples with the same tids: not a restart.
  const bool same_samples = (*newer)->ring->mapping->identity().incarnation ==
                            stream->ring->mapping->identity().incarnation;
  previous = stream->ring;
  {
    const std::lock_guard guard(stream_mutex);
    stream = *std::move(newer);
  }
  ring = ring::RingReader(*stream->ring->mapping);
  next_attempt_ns = 0;
  if (!same_samples) {
    cursor = kNoTid;  // read_next() continues with the first sample; a fresh reader stays fresh
    awaited = kNoTid;
    ++restarts;
  }
  if (ready) client.notifiers().follow(*ready, {stream->ring, stream->superseded, cursor});
  return !same_samples;
}

[[gnu::cold]] void ReaderState::want_history() noexcept {
  const MonoTime now = MonoClock::now();
  if (to_ns(now.time_since_epoch()) < next_wish_ns) return;
  next_wish_ns = to_ns((now + kHistoryPause).time_since_epoch());
  const std::shared_ptr<OpenStream> on = stream_now();
  on->client->want_history(*on);
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
  if (status == ReadStatus::ok) state_->set_cursor(info.tid);
  return status;
}

ReadStatus RawReader::read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  DSSM_CHECK(payload.size() == payload_bytes());
  const ReadStatus status = state_->ring.read(tid, payload, info);
  if (status == ReadStatus::ok) state_->set_cursor(tid);
  return result(*state_, status);
}

[[gnu::hot]] ReadStatus RawReader::read_next(std::span<std::byte> payload,
                                             SampleInfo& info) noexcept {
  if (state_->fresh) return read_newest(payload, info);
  DSSM_CHECK(payload.size() == payload_bytes());
  Tid wanted = state_->cursor + 1;
  return retry([&]() -> std::optional<ReadStatus> {
    ReadStatus status = state_->ring.read(wanted, payload, info);
    const bool is_arriving = status == ReadStatus::arriving;
    if (is_arriving) {
      state_->awaited = wanted;
      state_->want_history();
      status = ReadStatus::not_yet;
    }
    if (status == ReadStatus::not_yet) {
      // Only now: the samples of the old ring are read first.
      if (!state_->restart_due()) return status;
      // The last one may have come after it was read, and before the new ring.
      if (!is_arriving && state_->ring.newest() >= wanted) return kOvertaken;
      return state_->restart() ? ReadStatus::restarted : status;
    }
    if (status == ReadStatus::ok) {
      state_->lost += static_cast<std::uint64_t>(wanted - (state_->cursor + 1));
      state_->set_cursor(wanted);
      return status;
    }
    wanted = state_->ring.skip_lost(std::max(wanted, state_->ring.oldest()));
    return kOvertaken;
  });
}

ReadStatus RawReader::read_previous(std::span<std::byte> payload, SampleInfo& info) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  if (state_->cursor < 0) return ReadStatus::not_yet;
  Tid wanted = state_->cursor - 1;
  ReadStatus status = read_tid(wanted, payload, info);
  while (status == ReadStatus::lost) status = read_tid(--wanted, payload, info);
  return status;
}

[[gnu::flatten]] ReadStatus RawReader::read_at(Time t, std::span<std::byte> payload,
                                               SampleInfo& info, Duration max_age) noexcept {
  if (max_age == kAnyAge) {  // apart, so that a read without a maximum age costs nothing more
    return read_by_time(*state_, payload, info,
                        [&](Tid& chosen) { return state_->ring.find(t, chosen); });
  }
  return read_by_time(*state_, payload, info, [&](Tid& chosen) -> std::optional<ReadStatus> {
    const ReadStatus found = state_->ring.find(t, chosen);
    if (found != ReadStatus::ok) return found;
    SampleInfo seen;
    if (state_->ring.stamp(chosen, seen) != ReadStatus::ok) return kOvertaken;
    if (!is_stale(t, seen.time, max_age)) return ReadStatus::ok;
    // A clock that is wrong is the reason, where it is one: waiting does not help against that.
    return is_refused(state_->ring, seen) ? ReadStatus::clock_out_of_bounds : ReadStatus::stale;
  });
}

ReadStatus RawReader::read_at_or_after(Time t, std::span<std::byte> payload,
                                       SampleInfo& info) noexcept {
  return read_by_time(*state_, payload, info, [&](Tid& chosen) {
    // After the newest sample before `t` all samples have time >= t.
    Tid before = kNoTid;
    const ReadStatus found =
        to_ns(t) == INT64_MIN ? ReadStatus::too_old : state_->ring.find(t - Duration(1), before);
    if (found != ReadStatus::ok && found != ReadStatus::too_old) return found;
    chosen =
        state_->ring.skip_lost(found == ReadStatus::too_old ? state_->ring.oldest() : before + 1);
    return ReadStatus::ok;
  });
}

ReadStatus RawReader::read_nearest(Time t, std::span<std::byte> payload,
                                   SampleInfo& info) noexcept {
  return read_by_time(*state_, payload, info, [&](Tid& chosen) -> std::optional<ReadStatus> {
    const ReadStatus found = state_->ring.find(t, chosen);
    if (found == ReadStatus::too_old) {
      chosen = state_->ring.skip_lost(state_->ring.oldest());
      return ReadStatus::ok;
    }
    if (found != ReadStatus::ok) return found;
    SampleInfo before, after;
    if (state_->ring.stamp(chosen, before) != ReadStatus::ok) return kOvertaken;
    if (state_->ring.stamp(state_->ring.skip_lost(chosen + 1), after) == ReadStatus::ok) {
      chosen = closer(t, before, after);
    }
    return ReadStatus::ok;
  });
}

ReadStatus RawReader::read_neighbours(Time t, std::span<std::byte> before,
                                      std::span<std::byte> after, Neighbours& infos) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  DSSM_CHECK(before.size() == payload_bytes() && after.size() == payload_bytes());
  return result(*state_, retry([&]() -> std::optional<ReadStatus> {
    const ring::RingReader& ring = state_->ring;
    Neighbours seen;
    const std::optional<ReadStatus> found = try_neighbours(ring, t, seen);
    if (found != ReadStatus::ok) return found;
    if (ring.read(seen.before.tid, before, seen.before) != ReadStatus::ok ||
        ring.read(seen.after.tid, after, seen.after) != ReadStatus::ok) {
      return kOvertaken;
    }
    infos = seen;
    return ReadStatus::ok;
  }));
}

ReadStatus RawReader::find_neighbours(Time t, Neighbours& out) const noexcept {
  return result(*state_, retry([&] {
    Neighbours seen;
    const std::optional<ReadStatus> found = try_neighbours(state_->ring, t, seen);
    if (found == ReadStatus::ok) out = seen;
    return found;
  }));
}

Duration RawReader::clock_error(const SampleInfo& info) const noexcept {
  return state_->ring.clock().distance(info, coarse_now());
}

bool RawReader::clock_in_bounds(const SampleInfo& info) const noexcept {
  return state_->ring.clock().is_good(info, coarse_now());
}

JointRead read_joint_at(Time t, std::span<JointSample> samples, Duration max_error,
                        Duration max_age) noexcept {
  for (const JointSample& sample : samples) {
    detail::ReaderState& state = *sample.reader->state_;
    if (state.restart_due() && state.restart()) {
      return {ReadStatus::restarted, static_cast<std::size_t>(&sample - samples.data()),
              kUnknownClockError};
    }
  }
  JointRead read;
  read.status = retry([&]() -> std::optional<ReadStatus> {
    read = {ReadStatus::ok, 0, Duration::zero()};
    for (std::size_t i = 0; i < samples.size(); ++i) {
      const RawReader& reader = *samples[i].reader;
      ReadStatus status = reader.find(t, samples[i].info);
      if (status == ReadStatus::ok && is_stale(t, samples[i].info.time, max_age)) {
        status = ReadStatus::stale;
      }
      if (status != ReadStatus::ok) {
        read = {status, i, kUnknownClockError};
        return status;
      }
      const Duration error = reader.clock_error(samples[i].info);
      if (error > read.clock_error) read = {ReadStatus::ok, i, error};
    }
    if (read.clock_error > max_error) return ReadStatus::clock_out_of_bounds;
    for (std::size_t i = 0; i < samples.size(); ++i) {
      JointSample& sample = samples[i];
      DSSM_CHECK(sample.payload.size() == sample.reader->payload_bytes());
      const ring::RingReader& ring = sample.reader->state_->ring;
      if (ring.read(sample.info.tid, sample.payload, sample.info) == ReadStatus::ok) {
        zero_rest(sample.payload, sample.info);
        continue;
      }
      read = {ReadStatus::lapped, i, kUnknownClockError};
      return kOvertaken;
    }
    return ReadStatus::ok;
  });
  return read;
}

Tid RawReader::newest_tid() const noexcept { return state_->ring.newest(); }
Tid RawReader::oldest_tid() const noexcept { return state_->ring.oldest(); }

ReadStatus RawReader::read_info(Tid tid, SampleInfo& info) const noexcept {
  return result(*state_, state_->ring.stamp(tid, info));
}

ReadStatus RawReader::find(Time t, SampleInfo& info) const noexcept {
  return result(*state_, retry([&]() -> std::optional<ReadStatus> {
    Tid found = kNoTid;
    const ReadStatus status = state_->ring.find(t, found);
    if (status != ReadStatus::ok) return status;
    SampleInfo seen;
    if (state_->ring.stamp(found, seen) != ReadStatus::ok) return kOvertaken;
    if (is_refused(state_->ring, seen)) return ReadStatus::clock_out_of_bounds;
    info = seen;
    return ReadStatus::ok;
  }));
}

Tid RawReader::cursor() const noexcept { return state_->cursor; }

void RawReader::seek(Tid tid) noexcept { state_->set_cursor(std::max(tid, kNoTid)); }

std::uint64_t RawReader::lost_samples() const noexcept { return state_->lost; }
std::uint64_t RawReader::restarts() const noexcept { return state_->restarts; }
std::optional<Error> RawReader::restart_error() const { return state_->restart_error; }

ReadStatus RawReader::borrow(Tid tid, BorrowedSample& out) noexcept {
  if (state_->restart_due() && state_->restart()) return ReadStatus::restarted;
  ring::RingReader::Place place{};
  const ReadStatus status = state_->ring.locate(tid, place, out.info_);
  if (status != ReadStatus::ok) return result(*state_, status);
  out.payload_ = {place.payload, out.info_.payload_bytes};
  out.sequence_ = place.sequence;
  state_->set_cursor(tid);
  return ReadStatus::ok;
}

[[gnu::hot]] WaitStatus RawReader::wait(MonoTime deadline) noexcept {
  const std::shared_ptr<detail::OpenStream> stream = state_->stream_now();
  const ring::RingReader ring(*stream->ring->mapping);
  return wait_until(*stream->ring, deadline,
                    [&] { return state_->has_news(ring) || state_->restart_wakes(*stream); });
}

[[gnu::hot]] WaitStatus RawReader::wait_for_tid(Tid tid, MonoTime deadline) noexcept {
  const std::shared_ptr<detail::OpenStream> stream = state_->stream_now();
  const ring::RingReader ring(*stream->ring->mapping);
  return wait_until(*stream->ring, deadline,
                    [&] { return ring.newest() >= tid || state_->restart_wakes(*stream); });
}

WaitStatus RawReader::wait_for_sample(Tid tid, MonoTime deadline) noexcept {
  const std::shared_ptr<detail::OpenStream> stream = state_->stream_now();
  const ring::RingReader ring(*stream->ring->mapping);
  return wait_until(*stream->ring, deadline, [&] {
    if (ring.is_settled(tid)) return true;
    if (tid <= ring.newest()) state_->want_history();
    return state_->restart_wakes(*stream);
  });
}

WaitStatus wait_any(std::span<RawReader* const> readers, MonoTime deadline) noexcept {
  DSSM_CHECK(!readers.empty() && readers.size() <= kMaxWaitAny);
  const auto ready = [&] {
    return std::any_of(readers.begin(), readers.end(), [](const RawReader* reader) {
      return reader->state_->has_news(reader->state_->ring) ||
             reader->state_->restart_wakes(*reader->state_->stream);
    });
  };
  Duration shortest_cycle = ring::SleepTimes::kMaxSleep;
  for (const RawReader* reader : readers) {
    shortest_cycle = std::min(shortest_cycle, reader->cycle());
  }
  ring::SleepTimes times(shortest_cycle);
  std::array<ring::Bell*, kMaxWaitAny> bells;
  std::array<std::uint32_t, kMaxWaitAny> announced;
  if (ready()) return WaitStatus::ready;
  if (deadline != kNever && MonoClock::now() >= deadline) return WaitStatus::timeout;
  if (const auto waited = wait_in_lockstep(deadline, ready)) return *waited;
  for (;;) {
    for (std::size_t i = 0; i < readers.size(); ++i) {
      bells[i] = readers[i]->state_->stream->ring->bell.get();
      announced[i] = bells[i]->announce();
    }
    if (ready()) return WaitStatus::ready;
    const WaitStatus status = ring::Bell::sleep_any(
        std::span(bells).first(readers.size()), announced, deadline, times.next(MonoClock::now()));
    if (ready()) return WaitStatus::ready;
    if (status != WaitStatus::ready) return status;
  }
}

Result<int> RawReader::ready_fd() noexcept {
  if (!state_->ready) {
    state_->ready = DSSM_TRY(state_->stream->client->notifiers().watch(
        {state_->stream->ring, state_->stream->superseded, state_->cursor}));
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
