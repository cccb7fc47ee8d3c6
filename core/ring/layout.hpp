// SPDX-License-Identifier: Apache-2.0
//
// The ring's layout in memory: the ABI between all processes that map one. docs/ring-layout.md
// explains each byte; tests/unit/core/ring/ring_memory_test.cpp repeats its numbers.
// Little endian. An incompatible change raises kLayoutVersion.
//
//   offset 0       RingHeader, one page of the system (zeros after the header where that is greater
//                  than 4 KiB); its first part is written once, before the descriptor is
//                  passed to any process
//   times_offset   depth * 8 bytes: time_ns of sample tid at index tid % depth ("time index")
//   slots_offset   depth slots: SlotHeader, payload, at least kGuardBytes of padding
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>

#include "core/base/shared_snapshot.hpp"
#include "core/ring/clock_assessment.hpp"
#include "core/ring/robust_lock.hpp"

namespace dssm::ring {

inline constexpr std::uint64_t kMagic = 0x474e49524d535344;  // "DSSMRING"
inline constexpr std::uint32_t kLayoutVersion = 8;
inline constexpr std::size_t kPageBytes = 4096;
inline constexpr std::size_t kLineBytes = 64;

// After each payload: one widespread SSM wrapper writes 8 bytes more than its sample has.
inline constexpr std::size_t kGuardBytes = 64;

static_assert(std::atomic<std::int64_t>::is_always_lock_free);
static_assert(std::atomic<std::uint32_t>::is_always_lock_free);

// Publishers per stream: few enough for a linear search, and more than write to one stream at the
// same time. Each PConnector is one publisher; a new one replaces the one that wrote longest ago.
inline constexpr std::size_t kMaxPublishers = 64;

//   off size field              unit  written by  order
//     0    8 publisher          -     dssmd       before tid_end
//     8    8 tid_end            tid   dssmd       its last sample's tid + 1; 0: free
//    16    8 number_end         -     dssmd       its last sample's number + 1
//    24    8 earlier_tid_end    tid   dssmd       the same of the sample before; 0: none
//    32    8 earlier_number_end -     dssmd       the same of the sample before
//
// While tid_end is beyond top + 1, the earlier pair is valid; a writer that takes over the lock of
// a dead one restores that pair.
struct PublisherCursor {
  std::atomic<std::uint64_t> publisher;
  std::atomic<std::uint64_t> tid_end, number_end;
  std::atomic<std::uint64_t> earlier_tid_end, earlier_number_end;
};
static_assert(sizeof(PublisherCursor) == 40);

//   off  size field            unit   written by  order
//     0     8 magic            -      dssmd       before other processes see it, as all to 320
//     8     4 layout_version   -      dssmd
//    12     4 alignment_bytes  bytes  dssmd
//    16     8 payload_bytes    bytes  dssmd
//    24     8 depth            slots  dssmd
//    32     8 slot_bytes       bytes  dssmd
//    40     8 times_offset     bytes  dssmd
//    48     8 slots_offset     bytes  dssmd
//    56     8 total_bytes      bytes  dssmd
//    64     8 incarnation      -      dssmd
//    72     8 cycle_ns         ns     dssmd
//    80     4 stream_id        -      dssmd
//    84     4 reserved         -      -           zero
//    88    40 name             -      dssmd       zero-terminated
//   128    64 host             -      dssmd       zero-terminated
//   192   256 reserved         -      -           zero
//   448     4 doorbell_armed   -      dssmd       seq_cst; not 0: writers ring their doorbells
//   452    60 reserved         -      -           zero
//   512     8 top              tid    writer      after the sample; -1: none written
//   520     8 run_start        tid    writer      before top; see "Search by time"
//   528     8 first            tid    dssmd       before top; see "Window"
//   536     8 hole_begin       tid    dssmd       see "Hole"; above 0 only in mirrors
//   544     8 hole_end         tid    dssmd       before top; likewise
//   552    88 reserved         -      -           zero
//   640  2560 publishers       -      dssmd       before top: see publisher_cursors.hpp
//  3200   200 clock            -      dssmd       see clock_assessment.hpp, shared_snapshot.hpp
//  3400   672 reserved         -      -           zero
//  4072    24 lock             -      writers     see robust_lock.hpp. On a system with greater
//                                             pages 24 bytes before times_offset
struct RingHeader {
  std::uint64_t magic;
  std::uint32_t layout_version;
  std::uint32_t alignment_bytes;
  std::uint64_t payload_bytes;
  std::uint64_t depth;
  std::uint64_t slot_bytes;
  std::uint64_t times_offset;
  std::uint64_t slots_offset;
  std::uint64_t total_bytes;
  std::uint64_t incarnation;
  std::int64_t cycle_ns;
  std::int32_t stream_id;
  std::uint32_t reserved0;
  char name[40];
  char host[64];
  std::byte reserved1[256];
  std::atomic<std::uint32_t> doorbell_armed;
  std::byte reserved2[60];
  std::atomic<std::int64_t> top;
  std::atomic<std::int64_t> run_start;
  std::atomic<std::int64_t> first;
  std::atomic<std::int64_t> hole_begin;
  std::atomic<std::int64_t> hole_end;
  std::byte reserved3[88];
  PublisherCursor publishers[kMaxPublishers];
  SharedSnapshot<ClockAssessment> clock;
  std::byte reserved4[672];
  std::byte lock[kLockBytes];
};
static_assert(offsetof(RingHeader, incarnation) == 64 && offsetof(RingHeader, name) == 88);
static_assert(offsetof(RingHeader, host) == 128 && offsetof(RingHeader, doorbell_armed) == 448);
static_assert(offsetof(RingHeader, top) == 512 && offsetof(RingHeader, run_start) == 520);
static_assert(offsetof(RingHeader, first) == 528 && offsetof(RingHeader, hole_begin) == 536);
static_assert(offsetof(RingHeader, hole_end) == 544);
static_assert(offsetof(RingHeader, publishers) == 640 && offsetof(RingHeader, clock) == 3200);
static_assert(offsetof(RingHeader, lock) == 4072);
static_assert(sizeof(RingHeader) == kPageBytes);

//   off size field           unit  written by  order
//     0    8 sequence        -     writer      2*tid+1 while being filled, 2*tid+2 when published;
//                                            of a lost sample (mirrors) 2^63 + 2*tid+2
//     8    8 payload_bytes   bytes writer      of this sample; inside the sequence bracket, as all
//                                              below
//    16    8 time_ns         ns    writer      signed, since 1970, CLOCK_REALTIME of the writer
//    24    8 clock_error_ns  ns    writer      >= 0; 2^63-1: unknown; 2^63-2: of another clock
//    32    8 run_start       tid   writer      first sample of the run this one belongs to
//    40    8 run_parent      tid   writer      run_start's sample only: newest earlier sample with
//                                              an earlier time; -1: none
//    48    8 run_jump        tid   writer      run_start's sample only: start of an ancestor run
//    56    8 run_level       -     writer      run_start's sample only: number of ancestor runs
//    64    - payload
struct SlotHeader {
  std::atomic<std::uint64_t> sequence;
  std::atomic<std::uint64_t> payload_bytes;
  std::atomic<std::int64_t> time_ns, clock_error_ns;
  std::atomic<std::int64_t> run_start, run_parent, run_jump, run_level;
};
static_assert(offsetof(SlotHeader, time_ns) == 16 && offsetof(SlotHeader, run_level) == 56);
static_assert(sizeof(SlotHeader) == kLineBytes);

//   off  size field           written by           order
//     0     4 word            writers, sleepers    seq_cst; bit 0: a thread sleeps; rest: a count
//     4  4092 reserved        -                    zero
struct BellPage {
  std::atomic<std::uint32_t> word;
  std::byte reserved[kPageBytes - 4];
};
static_assert(sizeof(BellPage) == kPageBytes);

}  // namespace dssm::ring
