// SPDX-License-Identifier: Apache-2.0
#include "client/src/open_streams.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <iterator>

#include "core/base/try.hpp"

namespace dssm::detail {
namespace {

// Up to this size a ring's page tables are filled when it is mapped, so that the first lap is as
// fast as the others. Untuned guess: 16 MiB take about 2 ms.
constexpr std::uint64_t kPrefaultBytes = 16U << 20;

void prefault(const ring::RingMapping& mapping) noexcept {
  if (mapping.geometry().total_bytes > kPrefaultBytes) return;
  // Only a hint: an older kernel refuses it, and the pages come when they are touched. Populating
  // for reading would allocate holes, which a ring that was reserved does not have.
  ::madvise(mapping.base(), mapping.geometry().total_bytes,
            mapping.writable() ? MADV_POPULATE_WRITE : MADV_POPULATE_READ);
}

// More than the threads of a process that are inside an open at one time.
constexpr std::size_t kMaxReplacedEarly = 1024;

local::Request offer_request(const OpenStream& stream) {
  local::Request request;
  wire::to_message(stream.id, *request.mutable_offer()->mutable_id());
  request.mutable_offer()->set_for_writing(stream.role == Role::writer);
  request.mutable_offer()->set_tag(stream.tag);
  request.mutable_offer()->set_any_host(stream.requested.host.empty());
  request.mutable_offer()->set_history(stream.history == FetchHistory::at_once);
  return request;
}

// As dssmd sent them with the stream; readers have no doorbell.
std::vector<int> fds_of(const SharedRing& ring, Role role) {
  std::vector<int> fds{ring.ring_fd.get(), ring.bell_fd.get(), ring.meta_fd.get()};
  if (role == Role::writer) fds.push_back(ring.doorbell_fd.get());
  return fds;
}

local::Request close_request(std::uint64_t handle) {
  local::Request request;
  request.mutable_close()->set_handle(handle);
  return request;
}

}  // namespace

// --- rings

Result<std::shared_ptr<const SharedRing>> RingCache::get(std::vector<UniqueFd> fds,
                                                         ring::Access access, bool created) {
  const bool writer = access == ring::Access::read_write;
  if (fds.size() != (writer ? 4 : 3)) {
    return Error{Errc::protocol,
                 fmt::format("dssmd sent {} descriptors with a stream instead of {}", fds.size(),
                             writer ? 4 : 3)};
  }
  struct stat file {};
  if (::fstat(fds[0].get(), &file)) return os_error("look at a ring's file");
  const Key key{file.st_dev, file.st_ino, access};
  const std::lock_guard guard(mutex_);
  std::erase_if(rings_, [](const auto& entry) { return entry.second.expired(); });
  if (auto known = rings_.find(key); known != rings_.end()) {
    if (auto ring = known->second.lock()) {
      // dssmd may have removed the doorbell of an open that has just ended, and made another one.
      // All writers use the descriptor by its number.
      if (writer && ::dup3(fds[3].get(), ring->doorbell_fd.get(), O_CLOEXEC) < 0) {
        return os_error("replace a doorbell");
      }
      return ring;
    }
  }
  auto mapping = DSSM_TRY(ring::RingMapping::open_untrusted(fds[0].get(), access));
  auto bell = DSSM_TRY(ring::Bell::open_untrusted(fds[1].get()));
  if (created) DSSM_TRY(ring::reserve(fds[0].get(), mapping->geometry()));
  prefault(*mapping);
  auto ring = std::make_shared<SharedRing>();
  ring->ring_fd = std::move(fds[0]);
  ring->bell_fd = std::move(fds[1]);
  ring->meta_fd = std::move(fds[2]);
  if (writer) ring->doorbell_fd = std::move(fds[3]);
  ring->mapping = std::move(mapping);
  ring->bell = std::move(bell);
  rings_[key] = ring;
  return std::shared_ptr<const SharedRing>(std::move(ring));
}

// --- open streams

void OpenStream::supersede() const noexcept {
  superseded->store(true, std::memory_order_release);
  ring->bell->notify();
}

Result<void> OpenStreams::add(OpenStream& stream, const Answer& answer) {
  {
    const std::lock_guard guard(mutex_);
    stream.key_ = next_key_++;
    streams_[stream.key_] = &stream;
    if (answer.connection == offered_to_) {  // else offer_all() has begun without this stream
      stream.handle_ = answer.response.opened().handle();
      if (std::erase(replaced_early_, stream.handle_) > 0) stream.supersede();
      return {};
    }
  }
  const Answer offered =
      DSSM_TRY(connection_.call(offer_request(stream), fds_of(*stream.ring, stream.role)));
  const std::uint64_t handle = offered.response.opened().handle();
  {
    const std::lock_guard guard(mutex_);
    if (offered.connection != offered_to_) return {};
    if (stream.handle_ == 0) {
      stream.handle_ = handle;
      return {};
    }
  }
  connection_.post(close_request(handle), offered.connection);  // offer_all() has offered it, too
  return {};
}

void OpenStreams::close(const OpenStream& stream) {
  std::uint64_t handle = 0, connection = 0;
  {
    const std::lock_guard guard(mutex_);
    streams_.erase(stream.key_);
    handle = stream.handle_;
    connection = offered_to_;
  }
  if (handle != 0) connection_.post(close_request(handle), connection);
}

Result<void> OpenStreams::offer_all(NewConnection& connection) {
  std::vector<std::uint64_t> keys;
  {
    const std::lock_guard guard(mutex_);
    offered_to_ = connection.number();
    replaced_early_.clear();
    for (const auto& [key, stream] : streams_) {
      stream->handle_ = 0;
      keys.push_back(key);
    }
  }
  for (const std::uint64_t key : keys) DSSM_TRY(offer(connection, key));
  return {};
}

// Without the mutex while dssmd answers: the stream may be closed meanwhile.
Result<void> OpenStreams::offer(NewConnection& connection, std::uint64_t key) {
  local::Request request;
  std::shared_ptr<const SharedRing> ring;
  std::vector<int> fds;
  {
    const std::lock_guard guard(mutex_);
    const auto entry = streams_.find(key);
    if (entry == streams_.end()) return {};
    request = offer_request(*entry->second);
    ring = entry->second->ring;
    fds = fds_of(*ring, entry->second->role);
  }
  const auto opened = connection.exchange(std::move(request), fds);
  if (!opened && opened.error().code == Errc::unavailable) return opened.error();
  std::uint64_t unused_handle = 0;
  {
    const std::lock_guard guard(mutex_);
    const auto entry = streams_.find(key);
    const bool is_open = entry != streams_.end();
    if (!opened) {
      // Refused: its users keep this ring, which gets nothing more if it is a mirror. Readers
      // continue with the ring that has its name now, as soon as there is one that they may have.
      if (is_open) entry->second->supersede();
    } else if (opened->has_opened()) {
      (is_open ? entry->second->handle_ : unused_handle) = opened->opened().handle();
    }
  }
  if (unused_handle != 0) {
    const auto closed = connection.exchange(close_request(unused_handle));
    if (!closed && closed.error().code == Errc::unavailable) return closed.error();
  }
  return {};
}

void OpenStreams::post_wishes(bool all) {
  std::vector<local::Request> requests;
  {
    const std::lock_guard guard(mutex_);
    for (const auto& [key, stream] : streams_) {
      const bool is_new = stream->wish_is_new.exchange(false);
      if (!is_new && !(all && stream->wishes)) continue;
      local::Request& request = requests.emplace_back();
      wire::to_message(stream->id, *request.mutable_want_history()->mutable_id());
    }
  }
  for (local::Request& request : requests) connection_.post(std::move(request));
}

void OpenStreams::on_replaced(std::uint64_t handle) {
  const std::lock_guard guard(mutex_);
  for (const auto& [key, stream] : streams_) {
    if (stream->handle_ == handle) return stream->supersede();
  }
  // Its open was answered but is not added yet, or it is closed.
  if (replaced_early_.size() < kMaxReplacedEarly) replaced_early_.push_back(handle);
}

}  // namespace dssm::detail
