// SPDX-License-Identifier: Apache-2.0
//
// PConnector: a stream of another PC for a process without a dssmd on its own PC. It speaks the
// network protocol itself, over one TCP connection (a channel) to the dssmd that owns the stream.
// Where a local dssmd runs, use a Session: it finds streams by itself and shares one channel among
// all readers of the PC.
//
//   threads     one object belongs to one thread at a time. It has no thread of its own: it reads
//               its connection inside the calls. Samples of a subscription that is not read for
//               long stay in the owner's ring; what the ring no longer holds then is a counted gap
//   cost        a read is one request and its answer: one round trip. Subscribed samples are
//               received one by one while they arrive singly, many at once when they arrive fast;
//               each is copied once, a large one is received directly into the caller's memory.
//               A SampleCollector receives them in a thread, for reads that need no round trip
//   connection  when the connection breaks, calls reconnect: for at most request_timeout, then they
//               fail with unavailable; read_next(), post() and ready_fd() never wait for it.
//               Subscriptions resume at their tid. Posted samples that the owner has not written
//               are sent again; each is written once, also when the owner's dssmd is killed. (Only
//               if 64 other programs have written to the stream since may a sample that was being
//               sent when the connection broke be written twice)
//   restart     when the owner's ring was replaced by a new one, whose tids start at 0 again, the
//               next read returns `restarted`, once; read_next() after all samples of the old ring
//               that had arrived
//   fork        a child must open a PConnector of its own
//   moved       a moved-from object may only be assigned to or destroyed
//   errors      each function names its own; all that return a Result may also fail with
//               unavailable (no answer within request_timeout) and protocol
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

namespace dssm::detail {
struct PConnectorState;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

struct PConnectorOptions {
  // Where dssmd listens: "pc2", "10.0.0.2:13776", "[::1]:13776". Without a port $DSSM_PORT, else
  // 13776. Empty: the host in the stream's name, else "127.0.0.1". A name that the system's
  // resolver does not know is searched in the catalog of this PC's dssmd, if there is one. Looking
  // a name up may take seconds, independent of request_timeout.
  std::string address = {};
  std::string program = {};  // shown on the other side; empty: this program's name
  // Folder of the files that encrypted connections need (ca.crt, own.crt, own.key, revoked.crl;
  // `dssmctl pki` makes them). Empty: $DSSM_CREDENTIALS; without that, for other PCs only,
  // ~/.config/dssm/credentials if it exists. Without any of them connections are not encrypted.
  // Files that have changed are read again when a connection is made.
  std::string credentials = {};
  // For create(): as in CreateOptions.
  bool keep_existing = false;
  // How long a call waits for dssmd's greeting and answer.
  Duration request_timeout = std::chrono::seconds(5);
  // Samples that post() keeps until the owner acknowledges that they are written. Beyond either
  // limit the oldest are dropped and counted.
  std::uint64_t max_unsent_samples = 1024;
  std::uint64_t max_unsent_bytes = 64U << 20;  // each counts as long as the stream's longest
};

// Which samples a subscription delivers.
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
  // > 0: at most so many per second, the newest one each time, however little the network carries.
  // 0: all, in their order: where the network carries less than is written, they come late.
  double max_rate_hz = 0;
  // A value for max_rate_hz: each time that the network takes a sample, the newest one; also first,
  // whatever `start` is. What is left out is not counted as lost. Of samples that are written
  // within a millisecond some may be left out on any network. A program that reads late first gets
  // what its connection holds.
  static constexpr double kNewestOnly = 1e6;
};

class PConnector {
 public:
  // Connects and opens an existing stream.
  //   wanted  not null: TypeInfo::check_usable_as(*wanted) must succeed
  //   fails   no_daemon (nothing listens or answers there), not_found, type_mismatch,
  //           invalid_argument (address, name)
  static Result<PConnector> open(const StreamId& id, PConnectorOptions options = {},
                                 const TypeInfo* wanted = nullptr);
  // The same; creates the stream there, or opens or replaces the existing one, as
  // Session::create_raw() says.
  //   fails  also: limit_exceeded, no_memory, conflict, invalid_argument (type, history)
  static Result<PConnector> create(const StreamId& id, const TypeInfo& type, const History& history,
                                   PConnectorOptions options = {});

  // The streams that the dssmd at `options.address` owns.
  //   fails  no_daemon, invalid_argument (address)
  static Result<std::vector<StreamInfo>> list_streams(const PConnectorOptions& options = {});

  PConnector(PConnector&&) noexcept;
  PConnector& operator=(PConnector&&) noexcept;
  ~PConnector();  // sends posted samples, for at most 1 s

  // --- reading: one round trip each

  // `payload` is exactly payload_bytes() long. Its first info.payload_bytes are the sample; the
  // rest, and all of it unless the result is ok, is unspecified. `info` is set only when the result
  // is ok.
  //   returns  as RawReader's functions of these names
  //   fails    invalid_argument (size of `payload`), type_mismatch (the stream was recreated with
  //            another type)
  Result<ReadStatus> read_newest(std::span<std::byte> payload, SampleInfo& info);
  Result<ReadStatus> read_tid(Tid tid, std::span<std::byte> payload, SampleInfo& info);
  Result<ReadStatus> read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                             Duration max_age = kAnyAge);
  // The newest sample if its tid is above `than`, else not_yet.
  Result<ReadStatus> read_newer(Tid than, std::span<std::byte> payload, SampleInfo& info);

  // The tids of the newest and of the oldest readable sample; kNoTid while nothing is written.
  Result<Tid> newest_tid();
  Result<Tid> oldest_tid();
  // Tid of the newest sample with time <= t; kNoTid when there is none.
  Result<Tid> find(Time t);

  // --- subscription

  // From now on the owner sends samples, which read_next() returns. A second call replaces the
  // first subscription.
  //   fails  unavailable, and what the owner answers: not_found, clock_out_of_bounds ...
  Result<void> subscribe(const Subscription& what);
  // Ends the subscription and reconnects; samples that are on their way are dropped.
  Result<void> unsubscribe();

  // Copies the next sample of the subscription if it has arrived. A large sample that has arrived
  // in part is received to its end, for at most 20 ms; later calls continue with it.
  //   payload  as above
  //   returns  ok | not_yet | restarted
  //   fails    unavailable (not connected; each further call takes those steps of reconnecting that
  //            need no waiting), not_found (the stream was removed; further calls succeed once it
  //            is recreated), invalid_argument (no subscription, size of `payload`)
  Result<ReadStatus> read_next(std::span<std::byte> payload, SampleInfo& info);

  // Waits until read_next() has a sample or an error that is not retryable to return, until the
  // monotonic clock reaches `deadline`, or for `timeout`. It also returns `ready` when a large
  // sample has arrived in part: read_next() may then return not_yet. Without a subscription it
  // returns timeout at once. While data arrive fast it polls instead of sleeping, for up to 30 us
  // at a time: always at 2 GB/s, for at most 5 % of the time at 100 MB/s.
  WaitStatus wait(MonoTime deadline);
  WaitStatus wait(Duration timeout) { return wait(deadline_in(timeout)); }

  // Samples of the subscription that were lost: the owner's ring no longer held them when they were
  // to be sent; or they arrived while a call waited for an answer, and more than 16 MiB of such
  // samples were not read, where each counts as long as the stream's longest.
  std::uint64_t lost_samples() const noexcept;
  // How often the owner's ring was replaced by a new one.
  std::uint64_t restarts() const noexcept;

  // A descriptor to poll for reading after read_next() returned not_yet or failed; when it is
  // readable, call read_next() again. It covers the connection and, while there is none, the time
  // of the next attempt. Call ready_fd() before each poll: the call sets what it waits for. Owned
  // by this object; do not read or close it.
  int ready_fd() const noexcept;

  // --- writing

  // Writes one sample and waits until the owner acknowledges it.
  //   payload, time, clock_error  as RawWriter::write()
  //   returns  its tid in the owner's ring
  //   fails    invalid_argument (size of `payload`), unavailable (not acknowledged in time: the
  //            sample is kept like a posted one and sent after reconnecting; do not write it again)
  Result<Tid> write(std::span<const std::byte> payload, Time time = WallClock::now(),
                    Duration clock_error = kOwnClockError);

  // Writes one sample without waiting, for high rates. While the connection is down or its buffers
  // are full, the sample is kept and sent by a later call of any function, in order. A program that
  // posts faster than the network transports must call flush() at times, or samples are dropped.
  //   fails  invalid_argument (size of `payload`)
  Result<void> post(std::span<const std::byte> payload, Time time = WallClock::now(),
                    Duration clock_error = kOwnClockError);

  // Waits until the owner has acknowledged all posted samples, at most until `deadline` or for
  // `timeout`.
  //   returns  the tid of the last one; kNoTid when nothing was posted
  //   fails    unavailable (not all acknowledged by then; they are kept and sent later)
  Result<Tid> flush(MonoTime deadline);
  Result<Tid> flush(Duration timeout) { return flush(deadline_in(timeout)); }

  // Posted samples that were dropped because a limit of the options was reached.
  std::uint64_t dropped_samples() const noexcept;

  // --- about the stream

  // As Session's functions of these names; one round trip each.
  Result<std::vector<std::byte>> property();
  Result<void> set_property(std::span<const std::byte> property);

  const StreamId& id() const noexcept;  // with its owner's host
  const TypeInfo& type() const noexcept;
  std::uint64_t payload_bytes() const noexcept;
  std::uint64_t depth() const noexcept;
  Duration cycle() const noexcept;
  std::uint64_t incarnation() const noexcept;
  // Whether the connection was up when the last call ended.
  bool is_connected() const noexcept;
  // The address that it is connected to, or that it tried last: "10.0.0.2:13776".
  const std::string& address() const noexcept;

  // What this object has received since it was opened.
  struct Counters {
    std::uint64_t samples = 0;               // by reads and by the subscription
    std::uint64_t copied_payload_bytes = 0;  // of them, received into a buffer and then copied
    std::uint64_t direct_payload_bytes = 0;  // of them, received directly into the caller's memory
    std::uint64_t reconnects = 0;            // connections after the first one
  };
  Counters counters() const noexcept;

 private:
  explicit PConnector(std::unique_ptr<detail::PConnectorState> state) noexcept;
  std::unique_ptr<detail::PConnectorState> state_;
};

}  // namespace dssm
#pragma GCC visibility pop
