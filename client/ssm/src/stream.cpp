// SPDX-License-Identifier: Apache-2.0
#include "stream.hpp"

#include <sys/mman.h>

#include <algorithm>
#include <cstring>
#include <ctime>
#include <mutex>
#include <new>

#include "messages.hpp"

namespace dssm::ssm {
namespace {

// Behind a copy as behind a slot: callbacks of real programs go a few bytes too far.
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

// A reader that the writer overtakes this often between two looks is not keeping up.
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
  static thread_local const Writing* innermost;
  const std::uint64_t ring_;
  const Writing* const outer_;
  bool allowed_ = true;
};
thread_local const Writing* Writing::innermost = nullptr;

}  // namespace

Stream::Stream(RawWriter writer, Connect connect)
    : connect_(connect),
      id_(writer.id()),
      data_bytes_(ssm::data_bytes(writer.type())),
      payload_bytes_(writer.payload_bytes()),
      depth_(writer.depth()),
      incarnation_(writer.incarnation()),
      cycle_(writer.cycle()),
      writer_(new RawWriter(std::move(writer))) {}

Stream::Stream(RawReader reader, Connect connect)
    : connect_(connect),
      id_(reader.id()),
      data_bytes_(ssm::data_bytes(reader.type())),
      payload_bytes_(reader.payload_bytes()),
      depth_(reader.depth()),
      incarnation_(reader.incarnation()),
      cycle_(reader.cycle()),
      reader_(new RawReader(std::move(reader))) {}

Stream::~Stream() {
  delete reader_.load();
  delete writer_.load();
  free_copy(spare_.load(), payload_bytes_);
}

RawReader* Stream::reader() noexcept {
  if (RawReader* open = reader_.load(std::memory_order_acquire)) return open;
  const std::lock_guard guard(read_lock_);
  if (RawReader* open = reader_.load(std::memory_order_relaxed)) return open;
  Result<Session> session = connect_();
  if (!session) return remember_error(session.error().message), nullptr;
  Result<RawReader> opened = session->open_raw_reader(id_, nullptr, kTagHidden);
  if (!opened) return remember_error(opened.error().message), nullptr;
  reader_.store(new RawReader(std::move(*opened)), std::memory_order_release);
  return reader_.load(std::memory_order_relaxed);
}

RawWriter* Stream::writer() noexcept {
  if (RawWriter* open = writer_.load(std::memory_order_acquire)) return open;
  const std::lock_guard guard(write_lock_);
  if (RawWriter* open = writer_.load(std::memory_order_relaxed)) return open;
  Result<Session> session = connect_();
  if (!session) return remember_error(session.error().message), nullptr;
  Result<RawWriter> opened = session->open_raw_writer(id_, nullptr, kTagHidden);
  if (!opened) return remember_error(opened.error().message), nullptr;
  writer_.store(new RawWriter(std::move(*opened)), std::memory_order_release);
  return writer_.load(std::memory_order_relaxed);
}

Tid Stream::newest() const noexcept {
  if (const RawReader* open = reader_.load(std::memory_order_acquire)) return open->newest();
  return writer_.load(std::memory_order_acquire)->newest();
}

Tid Stream::oldest() const noexcept {
  const Tid top = newest();
  const Tid oldest = top - static_cast<Tid>(depth_) + 2;
  return top < 0 ? kNoTid : oldest < 0 ? 0 : oldest;
}

// --- reading
// ---------------------------------------------------------------------------------------

Stream::Copy::Copy(Stream& stream)
    : stream_(stream), bytes_(stream.spare_.exchange(nullptr, std::memory_order_acquire)) {
  if (!bytes_) bytes_ = new_copy(stream.payload_bytes_);
}

Stream::Copy::~Copy() {
  free_copy(stream_.spare_.exchange(bytes_, std::memory_order_acq_rel), stream_.payload_bytes_);
}

template <class Read>
ReadStatus Stream::copy(Copy& out, Read read) noexcept {
  RawReader* const open = reader();
  if (!open) return ReadStatus::not_yet;
  const std::lock_guard guard(read_lock_);
  for (int attempt = 0; attempt < kAttempts; ++attempt) {
    if (const ReadStatus status = read(*open); status != ReadStatus::ok) return status;
    BorrowedSample place;  // the bytes behind the slot belong to nobody, so they are there to read
    if (open->borrow(out.info.tid, place) != ReadStatus::ok) continue;
    std::memcpy(out.bytes_ + payload_bytes_, place.payload().data() + payload_bytes_, kGuardBytes);
    if (place.still_valid()) return ReadStatus::ok;
  }
  return ReadStatus::lapped;
}

ReadStatus Stream::latest(Copy& out) noexcept {
  return copy(out, [&](RawReader& open) { return open.latest(out.payload(), out.info); });
}

ReadStatus Stream::tid(Tid tid, Copy& out) noexcept {
  return copy(out, [&](RawReader& open) { return open.tid(tid, out.payload(), out.info); });
}

ReadStatus Stream::at(Time t, Copy& out) noexcept {
  return copy(out, [&](RawReader& open) { return open.at(t, out.payload(), out.info); });
}

ReadStatus Stream::find(Time t, SampleInfo& info) noexcept {
  RawReader* const open = reader();
  if (!open) return ReadStatus::not_yet;
  const std::lock_guard guard(read_lock_);
  return open->find(t, info);
}

WaitStatus Stream::wait_for_tid(Tid tid, MonoTime deadline) noexcept {
  RawReader* const open = reader();
  if (!open) {  // nothing to sleep on; the caller looks again
    const Duration rest = std::max(Duration(0), deadline - MonoClock::now());
    const timespec sleep{to_ns(rest) / 1'000'000'000, to_ns(rest) % 1'000'000'000};
    return ::nanosleep(&sleep, nullptr) == 0 ? WaitStatus::timeout : WaitStatus::interrupted;
  }
  // Without the lock, so that other threads may read meanwhile: a wait for a given tid uses nothing
  // of the reader that reading changes.
  return open->wait_for_tid(tid, deadline);
}

// --- writing
// ---------------------------------------------------------------------------------------

Tid Stream::write(const void* data, Time time) noexcept {
  RawWriter* const open = writer();
  if (!open) return kNoTid;
  static constexpr std::byte kNothing{};
  const auto* bytes = data_bytes_ > 0 ? static_cast<const std::byte*>(data) : &kNothing;
  const Writing writing(incarnation_);
  if (!writing) return kNoTid;
  const std::lock_guard guard(write_lock_);
  return open->write({bytes, payload_bytes_}, time);
}

Tid Stream::write_in_place(const std::function<void(std::byte*)>& fill, Time time) {
  RawWriter* const open = writer();
  if (!open) return kNoTid;
  const Writing writing(incarnation_);
  if (!writing) return kNoTid;
  const std::lock_guard guard(write_lock_);
  Loan loan = open->loan();
  if (!loan) return kNoTid;
  fill(loan.payload().data());
  return loan.publish(time);
}

void Stream::reset_after_fork() noexcept {
  read_lock_.reset_after_fork();
  write_lock_.reset_after_fork();
}

}  // namespace dssm::ssm
