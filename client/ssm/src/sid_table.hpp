// SPDX-License-Identifier: Apache-2.0
//
// From a sid to its stream. A sid has a pointer type, but holds a number: the place in this table
// and a generation that is never used twice, so that a closed sid is always recognized. Places are
// never freed, only reused.
//
// Programs close streams from signal handlers while the interrupted thread is in a read. So close()
// only marks the place, and reap() destroys the stream when its use count is 0. The order that
// makes this safe: a call increments the use count and then checks that the place is open; the
// reaper finds "closed" and then checks the use count. Both are seq_cst, so at least one of the two
// sees the other. (SharedClock uses the same order for one pointer instead of a table.)
//
//   threads  SidUse and close() from any thread and from signal handlers; the rest under one lock
#pragma once

#include <semaphore.h>

#include <atomic>
#include <cstdint>
#include <memory>

#include "../include/libssm.h"
#include "stream.hpp"

namespace dssm::ssm {

struct SidPlace {
  // generation << 1 | open
  std::atomic<std::uint64_t> state{0};
  std::atomic<std::uint32_t> users{0};
  Stream* stream = nullptr;   // owned; does not change while open or in use
  std::uint64_t made_in = 0;  // process generation that opened it
  ssm_header header{};        // what shm_get_address() shows
  std::uint64_t index = 0;
  SidPlace* next_free = nullptr;
};

class SidTable {
 public:
  // `wake` is posted when there is something to reap.
  explicit SidTable(sem_t& wake) noexcept : wake_(wake) {}

  // A new sid for the stream; 0 when 2^20 are open.
  SSM_sid add(std::unique_ptr<Stream> stream, std::uint64_t process_generation);

  // Marks the stream closed; nothing for a sid that is not open.
  void close(SSM_sid sid) noexcept;

  // Destroys the streams that are closed and whose use count is 0. Those of another process
  // generation belong to the parent and are kept.
  void reap(std::uint64_t process_generation);

  // In a forked child.
  void reset_after_fork() noexcept;

 private:
  friend class SidUse;
  static constexpr std::uint64_t kIndexBits = 20, kGenerationBits = 26, kChunk = 256;

  SidPlace* place(SSM_sid sid) const noexcept;
  static std::uint64_t generation(SSM_sid sid) noexcept;
  void leave(SidPlace& place) noexcept;
  template <class Visit>
  void for_each(Visit visit) noexcept;

  sem_t& wake_;
  std::atomic<SidPlace*> chunks_[(1 << kIndexBits) / kChunk]{};
  std::uint64_t used_ = 0;  // places ever used
  SidPlace* free_ = nullptr;
  Stream* abandoned_ = nullptr;  // keeps the parent's streams reachable for leak checkers
};

// Holds a use of the stream during a call: the stream is not destroyed before this object.
class SidUse {
 public:
  explicit SidUse(SSM_sid sid) noexcept;
  SidUse(const SidUse&) = delete;
  SidUse& operator=(const SidUse&) = delete;
  ~SidUse();

  explicit operator bool() const noexcept { return place_ != nullptr; }
  Stream* operator->() const noexcept { return place_->stream; }
  Stream& operator*() const noexcept { return *place_->stream; }

  // Whether the sid was closed meanwhile.
  bool closed() const noexcept { return (place_->state.load() & 1) == 0; }
  ssm_header& header() const noexcept { return place_->header; }

 private:
  SidTable& table_;
  SidPlace* place_;
};

}  // namespace dssm::ssm
