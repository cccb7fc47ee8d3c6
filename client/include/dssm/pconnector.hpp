// SPDX-License-Identifier: Apache-2.0
//
// PConnector: a stream of another PC for a process without a dssmd on its own PC. It speaks the
// network protocol itself, over one TCP connection (a channel) to the dssmd that owns the stream.
// Where a local dssmd runs, a Session is better: it finds streams by itself and shares one channel
// among all readers.
//
//   threads  one object belongs to one thread at a time. It has no thread of its own: it reads its
//            connection inside the calls, so a subscription that is not asked for a long time stays
//            in the owner's ring, and what the ring then no longer holds is a counted gap
//   cost     a read is one request and its answer: one round trip. Subscribed samples are one
//            receive each while they come one by one, and one for many when they come many at a
//            time; each is copied once, or, when it is large, received where the caller wants it
//   trouble  when the connection breaks, calls reconnect (at most request_timeout, then
//            unavailable; read_next(), post() and ready_fd() never wait for it), subscriptions resume at the
//            tid they had, and posted samples are sent again from where the owner stopped: each is
//            written once, also when the owner's dssmd is killed (but what was under way when a
//            connection broke comes twice if 64 others wrote to the stream since)
//   anew     when the owner's ring was replaced by a new one, whose tids begin anew, the next read
//            returns `restarted`, once; read_next() after all that came of the old ring
//   fork     a child must open a PConnector of its own
//   moved    a moved-from object may only be assigned to or destroyed
#pragma once

#include <cstddef>
#include <dssm/describe.hpp>
#include <dssm/sample.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

namespace detail {
struct PConnectorState;
}

struct PConnectorOptions {
  // Where dssmd listens: "pc2", "10.0.0.2:13776", "[::1]:13776". Without a port $DSSM_PORT, else
  // 13776. Empty: the host in the stream's name, else "127.0.0.1". A name that the system's
  // resolver does not know is looked for in the catalog of this PC's dssmd, when there is one. To
  // look up a name may take seconds, whatever request_timeout says.
  std::string address = {};
  std::string program = {};  // shown on the other side; empty: this program's name
  // How long a call waits for dssmd, to greet and to answer.
  Duration request_timeout = std::chrono::seconds(5);
  // Samples that post() keeps until the owner says that they are written, beyond which the oldest
  // are dropped and counted.
  std::uint64_t max_unsent_samples = 1024;
  std::uint64_t max_unsent_bytes = 64U << 20;
};

// Which samples a subscription brings.
struct Subscription {
  enum class Start : std::uint8_t {
    now,     // what is written from now on
    oldest,  // all that the owner's ring holds, then what is written
    tid,     // from `tid` on, or the oldest held
    time,    // from the newest sample with time <= `time` on, or the oldest held
  };
  Start start = Start::now;
  Tid tid = 0;
  Time time{};
  double max_rate_hz = 0;  // > 0: at most so many per second, the newest one at each time
};

class PConnector {
 public:
  // Connects and opens an existing stream. With `wanted`, fails with type_mismatch unless
  // TypeInfo::check_usable_as(wanted).
  //   fails  no_daemon (nobody listens or answers there), not_found, type_mismatch, protocol,
  //          unavailable, invalid_argument (address)
  static Result<PConnector> open(const StreamId& id, PConnectorOptions options = {},
                                 const TypeInfo* wanted = nullptr);
  // The same, creating the stream there when it does not exist.
  //   fails  besides: limit_exceeded, no_memory
  static Result<PConnector> create(const StreamId& id, const TypeInfo& type, const History& history,
                                   PConnectorOptions options = {});

  // Streams that the dssmd at `options.address` owns.
  static Result<std::vector<StreamInfo>> list_streams(PConnectorOptions options = {});

  PConnector(PConnector&&) noexcept;
  PConnector& operator=(PConnector&&) noexcept;
  ~PConnector();  // sends what was posted, at most for 1 s

  // --- reading: one round trip each
  // `payload` is exactly payload_bytes() long, and unspecified unless the result is ok; `info` is
  // set only when it is.
  //   returns  as RawReader's functions of these names
  //   fails    unavailable, protocol, invalid_argument (size), type_mismatch (the stream
  //            was created anew with another type)
  Result<ReadStatus> read_newest(std::span<std::byte> payload, SampleInfo& info);
  Result<ReadStatus> read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info);
  Result<ReadStatus> read_at(Time t, std::span<std::byte> payload, SampleInfo& info);
  // The newest sample if its tid is above `than`, else not_yet.
  Result<ReadStatus> read_newer(Tid than, std::span<std::byte> payload, SampleInfo& info);

  // kNoTid while nothing is written.
  Result<Tid> newest_tid();
  Result<Tid> oldest_tid();
  // Tid of the newest sample with time <= t; kNoTid when there is none.
  Result<Tid> find(Time t);

  // --- subscription

  // Samples come by themselves from now on, to be taken by read_next(). A second call replaces the
  // first subscription.
  Result<void> subscribe(const Subscription& what);
  Result<void> unsubscribe();  // opens the channel anew; samples under way are dropped

  // Takes the next sample of the subscription, when it has come. A large one that has begun to come
  // is received to its end here, for at most 20 ms; then what has come is put aside.
  //   payload  as above
  //   returns  ok | not_yet | restarted
  //   fails    unavailable (the connection is down; call again, each call does what can be done at
  //            once to have it back), not_found (the stream was removed; call again, it may come
  //            back), invalid_argument (no subscription, size)
  Result<ReadStatus> read_next(std::span<std::byte> payload, SampleInfo& info);

  // Waits until read_next() has something, a failure included that waiting does not mend, or until the
  // monotonic clock reaches `deadline`. `ready` may come when a large sample has only begun to
  // come: after it read_next() may say not_yet. Without a subscription: timeout, at once. While data
  // come fast it looks for them without sleeping, for 30 us at a time: always at 2 GB/s, for 5 % of
  // the time at most at 100 MB/s.
  WaitStatus wait(MonoTime deadline);

  // Samples that the owner's ring no longer held when their turn came, and those that came while
  // this object was waiting for answers and that nobody took: more than 16 MiB of them are not
  // kept.
  std::uint64_t lost_samples() const noexcept;
  // How often the owner's ring was replaced by a new one, whose tids begin anew.
  std::uint64_t restarts() const noexcept;

  // To be polled for reading, after read_next() said not_yet or failed; then call read_next() again. It
  // stands for the connection while there is one, and for the next attempt while there is none. Ask
  // for it before each poll: asking tells it what to wait for.
  int ready_fd() const noexcept;

  // --- writing

  // Writes one sample and waits for its tid in the owner's ring.
  //   fails  unavailable: not acknowledged in time. The sample is kept as if it had been posted,
  //          and sent when the connection is back: do not write it again
  Result<Tid> write(std::span<const std::byte> payload, Time time = WallClock::now(),
                    Duration clock_error = kOwnClockError);

  // Writes one sample without waiting: it is sent, or, while the connection is down or takes no
  // more, kept and sent by a later call of any of these functions, in order. For rate. Who posts
  // faster than the network carries calls flush() now and then, or samples are dropped.
  //   fails  invalid_argument (size)
  Result<void> post(std::span<const std::byte> payload, Time time = WallClock::now(),
                    Duration clock_error = kOwnClockError);

  // Waits until all that was posted is in the owner's ring, at most until `deadline`.
  //   returns  the tid of the last one; kNoTid when nothing was posted
  Result<Tid> flush(MonoTime deadline);

  // Posted samples that were dropped because too many waited to be sent or acknowledged.
  std::uint64_t dropped_samples() const noexcept;

  // --- about the stream

  Result<std::vector<std::byte>> property();
  Result<void> set_property(std::span<const std::byte> property);

  const StreamId& id() const noexcept;  // with its owner's host
  const TypeInfo& type() const noexcept;
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;
  Duration cycle() const noexcept;
  std::uint64_t incarnation() const noexcept;
  bool is_connected() const noexcept;
  const std::string& address() const noexcept;  // connected to, or to be

  // How payloads that came moved inside this process, for tests and benchmarks: by a copy, or
  // received where the caller wants them.
  struct Counters {
    std::uint64_t samples = 0, copied_payload_bytes = 0, direct_payload_bytes = 0;
    std::uint64_t reconnects = 0;
  };
  Counters counters() const noexcept;

 private:
  explicit PConnector(std::unique_ptr<detail::PConnectorState> state) noexcept;
  std::unique_ptr<detail::PConnectorState> state_;
};

}  // namespace dssm
#pragma GCC visibility pop
