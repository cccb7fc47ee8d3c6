// SPDX-License-Identifier: Apache-2.0
//
// The shared page in which dssmd says what it knows of this PC's clock, for all programs of this PC
// to read without asking. docs/clocks.md "The shared page" has the layout byte by byte.
//
// Two records take turns; `generation` says which one counts (generation % 2). The only writer,
// dssmd, fills the other one and then raises the generation: readers never see a mix and never
// wait, and a dssmd killed half-way has changed nothing.
#pragma once

#include <array>
#include <atomic>
#include <cstddef>
#include <cstdint>
#include <dssm/clock_status.hpp>
#include <dssm/result.hpp>
#include <optional>
#include <string>
#include <string_view>

#include "core/base/unique_fd.hpp"
#include "core/clock/clock_estimator.hpp"

namespace dssm::clock {

// Layout version 1, one page, little endian. Times are nanoseconds since 1970 (wall) or since boot
// (mono).
struct ClockPage {
  static constexpr std::uint64_t kMagic = 0x4b434f4c434d5353;  // "SSMCLOCK"
  static constexpr std::uint32_t kLayoutVersion = 1;

  struct Record {
    // One cache line: all that stamping a sample takes.
    std::atomic<std::int64_t> wall_ns;           // when this was written
    std::atomic<std::int64_t> bound_ns;          // then; 2^63-1: none
    std::atomic<std::int64_t> ageing_ppb;        // what the bound grows by, ns per second
    std::atomic<std::int64_t> earlier_from_ns;   // wall: from then to wall_ns
    std::atomic<std::int64_t> earlier_bound_ns;  // the bound was at most this
    std::atomic<std::int64_t> limit_ns;          // beyond it the clock is out of bounds
    std::atomic<std::int64_t> reserved0[2];
    // The rest.
    std::atomic<std::int64_t> mono_ns;  // when this was written
    std::atomic<std::uint32_t> status, trouble, basis, stratum;
    std::atomic<std::uint32_t> reference_id;
    std::atomic<std::uint32_t> reserved1;
    std::atomic<std::int64_t> offset_ns;
    std::atomic<std::int64_t> read_mono_ns;     // when chronyd was asked
    std::atomic<std::int64_t> updated_mono_ns;  // when it last learned something
    std::atomic<std::int64_t> root_dispersion_ns, root_delay_ns;
    std::atomic<std::int64_t> base_mono_ns, base_wall_ns, base_width_ns;  // for the next dssmd
    std::array<std::atomic<char>, 64> reference;  // a host's name or an address; zero-terminated
    std::byte reserved2[96];
  };

  std::uint64_t magic;
  std::uint32_t layout_version;
  std::uint32_t reserved0;
  std::atomic<std::uint64_t> generation;
  char boot_id[40];  // of the boot in which the times of mono hold; zero-terminated
  Record records[2];
  std::byte reserved1[4096 - 64 - 2 * 320];
};
static_assert(std::atomic<std::int64_t>::is_always_lock_free);
static_assert(offsetof(ClockPage, generation) == 16 && offsetof(ClockPage, records) == 64);
static_assert(offsetof(ClockPage::Record, mono_ns) == 64);
static_assert(sizeof(ClockPage::Record) == 320 && sizeof(ClockPage) == 4096);

// A record as a value.
struct ClockRecord {
  Time wall;
  MonoTime mono;
  ClockState state;          // at `mono`
  Time earlier_from;         // from then to `wall`
  Duration earlier_bound{};  // the bound was at most this
  Duration limit{};
  Instant base;           // at which the clock was whole: later steps show against it
  std::string reference;  // whom this clock follows; at most 63 bytes
};

// A bound stated longer ago than this says nothing: dssmd writes anew every second.
inline constexpr Duration kLongestUse = std::chrono::milliseconds(3500);

// How far this PC's clock may have been from its reference at `t`, a time by this clock.
//   returns  kUnknownClockError: not known then. Nothing: the page does not reach `t`: that is no
//            time of this clock, or lies too far back, or dssmd is gone
//   threads  any; async-signal-safe; no system call
std::optional<Duration> error_at(const ClockPage& page, Time t) noexcept;

// What error_at() answers from.
struct StatedBound {
  std::uint64_t generation = 0;  // of the page
  std::int64_t wall_ns = 0, bound_ns = 0, ageing_ppb = 0;
  std::int64_t earlier_from_ns = 0, earlier_bound_ns = 0;  // as in ClockPage::Record
};
StatedBound stated_bound(const ClockPage& page) noexcept;

// What dssmd says of the clock; `unknown` when it has said nothing for kLongestUse. As error_at().
ClockStatus status_of(const ClockPage& page) noexcept;

// All of it. Allocates.
ClockRecord load(const ClockPage& page);

// Maps the page behind `fd` for reading; it stays mapped as long as the process lives, because any
// thread may be reading it, and further calls for the same file give the same mapping. Thread-safe.
//   fails  protocol: this is no such page
Result<const ClockPage*> map_clock_page_untrusted(int fd);

// dssmd's side.
class ClockPageWriter {
 public:
  // Opens the page file `path`, or makes a new one when there is none, or one of another boot or
  // layout. Programs that have the old one mapped keep it.
  //   fails  os errors
  static Result<ClockPageWriter> open(const std::string& path);
  ClockPageWriter(ClockPageWriter&& other) noexcept;
  ClockPageWriter& operator=(ClockPageWriter&&) = delete;
  ~ClockPageWriter();

  // Whether another dssmd of this boot wrote it before.
  bool has_history() const noexcept { return has_history_; }
  const ClockPage& page() const noexcept { return *page_; }

  void store(const ClockRecord& record) noexcept;

  // A descriptor for a program: read-only.
  Result<UniqueFd> for_reading() const;

 private:
  ClockPageWriter(std::string path, ClockPage* page, bool has_history) noexcept
      : path_(std::move(path)), page_(page), has_history_(has_history) {}

  std::string path_;
  ClockPage* page_;
  bool has_history_;
};

// /proc/sys/kernel/random/boot_id; empty when it cannot be read.
std::string boot_id();

}  // namespace dssm::clock
