// SPDX-License-Identifier: Apache-2.0
//
// The streams that this process has open, and their rings.
//
//   SharedRing   one ring as this process holds it
//   RingCache    all of them: opening a stream a hundred times maps it once
//   OpenStreams  the streams as dssmd knows them: one handle each, on one connection. A new
//                connection begins with offering all their rings, so that a restarted dssmd has
//                them again
#pragma once

#include <atomic>
#include <dssm/stream.hpp>
#include <map>
#include <memory>
#include <mutex>
#include <tuple>
#include <vector>

#include "client/src/daemon_connection.hpp"
#include "core/base/unique_fd.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_memory.hpp"

namespace dssm::detail {

// Descriptors, mapping and bell, shared by all readers or all writers of the stream in the process.
// Immutable once made. The descriptors are kept to offer the ring back to a restarted dssmd.
struct SharedRing {
  UniqueFd ring_fd, bell_fd, meta_fd;
  UniqueFd doorbell_fd;  // writers only
  std::shared_ptr<const ring::RingMapping> mapping;
  std::shared_ptr<ring::Bell> bell;
};

// All rings of a process, by the identity of their files. Thread-safe.
class RingCache {
 public:
  // The shared ring of these descriptors (as in local.proto's Opened: ring, bell, meta, and for
  // writers the doorbell), mapped now or before. `created`: it is new, so take its memory first.
  //   fails  no_memory, protocol
  Result<std::shared_ptr<const SharedRing>> get(std::vector<UniqueFd> fds, ring::Access access,
                                                bool created);

 private:
  using Key = std::tuple<std::uint64_t, std::uint64_t, ring::Access>;  // device, inode, access
  std::mutex mutex_;
  std::map<Key, std::weak_ptr<const SharedRing>> rings_;
};

class Client;

// One stream opened by one reader or writer; closed at dssmd when destroyed.
struct OpenStream {
  OpenStream(std::shared_ptr<Client> opener, StreamId requested_id, StreamId stream,
             TypeInfo payload_type, Role user_role, std::uint32_t user_tag,
             FetchHistory fetch_history, std::shared_ptr<const SharedRing> shared)
      : client(std::move(opener)),
        requested(std::move(requested_id)),
        id(std::move(stream)),
        type(std::move(payload_type)),
        role(user_role),
        tag(user_tag),
        history(fetch_history),
        ring(std::move(shared)) {}
  OpenStream(const OpenStream&) = delete;
  OpenStream& operator=(const OpenStream&) = delete;
  ~OpenStream();

  // Marks that the stream has another ring now, or that dssmd did not take this one, and wakes the
  // readers that sleep on it.
  void supersede() const noexcept;

  const std::shared_ptr<Client> client;
  const StreamId requested;  // as the program named it, perhaps without host
  const StreamId id;
  const TypeInfo type;
  const Role role;
  const std::uint32_t tag;
  const FetchHistory history;
  const std::shared_ptr<const SharedRing> ring;
  // Set once, by supersede(). Shared with the reader's ReadyFd.
  const std::shared_ptr<std::atomic<bool>> superseded = std::make_shared<std::atomic<bool>>(false);
  // Whether the program has read what is missing in the mirror; and since dssmd was told last.
  mutable std::atomic<bool> wishes = false, wish_is_new = false;

 private:
  friend class OpenStreams;
  std::uint64_t key_ = 0;     // unique in OpenStreams, whose mutex guards both
  std::uint64_t handle_ = 0;  // dssmd's, on the last connection offered to; 0: none
};

// Thread-safe; offer_all() is for the thread that connects.
class OpenStreams {
 public:
  explicit OpenStreams(DaemonConnection& connection) : connection_(connection) {}

  // Adds the stream that `answer` opened. If another connection was set up since that answer,
  // offers the ring on it.
  Result<void> add(OpenStream& stream, const Answer& answer);
  // Removes the stream, and closes it at dssmd.
  void close(const OpenStream& stream);

  // Offers all streams on a connection that is being set up.
  //   fails  unavailable: the connection cannot be used, a late answer would be taken for another's
  Result<void> offer_all(NewConnection& connection);
  // Tells dssmd which mirrors' history is read: new wishes, or after a reconnect all.
  void post_wishes(bool all);
  // dssmd has replaced the ring of this handle.
  void on_replaced(std::uint64_t handle);

 private:
  Result<void> offer(NewConnection& connection, std::uint64_t key);

  DaemonConnection& connection_;
  std::mutex mutex_;              // guards all that follows
  std::uint64_t offered_to_ = 0;  // number of the last connection that offer_all() began with
  std::uint64_t next_key_ = 1;
  std::map<std::uint64_t, OpenStream*> streams_;  // by key
  std::vector<std::uint64_t> replaced_early_;     // handles replaced before their add()
};

}  // namespace dssm::detail
