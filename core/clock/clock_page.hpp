// SPDX-License-Identifier: Apache-2.0
//
// The shared page in which dssmd states what it knows of this PC's clock. All programs of this PC
// read it without a request. docs/clocks.md "The shared page" has the layout byte by byte.
// dssmd writes it (daemon/clock/clock_page_writer.hpp) as a SharedSnapshot: readers never see a mix
// and never wait, and a dssmd that is killed at any instruction leaves a readable page.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/result.hpp>
#include <dssm/time.hpp>
#include <optional>
#include <string>

#include "core/base/shared_snapshot.hpp"

namespace dssm::clock {

// What dssmd states at one time. The first kStampBytes are all that stamping a sample takes, and
// the first kEarlierBytes all that it takes of a time before `wall`.
//
//   off size field                  unit
//     0    8 wall                   ns     CLOCK_REALTIME, when this was stated
//     8    8 earlier_from           ns     CLOCK_REALTIME; from then to `wall` ...
//    16    8 earlier_bound          ns     ... the bound was at most this
//    24    8 limit                  ns     beyond it the clock is out of bounds (key clock_limit)
//    32    8 mono                   ns     CLOCK_MONOTONIC, when this was stated
//    40   72 clock                         dssm/clock_status.hpp
//   112   24 base_mono, _wall, _width  ns  both clocks at an instant since which the clock was not
//                                          set: the next dssmd detects a step by them
//   136   64 reference                     the host or address that this clock follows
//   200    8 setting_from           ns     CLOCK_REALTIME; times from here on are of the clock as
//                                          it is set now
//   208   48 reserved                      zero
struct ClockPageState {
  static constexpr std::size_t kStampBytes = 64;
  static constexpr std::size_t kEarlierBytes = 24;
  static constexpr std::size_t kMaxReferenceBytes = 63;

  Time wall{};
  Time earlier_from{};
  Duration earlier_bound{};
  Duration limit{};
  MonoTime mono{};
  ClockSnapshot clock;
  MonoTime base_mono{};
  Time base_wall{};
  Duration base_width{};
  char reference[kMaxReferenceBytes + 1] = {};  // zero-terminated
  Time setting_from{};
  std::byte reserved[48] = {};
};
static_assert(offsetof(ClockPageState, mono) == 32 && offsetof(ClockPageState, clock) == 40);
static_assert(offsetof(ClockSnapshot, stratum) + 4 == ClockPageState::kStampBytes - 40);
static_assert(offsetof(ClockSnapshot, root_bound) == 24 && sizeof(ClockSnapshot) == 72);
static_assert(offsetof(ClockPageState, base_mono) == 112);
static_assert(offsetof(ClockPageState, reference) == 136 &&
              offsetof(ClockPageState, setting_from) == 200 && sizeof(ClockPageState) == 256);

// One page, little endian.
struct ClockPage {
  static constexpr std::uint64_t kMagic = 0x4b434c434d535344;  // "DSSMCLCK"
  static constexpr std::uint32_t kLayoutVersion = 3;

  std::uint64_t magic;
  std::uint32_t layout_version;
  std::uint32_t reserved0;
  char boot_id[40];  // of the boot in which the times of mono hold; zero-terminated
  SharedSnapshot<ClockPageState> state;
  std::byte reserved1[4096 - 64 - 2 * sizeof(ClockPageState)];
};
static_assert(offsetof(ClockPage, state) == 56 && sizeof(ClockPage) == 4096);

// A statement that is older says nothing: dssmd states the clock every second.
inline constexpr Duration kMaxUse = std::chrono::milliseconds(3500);

// How far this PC's clock may have been from its reference at `t`, a time by this clock.
//   returns  kUnknownClockError: not known then. nullopt: the page does not cover `t`: it is not a
//            time of this clock, or is too long ago, or dssmd does not run
//   threads  any; async-signal-safe; no system call
std::optional<Duration> clock_error_at(const ClockPage& page, Time t) noexcept;

// The status of the clock; `unknown` when none was stated for kMaxUse. As clock_error_at().
ClockStatus status_of(const ClockPage& page) noexcept;

// Maps `fd` as a clock page.
//   protection  PROT_READ, PROT_READ | PROT_WRITE
//   fails       protocol: it is not such a page
Result<ClockPage*> map_page_untrusted(int fd, int protection);

// The page in `fd`, for reading. It stays mapped as long as the process lives, because any thread
// may be reading it; further calls for the same file return the same mapping. Thread-safe.
//   fails  protocol: it is not such a page
Result<const ClockPage*> map_clock_page_untrusted(int fd);

// /proc/sys/kernel/random/boot_id; empty when it cannot be read.
std::string boot_id();

// clock_error_at() for a writer that stamps each sample: what the page states is kept until its
// generation changes. So the loads of one answer do not wait for each other, and it costs a few
// instructions that the processor does beside others (docs/benchmarks.md "Stamping"). Of one
// thread.
class ClockErrorCache {
 public:
  // Whether `t` is not before the page's latest statement; then `error` is what clock_error_at()
  // returns, or some nanoseconds more. False: call that. page: nullptr: there is none.
  bool find(const ClockPage* page, Time t, Duration& error) noexcept {
    if (!page) return false;
    // Nearly always the same, so the processor goes on before it knows.
    if (page != page_ || page->state.generation() != generation_) {
      refresh(*page);
    }
    const std::uint64_t age =
        static_cast<std::uint64_t>(to_ns(t)) - static_cast<std::uint64_t>(wall_ns_);
    if (age > static_cast<std::uint64_t>(to_ns(kMaxUse))) return false;
    error = Duration(bound_ns_ + static_cast<std::int64_t>((age * growth_ + kRoundUp) >> 32));
    return true;
  }

 private:
  static constexpr std::uint64_t kRoundUp = (std::uint64_t{1} << 32) - 1;

  void refresh(const ClockPage& page) noexcept;

  const ClockPage* page_ = nullptr;
  std::uint64_t generation_ = 0;
  std::int64_t wall_ns_ = 0;
  std::int64_t bound_ns_ = 0;  // 2^63-1: none
  std::uint64_t growth_ = 0;   // of it, 2^-32 ns per ns
};

}  // namespace dssm::clock
