// SPDX-License-Identifier: Apache-2.0
//
// The stream of an open sid, with a reader and a writer. SSM's open modes do not restrict anything,
// so the one that was not opened with the sid is opened at its first use.
//
// Callbacks get a private copy, which is a complete sample. Others read into the caller's memory:
// small samples by way of the stack, so that a read that fails does not change it; of large ones it
// may hold parts when the writer overtook the read a thousand times.
//
// When the stream restarts (it was removed and recreated, or its owner lost its rings), the reader
// continues with the new ring, and so do loops of old programs: for them tids keep rising, and the
// first sample of the new ring follows the last tid that they got. All tids here are of that kind;
// `offset_` is their distance from the ring's. Reads by tid return the remaining samples of the old
// ring first.
//
//   threads  all functions may be called from any thread, and from a signal handler once the reader
//            and the writer are open. `alone`: no other thread is in such a function now, so that
//            locks are not needed (SidTable::Turn)
#pragma once

#include <atomic>
#include <dssm/session.hpp>
#include <functional>
#include <memory>
#include <span>

#include "signal_safe.hpp"

namespace dssm::ssm {

// Kept with each open, for the lists of edges: the mode given to openSSM in the lower 8 bits.
inline constexpr std::uint32_t kTagEdge = 1U << 8;    // openSSM: an edge of the graph
inline constexpr std::uint32_t kTagHidden = 1U << 9;  // createSSM, and the second end of a sid

class Stream {
 public:
  // Opens a missing end.
  using Connect = Result<Session> (*)();

  Stream(RawWriter writer, Connect connect);
  Stream(RawReader reader, Connect connect);
  Stream(const Stream&) = delete;
  Stream& operator=(const Stream&) = delete;
  ~Stream();

  const StreamId& id() const noexcept { return id_; }
  std::uint64_t data_bytes() const noexcept { return data_bytes_; }
  std::uint64_t depth() const noexcept { return depth_.load(std::memory_order_relaxed); }
  Duration cycle() const noexcept { return Duration(cycle_ns_.load(std::memory_order_relaxed)); }

  // As in RawReader.
  Tid newest(bool alone) noexcept;
  Tid oldest(bool alone) noexcept;

  // A copy of a sample and its stamps. The 64 bytes after its payload are those after the slot's:
  // callbacks of real programs write a few bytes too many, and read as many.
  class Copy {
   public:
    explicit Copy(Stream& stream);
    Copy(const Copy&) = delete;
    Copy& operator=(const Copy&) = delete;
    ~Copy();
    const std::byte* payload() const noexcept { return bytes_; }

   private:
    friend class Stream;
    Stream& stream_;
    std::byte* bytes_;
  };

  // Where a read puts a sample: a Copy, or data_bytes() of the caller's memory.
  class Target {
   public:
    explicit Target(Copy& copy) noexcept : copy_(&copy) {}
    explicit Target(void* data) noexcept : data_(static_cast<std::byte*>(data)) {}

   private:
    friend class Stream;
    Copy* copy_ = nullptr;
    std::byte* data_ = nullptr;
  };

  // As in RawReader; not_yet also when the reader cannot be opened.
  ReadStatus latest(Target out, SampleInfo& info, bool alone) noexcept;
  ReadStatus tid(Tid tid, Target out, SampleInfo& info, bool alone) noexcept;
  ReadStatus at(Time t, Target out, SampleInfo& info, bool alone) noexcept;
  ReadStatus find(Time t, SampleInfo& info, bool alone) noexcept;
  // RawReader::clock_error() of sample `tid`; kUnknownClockError also when it is not held.
  Duration clock_error(Tid tid, bool alone) noexcept;
  // Makes `tid` that of the first sample from there on that is not lost. Returns what
  // RawReader::read_info() says of it.
  ReadStatus skip_lost(Tid& tid, bool alone) noexcept;
  // Other threads may read meanwhile. A new ring ends a wait as well.
  WaitStatus wait_for_tid(Tid tid, MonoTime deadline) noexcept;
  WaitStatus wait_for_sample(Tid tid, MonoTime deadline) noexcept;

  // Writes one sample; kNoTid when the writer cannot be opened or this thread is writing to the
  // stream already, in a callback or in the code that a signal handler interrupted.
  Tid write(const void* data, Time time, bool alone) noexcept;

  // Lets `fill` write into the next slot and publishes it. An exception of `fill` passes through,
  // and the slot is not published.
  Tid write_in_place(const std::function<void(std::byte*)>& fill, Time time, bool alone);

  // In a forked child: locks that other threads of the parent held are free.
  void reset_after_fork() noexcept;

 private:
  template <class Wait>
  WaitStatus wait(MonoTime deadline, Wait wait) noexcept;
  template <class End, class Open>
  End* end_of(std::atomic<End*>& place, ReentrantLock& lock, Open open) noexcept;
  RawReader* reader() noexcept;
  RawWriter* writer() noexcept;
  template <class Read>
  ReadStatus read(Target out, SampleInfo& info, bool alone, Read read) noexcept;
  template <class Read>
  ReadStatus read_into(std::byte* payload, SampleInfo& info, RawReader& open, Read read) noexcept;
  ReadStatus copy_guard(std::byte* copy, Tid ring_tid, RawReader& open) noexcept;
  void follow_ring(RawReader& open) noexcept;
  void on_restart(const RawReader& open) noexcept;
  void on_returned(Tid tid) noexcept;
  Tid offset() const noexcept { return offset_.load(std::memory_order_relaxed); }

  const Connect connect_;
  const StreamId id_;
  const std::uint64_t data_bytes_, payload_bytes_, incarnation_;
  std::atomic<std::uint64_t> depth_;  // this and the next: of the ring that is read now
  std::atomic<std::int64_t> cycle_ns_;

  // Written under the read lock.
  std::atomic<Tid> offset_{0};     // tids here minus the ring's
  std::atomic<Tid> seen_{kNoTid};  // the greatest that the program got
  std::atomic<Tid> read_{kNoTid};  // the last that it read

  ReentrantLock read_lock_, write_lock_;
  std::atomic<RawReader*> reader_{nullptr};  // set once, under its lock; owned
  std::atomic<RawWriter*> writer_{nullptr};
  std::atomic<std::byte*> spare_{nullptr};  // a copy's memory, for the next one
};

}  // namespace dssm::ssm
