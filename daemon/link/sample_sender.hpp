// SPDX-License-Identifier: Apache-2.0
//
// Sends samples from a ring over a connection. It never waits for the writer, which may overwrite a
// slot at any moment, so each way of sending makes sure that no receiver accepts such a sample:
//
//   copied    small payloads, as many at a time as there are, into whole frames, each checked by
//             its slot's sequence, then sent at once. One copy.
//   in place  large payloads go out straight from their slot by gathered sends. When all bytes are
//             with the kernel, the sequence is checked, and the frame's last field (network.proto,
//             Frame.torn) says whether the sample is valid. Bytes that the socket does not take are
//             copied aside at once and checked then, so that a slow connection does not make the
//             sample void. When the peer's memory is used up, the sample waits in its slot, where
//             it may be overwritten. For a peer without the feature "torn": copied as a whole,
//             checked, then sent. Without MSG_MORE, which made the kernel send up to twice as
//             slowly (docs/benchmarks.md).
//
// The limits between the two were measured on loopback, as processor time of the sending thread per
// sample (2 cores, busy): in runs from a ring larger than the cache, copied and in place take 1.6
// and 1.3 us at 8 KiB, 3.0 and 2.4 us at 16 KiB, 19 and 13 us at 64 KiB. A single sample, still in
// the cache, takes 3.4 and 3.6 us at 16 KiB, 9.0 and 11 us at 64 KiB, 28 and 18 us at 256 KiB: a
// single one pays for the packet of its last field.
//
// Work is cut into slices of kSliceBytes, so that no connection waits long for one large sample. No
// send is larger: while it lasts the kernel keeps what the peer acknowledges aside and frees no
// memory of this connection, so that every byte of a longer send goes into memory that no cache
// holds. Sends of 256 KiB were up to twice as fast as sends of 1 MiB (docs/benchmarks.md).
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <dssm/sample.hpp>

#include "core/ring/ring_reader.hpp"
#include "core/wire/sample_frame.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/link/frame_connection.hpp"

namespace dssm::daemon {

enum class SendStatus : std::uint8_t {
  sent,         // all of it is with the kernel or queued
  torn,         // the same, but it was overwritten meanwhile, and the receiver is notified
  not_in_ring,  // nothing was sent
  blocked,      // the socket is full: on_output_empty() follows
  unfinished,   // call go_on(), in the next turn if this one was long enough
  no_memory,    // a peer without "torn", and no memory left to copy the sample aside
};

// One per connection; mapping and connection outlive it. Use it only while the connection's output
// is empty, or busy().
class SampleSender {
 public:
  static constexpr std::size_t kInPlaceBytes = 16U << 10;    // at least: in place, in a run
  static constexpr std::size_t kMaxCopiedBytes = 64U << 10;  // at most: copied, when it is alone
  static constexpr std::size_t kBatchBytes = 64U << 10;
  static constexpr std::size_t kSliceBytes = 256U << 10;

  struct Options {
    bool may_tear = false;           // the receiver has the feature "torn"
    MemoryBudget* budget = nullptr;  // charged for what is copied aside; outlives the sender
  };

  // Of a payload that is sent in place.
  struct SliceLimits {
    std::size_t most_bytes;  // at once
    bool may_copy;           // else what the socket does not take waits in the slot, for the pace
  };

  struct Counters {
    std::uint64_t samples = 0;
    std::uint64_t torn = 0;
    std::uint64_t copied_payload_bytes = 0;    // in this process
    std::uint64_t in_place_payload_bytes = 0;  // from the slot to the kernel
  };

  SampleSender(const ring::RingMapping& mapping, FrameConnection& connection,
               const Options& options);
  SampleSender(const SampleSender&) = delete;
  SampleSender& operator=(const SampleSender&) = delete;

  // Whether the stream's samples may be so long that they are sent in place.
  bool sends_in_place() const noexcept { return payload_bytes_ >= kInPlaceBytes; }

  // Sends sample `tid`; `serial` as in Frame. After `blocked` or `unfinished` with busy(): go_on().
  //   more_follow  the next one is in the ring already
  SendStatus send(Tid tid, std::uint64_t serial, bool more_follow,
                  const SliceLimits& limits = {kSliceBytes, true});

  // Small payloads only: sends samples from `first` to at most `last`. Sets `next` to the tid after
  // the last one that is sent or queued; the status is about the sample `next`, when it is not
  // `sent`.
  SendStatus send_many(Tid first, Tid last, Tid& next);

  // Whether a sample is begun and not complete; no other may be begun then.
  bool busy() const noexcept { return busy_; }
  SendStatus go_on(const SliceLimits& limits = {kSliceBytes, true});

  // After a run of samples, before returning to the loop or sending another frame: sends the bytes
  // that were kept to go out with the next sample.
  void end_run();

  const Counters& counters() const noexcept { return counters_; }
  // As many as were copied or sent in place.
  std::uint64_t payload_bytes() const noexcept {
    return counters_.copied_payload_bytes + counters_.in_place_payload_bytes;
  }

 private:
  SendStatus send_copy(Tid tid, std::uint64_t serial);
  SendStatus begin_in_place(const SampleInfo& info, std::uint64_t serial,
                            const SliceLimits& limits);
  SendStatus send_slice(const SliceLimits& limits);
  bool begin_copying();
  SendStatus copy_slice();
  SendStatus end_copying();
  SendStatus end_sample(bool valid);
  void keep_head(std::span<const std::byte> bytes) noexcept;

  ring::RingReader reader_;
  FrameConnection& connection_;
  Options options_;
  std::size_t payload_bytes_;
  Counters counters_;

  // Bytes that go before the payload: the trailer of the sample before, and the header.
  std::array<std::byte, wire::kTornTrailerBytes + wire::kMaxSampleHeaderBytes> head_{};
  std::size_t head_bytes_ = 0, head_sent_ = 0;

  bool busy_ = false;
  ring::RingReader::Place place_{};
  std::size_t bytes_ = 0;   // of the payload that are to be sent
  std::size_t offset_ = 0;  // of these, sent or copied
  bool copying_ = false;
  RawBytes aside_;
  std::size_t aside_bytes_ = 0;  // filled so far
  MemoryShare share_;
};

}  // namespace dssm::daemon
