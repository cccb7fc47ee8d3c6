// SPDX-License-Identifier: Apache-2.0
#include "core/ring/activity.hpp"

#include <algorithm>
#include <array>

namespace dssm::ring {
namespace {

// Attempts to read the newest stamp while writers overtake this reader.
constexpr int kMaxAttempts = 4;

// Stamps may be anything: their distance need not fit.
Duration distance(Time from, Time to) noexcept {
  std::int64_t ns = 0;
  if (!__builtin_sub_overflow(to_ns(to), to_ns(from), &ns)) return Duration(ns);
  return to > from ? Duration::max() : Duration::min();
}

// The stamps of the newest samples, the newest one first.
struct Stamps {
  std::array<Time, kRecentSamples> times;
  std::size_t count = 0;

  std::span<const Time> all() const noexcept { return std::span(times).first(count); }
};

Stamps stamps_before(const RingReader& reader, const SampleInfo& newest, Tid oldest) noexcept {
  Stamps stamps;
  stamps.times[stamps.count++] = newest.time;
  for (Tid tid = newest.tid - 1; tid >= oldest && stamps.count < kRecentSamples; --tid) {
    SampleInfo info;
    if (reader.stamp(tid, info) != ReadStatus::ok) break;  // overwritten, or not in this mirror
    stamps.times[stamps.count++] = info.time;
  }
  return stamps;
}

double rate_of(std::span<const Time> newest_first, Duration pause) noexcept {
  std::size_t end = 1;
  while (end < newest_first.size() && distance(newest_first[end], newest_first[end - 1]) < pause) {
    ++end;
  }
  const Duration span = distance(newest_first[end - 1], newest_first.front());
  if (span <= Duration::zero() || span == Duration::max()) return 0;
  return static_cast<double>(end - 1) * 1e9 / static_cast<double>(to_ns(span));
}

}  // namespace

void describe_activity(const RingReader& reader, Time now, StreamInfo& info) noexcept {
  SampleInfo last;
  for (int attempt = 0; attempt < kMaxAttempts; ++attempt) {
    const Tid newest = reader.newest();
    if (newest < 0) {
      if (newest == kNoTid) info.state = StreamState::empty;
      return;
    }
    if (reader.stamp(newest, last) != ReadStatus::ok) continue;
    info.newest = newest;
    info.newest_time = last.time;
    break;
  }
  if (info.newest < 0) return;
  info.oldest = std::clamp<Tid>(reader.oldest(), 0, info.newest);

  const Stamps stamps = stamps_before(reader, last, info.oldest);
  std::array<Duration, kRecentSamples> intervals;
  for (std::size_t i = 1; i < stamps.count; ++i) {
    intervals[i - 1] = distance(stamps.times[i], stamps.times[i - 1]);
  }
  const Duration pause = pause_length(std::span(intervals).first(stamps.count - 1), info.cycle);
  info.rate_hz = rate_of(stamps.all(), pause);
  if (last.clock_error == kForeignClockError) return;
  info.age = distance(last.time, now);
  info.state = info.age < pause ? StreamState::live : StreamState::stalled;
}

}  // namespace dssm::ring
