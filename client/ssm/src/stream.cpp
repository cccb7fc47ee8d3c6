// SPDX-License-Identifier: Apache-2.0
#include "stream.hpp"

#include <sys/mman.h>

#include <algorithm>
#include <cstring>
#include <ctime>
#include <mutex>
#include <new>

#include "convert.hpp"
#include "core/base/time.hpp"
#include "messages.hpp"

namespace dssm::ssm {
namespace {

// After a copy as after a slot: callbacks of real programs read and write a few bytes too many.
constexpr std::size_t kGuardBytes = 64;

// Memory for copies comes from the system and not from the heap: a handler that reads while its own
// thread reads needs a second one, and may have interrupted malloc().
std::byte* new_copy(std::size_t payload_bytes) {
  void* const memory = ::mmap(nullptr, payload_bytes + kGuardBytes, PROT_READ | PROT_WRITE,
                              MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (memory == MAP_FAILED) throw std::bad_alloc();
  return static_cast<std::byte*>(memory);
}

void free_copy(std::byte* copy, std::size_t payload_bytes) noexcept {
  if (copy) ::munmap(copy, payload_bytes + kGuardBytes);
}

// Samples up to here are read by way of the stack.
constexpr std::size_t kSmallBytes = 1024;

// A reader that the writer overtakes this often during one read cannot keep up.
constexpr int kAttempts = 1000;

// The rings that this thread is writing to: a signal handler that interrupts a write must not wait
// for the lock that its own thread holds.
class Writing {
 public:
  explicit Writing(std::uint64_t ring) noexcept : ring_(ring), outer_(innermost) {
    for (const Writing* write = outer_; write; write = write->outer_) {
      allowed_ = allowed_ && write->ring_ != ring;
    }
    innermost = this;
  }
  Writing(const Writing&) = delete;
  Writing& operator=(const Writing&) = delete;
  ~Writing() { innermost = outer_; }
  explicit operator bool() const noexcept { return allowed_; }

 private:
  static constinit thread_local const Writing* innermost;
  const std::uint64_t ring_;
  const Writing* const outer_;
  bool allowed_ = true;
};
constinit thread_local const Writing* Writing::innermost = nullptr;

}  // namespace

Stream::Stream(RawWriter writer, Connect connect)
    : connect_(connect),
      id_(writer.id()),
      data_bytes_(ssm::data_bytes(writer.type())),
      payload_bytes_(writer.payload_bytes()),
      incarnation_(writer.incarnation()),
      depth_(writer.depth()),
      cycle_ns_(to_ns(writer.cycle())),
      writer_(new RawWriter(std::move(writer))) {}

Stream::Stream(RawReader reader, Connect connect)
    : connect_(connect),
      id_(reader.id()),
      data_bytes_(ssm::data_bytes(reader.type())),
      payload_bytes_(reader.payload_bytes()),
      incarnation_(reader.incarnation()),
      depth_(reader.depth()),
      cycle_ns_(to_ns(reader.cycle())),
      reader_(new RawReader(std::move(reader))) {}

Stream::~Stream() {
  delete reader_.load();
  delete writer_.load();
  free_copy(spare_.load(), payload_bytes_);
}

// The end in `place`; opened by `open` if it is not yet open. Null, with the reason kept for
// errSSM(), if it cannot be opened.
template <class End, class Open>
End* Stream::end_of(std::atomic<End*>& place, ReentrantLock& lock, Open open) noexcept {
  if (End* end = place.load(std::memory_order_acquire)) return end;
  const std::lock_guard guard(lock);
  if (End* end = place.load(std::memory_order_relaxed)) return end;
  Result<Session> session = connect_();
  Result<End> opened = session ? open(*session) : std::move(session).error();
  if (!opened) return remember_error(opened.error().message), nullptr;
  // NOLINTNEXTLINE(bugprone-unhandled-exception-at-new): without memory the process ends
  place.store(new End(std::move(*opened)), std::memory_order_release);
  return place.load(std::memory_order_relaxed);
}

RawReader* Stream::reader() noexcept {
  return end_of(reader_, read_lock_, [&](Session& session) {
    return session.open_raw_reader(id_, nullptr, kTagHidden, FetchHistory::at_once);
  });
}

RawWriter* Stream::writer() noexcept {
  return end_of(writer_, write_lock_, [&](Session& session) {
    return session.open_raw_writer(id_, nullptr, kTagHidden);
  });
}

// --- tids

void Stream::on_returned(Tid tid) noexcept {
  if (tid > seen_.load(std::memory_order_relaxed)) seen_.store(tid, std::memory_order_relaxed);
}

void Stream::on_restart(const RawReader& open) noexcept {
  offset_.store(seen_.load(std::memory_order_relaxed) + 1, std::memory_order_relaxed);
  depth_.store(open.depth(), std::memory_order_relaxed);
  cycle_ns_.store(to_ns(open.cycle()), std::memory_order_relaxed);
}

// Continues with the new ring, if there is one.
void Stream::follow_ring(RawReader& open) noexcept {
  BorrowedSample nothing;
  if (open.borrow(kNoTid, nothing) == ReadStatus::restarted) on_restart(open);
}

Tid Stream::newest(bool alone) noexcept {
  RawReader* const open = reader_.load(std::memory_order_acquire);
  if (!open) return writer_.load(std::memory_order_acquire)->newest_tid();
  const LockUnlessAlone guard(read_lock_, alone);
  // A program that reads one sample after the other may not have read all of the old ring yet.
  const Tid read = read_.load(std::memory_order_relaxed);
  if (read == kNoTid || open->newest_tid() + offset() <= read) follow_ring(*open);
  const Tid newest = open->newest_tid();
  if (newest < 0) return offset() - 1;  // kNoTid, or the last one of the old ring
  on_returned(newest + offset());
  return newest + offset();
}

Tid Stream::oldest(bool alone) noexcept {
  const Tid top = newest(alone);
  if (top < 0) return kNoTid;
  const RawReader* const open = reader_.load(std::memory_order_acquire);
  if (!open) return std::max<Tid>(0, top - static_cast<Tid>(depth()) + 2);
  const LockUnlessAlone guard(read_lock_, alone);
  const Tid oldest = open->oldest_tid();
  return oldest < 0 ? top : oldest + offset();  // a new ring, still empty: nothing before `top`
}

// --- reading

Stream::Copy::Copy(Stream& stream)
    : stream_(stream), bytes_(stream.spare_.exchange(nullptr, std::memory_order_acquire)) {
  if (!bytes_) bytes_ = new_copy(stream.payload_bytes_);
}

Stream::Copy::~Copy() {
  free_copy(stream_.spare_.exchange(bytes_, std::memory_order_acq_rel), stream_.payload_bytes_);
}

// Repeats read(payload, info) while the stream restarts.
template <class Read>
ReadStatus Stream::read_into(std::byte* payload, SampleInfo& info, RawReader& open,
                             Read read) noexcept {
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    const ReadStatus status = read(open, std::span(payload, payload_bytes_), info);
    if (status == ReadStatus::restarted) {
      on_restart(open);
    } else {
      if (status == ReadStatus::ok) zero_rest({payload, payload_bytes_}, info);
      return status;
    }
  }
  return ReadStatus::lapped;
}

// The bytes after the slot of a sample, which belong to no sample.
ReadStatus Stream::copy_guard(std::byte* copy, Tid ring_tid, RawReader& open) noexcept {
  BorrowedSample place;
  const ReadStatus status = open.borrow(ring_tid, place);
  if (status == ReadStatus::restarted) on_restart(open);
  if (status != ReadStatus::ok) return status;
  std::memcpy(copy + payload_bytes_, place.payload().data() + payload_bytes_, kGuardBytes);
  return place.still_valid() ? ReadStatus::ok : ReadStatus::lapped;
}

template <class Read>
ReadStatus Stream::read(Target out, SampleInfo& info, bool alone, Read read) noexcept {
  RawReader* const open = reader();
  if (!open) return ReadStatus::not_yet;
  const LockUnlessAlone guard(read_lock_, alone);
  ReadStatus status = ReadStatus::lapped;
  if (out.copy_) {
    for (int attempt = 0; attempt < kAttempts; ++attempt) {
      status = read_into(out.copy_->bytes_, info, *open, read);
      if (status != ReadStatus::ok) return status;
      status = copy_guard(out.copy_->bytes_, info.tid, *open);
      if (status == ReadStatus::ok) break;
    }
  } else if (payload_bytes_ > kSmallBytes) {
    status = read_into(out.data_, info, *open, read);
  } else {
    alignas(64) std::byte payload[kSmallBytes];  // as slots are: no copy crosses a cache line
    status = read_into(payload, info, *open, read);
    if (status == ReadStatus::ok) std::memcpy(out.data_, payload, data_bytes_);
  }
  if (status != ReadStatus::ok) return status;
  info.tid += offset();
  on_returned(info.tid);
  read_.store(info.tid, std::memory_order_relaxed);
  return ReadStatus::ok;
}

ReadStatus Stream::latest(Target out, SampleInfo& info, bool alone) noexcept {
  return read(out, info, alone,
              [](RawReader& open, std::span<std::byte> payload, SampleInfo& seen) {
                return open.read_newest(payload, seen);
              });
}

ReadStatus Stream::tid(Tid tid, Target out, SampleInfo& info, bool alone) noexcept {
  return read(out, info, alone,
              [&](RawReader& open, std::span<std::byte> payload, SampleInfo& seen) {
                const Tid wanted = tid - offset();
                if (wanted < 0) return ReadStatus::too_old;
                SampleInfo stamp;
                if (open.read_info(wanted, stamp) == ReadStatus::lost) return ReadStatus::lost;
                for (int attempt = 0; attempt < kAttempts; ++attempt) {
                  // Not by RawReader::read_tid(), which leaves the old ring at once.
                  open.seek(wanted - 1);
                  const ReadStatus status = open.read_next(payload, seen);
                  if (status != ReadStatus::ok || seen.tid == wanted) return status;
                  if (wanted < open.oldest_tid()) return ReadStatus::too_old;
                  // A signal handler that reads too moved the cursor in between.
                }
                return ReadStatus::lapped;
              });
}

ReadStatus Stream::at(Time t, Target out, SampleInfo& info, bool alone) noexcept {
  return read(out, info, alone,
              [t](RawReader& open, std::span<std::byte> payload, SampleInfo& seen) {
                return open.read_at(t, payload, seen);
              });
}

ReadStatus Stream::find(Time t, SampleInfo& info, bool alone) noexcept {
  RawReader* const open = reader();
  if (!open) return ReadStatus::not_yet;
  const LockUnlessAlone guard(read_lock_, alone);
  follow_ring(*open);
  const ReadStatus status = open->find(t, info);
  if (status == ReadStatus::ok) on_returned(info.tid += offset());
  return status;
}

Duration Stream::clock_error(Tid tid, bool alone) noexcept {
  RawReader* const open = reader();
  if (!open) return kUnknownClockError;
  const LockUnlessAlone guard(read_lock_, alone);
  follow_ring(*open);
  SampleInfo info;
  return open->read_info(tid - offset(), info) == ReadStatus::ok ? open->clock_error(info)
                                                                 : kUnknownClockError;
}

ReadStatus Stream::skip_lost(Tid& tid, bool alone) noexcept {
  RawReader* const open = reader();
  if (!open) return ReadStatus::not_yet;
  const LockUnlessAlone guard(read_lock_, alone);
  SampleInfo info;
  ReadStatus status = open->read_info(tid - offset(), info);
  for (; status == ReadStatus::lost; status = open->read_info(tid - offset(), info)) ++tid;
  return status;
}

// Without a lock: a wait for a given tid uses nothing of the reader that reading changes.
template <class Wait>
WaitStatus Stream::wait(MonoTime deadline, Wait wait) noexcept {
  if (RawReader* const open = reader()) return wait(*open);
  // Nothing to sleep on; the caller checks again.
  const timespec sleep = timespec_of(deadline - MonoClock::now());
  return ::nanosleep(&sleep, nullptr) == 0 ? WaitStatus::timeout : WaitStatus::interrupted;
}

WaitStatus Stream::wait_for_tid(Tid tid, MonoTime deadline) noexcept {
  return wait(deadline,
              [&](RawReader& open) { return open.wait_for_tid(tid - offset(), deadline); });
}

WaitStatus Stream::wait_for_sample(Tid tid, MonoTime deadline) noexcept {
  return wait(deadline,
              [&](RawReader& open) { return open.wait_for_sample(tid - offset(), deadline); });
}

// --- writing

Tid Stream::write(const void* data, Time time, bool alone) noexcept {
  RawWriter* const open = writer();
  if (!open) return kNoTid;
  static constexpr std::byte kNothing{};
  const auto* bytes = data_bytes_ > 0 ? static_cast<const std::byte*>(data) : &kNothing;
  const Writing writing(incarnation_);
  if (!writing) return kNoTid;
  const LockUnlessAlone guard(write_lock_, alone);
  return open->write({bytes, payload_bytes_}, time);
}

Tid Stream::write_in_place(const std::function<void(std::byte*)>& fill, Time time, bool alone) {
  RawWriter* const open = writer();
  if (!open) return kNoTid;
  const Writing writing(incarnation_);
  if (!writing) return kNoTid;
  const LockUnlessAlone guard(write_lock_, alone);
  LoanedSample loan = open->loan();
  if (!loan) return kNoTid;
  fill(loan.payload().data());
  return loan.publish(time);
}

void Stream::reset_after_fork() noexcept {
  read_lock_.reset_after_fork();
  write_lock_.reset_after_fork();
}

}  // namespace dssm::ssm
