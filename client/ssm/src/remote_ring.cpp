// SPDX-License-Identifier: Apache-2.0
#include "remote_ring.hpp"

#include <poll.h>
#include <pthread.h>
#include <signal.h>
#include <sys/eventfd.h>
#include <unistd.h>

#include <algorithm>
#include <vector>

#include "core/base/quiet_thread.hpp"
#include "core/ring/slot_writer.hpp"
#include "messages.hpp"

namespace dssm::ssm {
namespace {

// Programs of the oldest kind ask for "512" and mean samples, where it now means seconds: what is
// kept must not take the machine's memory away.
constexpr std::uint64_t kMaxRingBytes = 512U << 20;

}  // namespace

RemoteRing::RemoteRing(PConnector connector)
    : connector_(std::move(connector)), stop_(::eventfd(0, EFD_CLOEXEC)), owner_pid_(::getpid()) {}

Result<std::unique_ptr<RemoteRing>> RemoteRing::start(PConnector connector,
                                                      const History& history) {
  const std::string what = "keep samples of '" + connector.id().str() + "'";
  const std::uint64_t bytes = connector.payload_bytes();
  const std::uint64_t most = std::max(kMinDepth, kMaxRingBytes / bytes);
  const std::uint64_t depth = std::min(history.depth, most);
  if (depth < history.depth) {
    report_error(what + " : " + std::to_string(depth - 1) + " instead of " +
                 std::to_string(history.depth - 1) + ", which would take more than " +
                 std::to_string(kMaxRingBytes >> 20) + " MiB; ask for less life");
  }
  auto geometry = ring::Geometry::of(bytes, depth);
  if (!geometry) return std::move(geometry).error().context(what);
  const ring::RingIdentity identity{connector.id(), 1, history.cycle,
                                    connector.type().alignment_bytes};
  auto memory = ring::create_ring(identity, *geometry);
  if (!memory) return std::move(memory).error().context(what);
  if (Result<void> done = ring::reserve(memory->get(), *geometry); !done) {
    return std::move(done).error().context(what);
  }
  auto mapping = ring::RingMapping::open_untrusted(memory->get(), ring::Access::read_write);
  if (!mapping) return std::move(mapping).error().context(what);

  std::unique_ptr<RemoteRing> made(new RemoteRing(std::move(connector)));
  if (!made->stop_) return os_error(what);
  made->mapping_ = std::move(*mapping);
  const SignalBlock block;
  const int error = ::pthread_create(&made->thread_, nullptr, &run, made.get());
  if (error) return os_error(what, error);
  made->runs_ = true;
  return made;
}

RemoteRing::~RemoteRing() {
  if (!runs_ || ::getpid() != owner_pid_) return;
  const std::uint64_t one = 1;
  [[maybe_unused]] const ssize_t written = ::write(stop_.get(), &one, sizeof one);
  ::pthread_join(thread_, nullptr);
}

void* RemoteRing::run(void* self) {
  static_cast<RemoteRing*>(self)->fill();
  return nullptr;
}

// Waits until there may be something to take. False: the thread shall end.
bool RemoteRing::pause() {
  pollfd ready[] = {{connector_.ready_fd(), POLLIN, 0}, {stop_.get(), POLLIN, 0}};
  while (::poll(ready, 2, -1) < 0) continue;
  return ready[1].revents == 0;
}

void RemoteRing::fill() {
  // Samples are received beside the ring and then copied into it as its readers expect it; they are
  // in the same process, and must not meet the decoder's plain stores.
  const ring::SlotWriter ring(*mapping_);
  std::vector<std::byte> payload(mapping_->geometry().payload_bytes);
  Tid offset = 0;  // the ring's tids are so far ahead of the stream's
  bool complained = false;
  for (;;) {
    SampleInfo info;
    const auto status = connector_.read_next(payload, info);
    if (!status && !complained) report_error(status.error().message + "; trying again");
    complained = !status;
    if (!status || *status == ReadStatus::not_yet) {
      if (!pause()) return;
    } else if (*status == ReadStatus::restarted) {
      offset = ring.newest() + 1;
    } else {
      const Tid tid = info.tid + offset;
      ring.begin(tid);
      ring.fill(tid, payload);
      ring.publish(tid, info.time, info.clock_error);
    }
  }
}

}  // namespace dssm::ssm
