// SPDX-License-Identifier: Apache-2.0
//
// Lockstep: `dssmctl play --lockstep PROGRAM` plays as fast as its programs can take it, and in the
// same order each time. The player shares this page with each program that it starts. A thread of
// the program that would wait in libdssm, for a sample or by the playback clock, marks its place as
// `waiting` and sleeps. The player plays the next sample, or advances the clock, only when all
// threads wait; then it gives each of them a turn, one after the other.
//
//   states of a place    who changes it
//   unused -> running    a thread that waits for the first time takes the place
//   running -> waiting   the thread, after it wrote until_ns; it rings the player's eventfd
//   waiting -> running   the player, which wakes the thread: a turn. Or the thread, which a signal
//                        woke
//   running -> unused    the thread, at its end
//
// A thread whose turn brought nothing (no sample, and not late enough) waits again at once.
// Otherwise it counts the turn in `taken` and returns to the program.
//
// A thread that waits for an answer of dssmd sleeps, too, but is woken by that: it is counted in
// `requests_begun` before that and in `requests_ended` after it.
//
// The environment variable of kVariable has the two descriptors: "MEMORY,EVENTFD".
#pragma once

#include <atomic>
#include <cstddef>
#include <cstdint>
#include <limits>

namespace dssm::clock {

struct LockstepPlace {
  enum State : std::uint32_t { unused, running, waiting };
  std::atomic<std::uint32_t> state;   // a futex, for the thread
  std::atomic<std::int32_t> process;  // and thread: as in /proc
  std::atomic<std::int32_t> thread;
  std::atomic<std::uint32_t> taken;    // turns after which it returned to the program
  std::atomic<std::int64_t> until_ns;  // by now_ns; kForever: it only waits for a sample
  static constexpr std::int64_t kForever = std::numeric_limits<std::int64_t>::max();
};

struct LockstepPage {
  static constexpr std::uint64_t kMagic = 0x504554534d535344;  // "DSSMSTEP"
  static constexpr std::uint32_t kLayoutVersion = 2;
  static constexpr std::size_t kPlaces = 168;
  static constexpr std::size_t kBytes = 4096;
  static constexpr const char* kVariable = "DSSM_LOCKSTEP";

  std::uint64_t magic;
  std::uint32_t layout_version;
  std::atomic<std::uint32_t> ended;     // not 0: all wait by the real clock again
  std::atomic<std::int64_t> now_ns;     // the playback time; the player writes it
  std::atomic<std::uint32_t> too_many;  // not 0: a thread found no place
  std::int32_t player;                  // its process
  std::atomic<std::uint32_t> requests_begun, requests_ended;
  std::uint32_t reserved[6];
  LockstepPlace places[kPlaces];
};
static_assert(offsetof(LockstepPage, places) == 64 && sizeof(LockstepPlace) == 24 &&
              sizeof(LockstepPage) == LockstepPage::kBytes);

}  // namespace dssm::clock
