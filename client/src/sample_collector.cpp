// SPDX-License-Identifier: Apache-2.0
//
// SampleCollector: a thread that copies what a PConnector receives into a ring of this process. The
// ring is written as dssmd writes a mirror. No thread sleeps on it, so it has no bell.
#include <poll.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <dssm/sample_collector.hpp>
#include <thread>

#include "core/base/check.hpp"
#include "core/base/quiet_thread.hpp"
#include "core/base/time.hpp"
#include "core/base/try.hpp"
#include "core/ring/ring_memory.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/slot_writer.hpp"

namespace dssm {
namespace detail {

using RingPointer = std::shared_ptr<const ring::RingMapping>;

struct SampleCollectorState {
  SampleCollectorState(PConnector from, RingPointer to, std::function<void(const Error&)> observer)
      : connector(std::move(from)), mapping(std::move(to)), on_error(std::move(observer)) {}
  SampleCollectorState(const SampleCollectorState&) = delete;
  SampleCollectorState& operator=(const SampleCollectorState&) = delete;
  ~SampleCollectorState();

  void collect();
  bool wait_for_samples();
  ring::RingReader reader() const noexcept { return ring::RingReader(*mapping); }
  // The same, for reading into `payload`.
  ring::RingReader reader(std::span<std::byte> payload) const noexcept {
    DSSM_CHECK(payload.size() == mapping->geometry().payload_bytes);
    return reader();
  }

  PConnector connector;  // of the thread
  const RingPointer mapping;
  const std::function<void(const Error&)> on_error;
  const pid_t owner_pid = ::getpid();
  UniqueFd stop_fd{::eventfd(0, EFD_CLOEXEC)};  // readable when the thread must end
  std::atomic<std::uint64_t> lost{0}, restarts{0};
  std::thread thread;
};

SampleCollectorState::~SampleCollectorState() {
  if (!thread.joinable()) return;
  if (::getpid() != owner_pid) {  // the thread runs in the parent only
    thread.detach();
    return;
  }
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(stop_fd.get(), &one, sizeof one);
  thread.join();
}

// False: the thread must end.
bool SampleCollectorState::wait_for_samples() {
  pollfd ready[] = {{connector.ready_fd(), POLLIN, 0}, {stop_fd.get(), POLLIN, 0}};
  while (::poll(ready, 2, -1) < 0) continue;
  return ready[1].revents == 0;
}

void SampleCollectorState::collect() {
  // Samples are received elsewhere and then copied into the ring by its own stores: its readers are
  // threads of this process, and must not meet the decoder's plain ones.
  const ring::SlotWriter slots(*mapping);
  std::vector<std::byte> payload(mapping->geometry().payload_bytes);
  Tid offset = 0;  // tids in the ring minus the owner's
  bool failed = false;
  for (;;) {
    SampleInfo info;
    const Result<ReadStatus> status = connector.read_next(payload, info);
    lost.store(connector.lost_samples(), std::memory_order_relaxed);
    if (!status && !failed && on_error) on_error(status.error());
    failed = !status;
    if (!status || *status == ReadStatus::not_yet) {
      if (!wait_for_samples()) return;
    } else if (*status == ReadStatus::restarted) {
      offset = slots.newest() + 1;
      restarts.store(connector.restarts(), std::memory_order_relaxed);
    } else {
      const Tid tid = info.tid + offset;
      slots.begin(tid);
      slots.fill(tid, std::span(payload).first(info.payload_bytes));
      slots.publish({tid, info.time, info.clock_error, info.payload_bytes});
    }
  }
}

namespace {

Result<RingPointer> make_ring(const PConnector& connector, std::uint64_t depth) {
  const auto geometry = DSSM_TRY(ring::Geometry::of(connector.payload_bytes(), depth));
  const ring::RingIdentity identity{connector.id(), connector.incarnation(), connector.cycle(),
                                    connector.type().alignment_bytes};
  const UniqueFd memory = DSSM_TRY(ring::create_ring(identity, geometry));
  DSSM_TRY(ring::reserve(memory.get(), geometry));
  return ring::RingMapping::open_untrusted(memory.get(), ring::Access::read_write);
}

}  // namespace
}  // namespace detail

SampleCollector::SampleCollector(std::unique_ptr<detail::SampleCollectorState> state) noexcept
    : state_(std::move(state)) {}
SampleCollector::SampleCollector(SampleCollector&&) noexcept = default;
SampleCollector& SampleCollector::operator=(SampleCollector&&) noexcept = default;
SampleCollector::~SampleCollector() = default;

Result<SampleCollector> SampleCollector::start(PConnector connector, const Subscription& what,
                                               SampleCollectorOptions options) {
  DSSM_TRY(connector.subscribe(what));
  const std::string attempt = "keep samples of '" + connector.id().str() + "'";
  const std::uint64_t depth = options.depth > 0 ? options.depth : connector.depth();
  auto ring = DSSM_TRY(detail::make_ring(connector, depth), attempt);
  auto state = std::make_unique<detail::SampleCollectorState>(std::move(connector), std::move(ring),
                                                              std::move(options.on_error));
  if (!state->stop_fd) return os_error(attempt);
  state->thread = DSSM_TRY(
      quiet_thread("collected samples", [self = state.get()] { self->collect(); }), attempt);
  return SampleCollector(std::move(state));
}

// --- reading

ReadStatus SampleCollector::read_newest(std::span<std::byte> payload,
                                        SampleInfo& info) const noexcept {
  return state_->reader(payload).read_newest(payload, info);
}

ReadStatus SampleCollector::read_tid(Tid tid, std::span<std::byte> payload,
                                     SampleInfo& info) const noexcept {
  return state_->reader(payload).read(tid, payload, info);
}

ReadStatus SampleCollector::read_at(Time t, std::span<std::byte> payload, SampleInfo& info,
                                    Duration max_age) const noexcept {
  const ring::RingReader reader = state_->reader(payload);
  for (int attempt = 0; attempt < ring::RingReader::kMaxRetries; ++attempt) {
    Tid found = kNoTid;
    if (const ReadStatus status = reader.find(t, found); status != ReadStatus::ok) return status;
    SampleInfo seen;
    const ReadStatus status = reader.read(found, payload, seen);
    if (status == ReadStatus::too_old) continue;  // it was overwritten meanwhile
    if (status == ReadStatus::ok) {
      if (is_stale(t, seen.time, max_age)) return ReadStatus::stale;
      info = seen;
    }
    return status;
  }
  return ReadStatus::lapped;
}

ReadStatus SampleCollector::read_newer(Tid than, std::span<std::byte> payload,
                                       SampleInfo& info) const noexcept {
  return newest_tid() > than ? read_newest(payload, info) : ReadStatus::not_yet;
}

Tid SampleCollector::newest_tid() const noexcept { return state_->reader().newest(); }
Tid SampleCollector::oldest_tid() const noexcept { return state_->reader().oldest(); }

Tid SampleCollector::find(Time t) const noexcept {
  Tid found = kNoTid;
  return state_->reader().find(t, found) == ReadStatus::ok ? found : kNoTid;
}

std::uint64_t SampleCollector::lost_samples() const noexcept {
  return state_->lost.load(std::memory_order_relaxed);
}
std::uint64_t SampleCollector::restarts() const noexcept {
  return state_->restarts.load(std::memory_order_relaxed);
}

const StreamId& SampleCollector::id() const noexcept { return state_->mapping->identity().id; }
std::uint64_t SampleCollector::payload_bytes() const noexcept {
  return state_->mapping->geometry().payload_bytes;
}
std::uint64_t SampleCollector::depth() const noexcept { return state_->mapping->geometry().depth; }

}  // namespace dssm
