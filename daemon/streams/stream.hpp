// SPDX-License-Identifier: Apache-2.0
//
// One ring of this host: its memory files and what dssmd knows about it. A stream that this host
// owns exists as long as it is in the Registry or a program has it open; mirrors and the rings of
// remote writers as long as their tables hold them. Memory that a program has mapped stays valid
// after that.
//
// dssmd never reads a payload here, and of the rings only the newest stamps, to report the stream's
// state.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/channel/channel_client.hpp"
#include "core/ring/bell.hpp"
#include "core/ring/ring_memory.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/streams/memory_files.hpp"

namespace dssm::daemon {

// A type's description may be this long, as dssm.local.Type: dssmd keeps it in its own memory.
inline constexpr std::size_t kMaxTypeBytes = 64 << 10;

// A local connection in this run of dssmd; rises, never used twice. 0: none.
using ClientNumber = std::uint64_t;

// What a client offers of a stream that it held through a restart of dssmd.
struct OfferedFiles {
  UniqueFd ring, bell, meta;
  UniqueFd doorbell;  // may be missing
  ClientNumber client = 0;
  bool may_create = false;  // the client has the right to create the stream, of another host
};

// Notified of a stream's doorbells: eventfds that its writers write to while the ring requests it.
class DoorbellObserver {
 public:
  virtual void on_doorbell_added(int fd) = 0;  // open until it is removed
  virtual void on_doorbell_removed(int fd) = 0;

 protected:
  ~DoorbellObserver() = default;
};

// What dssmd uses a ring for.
enum class Purpose : std::uint8_t {
  own,            // the stream is this host's
  mirror,         // repeats the ring of another host; no program gets it for writing
  remote_writer,  // what programs write to it is published into the stream of another host
};

using channel::CreatePlan;

class Stream;

// A ring of this host that a program or channel may use now: of an own stream, a mirror or a remote
// writer.
struct OpenedRing {
  std::shared_ptr<Stream> stream;  // its id names the owner's host
  bool created = false;            // this open created the owner's stream
};

class Stream : public std::enable_shared_from_this<Stream> {
 public:
  struct Plan {
    StreamId id;  // with host
    TypeInfo type;
    std::uint64_t depth = 0;
    Duration cycle{};
    std::int32_t creator_pid = 0;
    std::string account = {};  // of the creator: who is charged, as Identity::account()
    std::uint64_t created_order = 0;
    Purpose purpose = Purpose::own;
    std::uint64_t incarnation = 0;  // a mirror's is its owner's; 0: a new one
  };

  // Creates the memory files, none of whose memory is taken yet but for three pages: the client
  // that asked reserves the ring's.
  static Result<std::shared_ptr<Stream>> create(const Plan& plan, MemoryBudgets& budgets);

  // Restores a stream from its memory files, after checking owner, seals, geometry, and that ring
  // and meta file agree. For clients' offers and DescriptorStore.
  static Result<std::shared_ptr<Stream>> adopt_untrusted(OfferedFiles files,
                                                         MemoryBudgets& budgets);

  Stream(const Stream&) = delete;
  Stream& operator=(const Stream&) = delete;
  // The memory of a ring from kFreedElsewhereBytes on is freed by a thread of its own.
  ~Stream();
  static constexpr std::uint64_t kFreedElsewhereBytes = 16U << 20;

  const StreamId& id() const noexcept { return plan_.id; }
  const TypeInfo& type() const noexcept { return plan_.type; }
  // Takes name, alignment and fields of `type`, which type().check_usable_as() accepts. What
  // programs have open keeps its description.
  //   fails  limit_exceeded, os errors; then nothing has changed
  Result<void> describe_as(const TypeInfo& type, MemoryBudget& budget);
  std::int32_t creator_pid() const noexcept { return plan_.creator_pid; }
  const std::string& account() const noexcept { return plan_.account; }
  std::uint64_t created_order() const noexcept { return plan_.created_order; }
  Purpose purpose() const noexcept { return plan_.purpose; }
  std::uint64_t incarnation() const noexcept { return mapping_->identity().incarnation; }

  // All but the users and whether programs of this host can write to it, and with the writers and
  // readers of its channels only. Reads the newest stamps of the ring.
  //   with_fields  else the type comes without its fields
  //   now          this PC's clock: the state and age are those of this moment
  StreamInfo info(bool with_fields = true, Time now = WallClock::now()) const;

  // Descriptors to hand out, in the order of local.proto's Opened; the caller's own. For a client
  // that writes and has no doorbell, one is made.
  Result<std::vector<UniqueFd>> descriptors_for(Role role, ClientNumber client = 0);

  // All that restores this stream; the stream keeps them open. The doorbells are given back by
  // those that have them.
  static constexpr std::size_t kKept = 3;
  std::vector<int> descriptors_to_keep() const;

  // The ring for dssmd itself: for reading, for writing (mirrors), and its bell.
  //   fails  protocol: a program that may write has overwritten the header. Its geometry then says
  //          where samples go, and could lead out of the ring
  const ring::RingMapping& mapping() const noexcept { return *mapping_; }
  Result<std::shared_ptr<const ring::RingMapping>> map_for_writing() const;
  Result<std::shared_ptr<ring::Bell>> map_bell() const;

  // Takes memory of the ring from the system: `bytes` from `offset` on, inside the ring. For 4 MiB
  // about a millisecond.
  //   fails  no_memory
  Result<void> reserve(std::uint64_t offset, std::uint64_t bytes);

  // Whether `fd` is this stream's ring.
  bool is_ring(int fd) const noexcept;

  // Each client that writes has a doorbell of its own. With one for all, a program could clear
  // O_NONBLOCK, which belongs to all descriptors of a file, and fill the counter: the others would
  // wait in write(2) for ever.

  // Takes the doorbell that a client kept over a restart of dssmd, in place of another one that it
  // has here. Drops it if it is no eventfd.
  void take_doorbell_untrusted(ClientNumber client, UniqueFd doorbell);
  // The client has ended all its opens for writing.
  void remove_doorbell(ClientNumber client);

  // Reports each doorbell, existing ones at once. At most one observer; nullptr: none.
  void observe_doorbells(DoorbellObserver* observer);

  Result<std::string> property() const;
  Result<void> set_property(const std::string& property, MemoryBudget& budget);

  // The connections of other hosts and of remote programs that carry this stream now, in the order
  // of opening.
  struct Channel {
    const void* key = nullptr;
    // The programs that use the stream over it; more may be counted than are named.
    std::vector<StreamUser> users = {};
    std::uint32_t writers = 0, readers = 0;
    bool states_users = true;  // false: of an older dssmd, which may write unseen
  };
  const std::vector<Channel>& channels() const noexcept { return channels_; }
  // Adds one, or replaces what is known of its users.
  void set_channel(Channel channel);
  void remove_channel(const void* key);

  // A program that had it open in that role has ended without closing it.
  void add_crashed(Role role, std::string program) {
    Crashed& crashed = role == Role::writer ? crashed_writers_ : crashed_readers_;
    ++crashed.programs;
    crashed.last = std::move(program);
  }

  // No later offer restores it.
  Result<void> mark_removed();
  bool removed() const noexcept { return removed_; }

 private:
  struct Files {
    UniqueFd ring, bell;
  };
  struct Crashed {
    std::uint32_t programs = 0;
    std::string last;
  };
  struct Doorbell {
    ClientNumber client;
    UniqueFd fd;
  };
  Stream(Plan plan, Files files, MetaFile meta, std::shared_ptr<const ring::RingMapping> mapping,
         MemoryShare ring_share, MemoryShare type_share)
      : plan_(std::move(plan)),
        files_(std::move(files)),
        meta_(std::move(meta)),
        mapping_(std::move(mapping)),
        ring_share_(std::move(ring_share)),
        type_share_(std::move(type_share)) {}
  std::vector<Doorbell>::iterator doorbell_of(ClientNumber client);
  void add_doorbell(ClientNumber client, UniqueFd doorbell);

  Plan plan_;
  Files files_;
  std::vector<Doorbell> doorbells_;
  MetaFile meta_;
  std::shared_ptr<const ring::RingMapping> mapping_;  // read-only
  MemoryShare ring_share_, type_share_, property_share_;
  bool removed_ = false;
  std::vector<Channel> channels_;
  Crashed crashed_writers_, crashed_readers_;
  DoorbellObserver* doorbell_observer_ = nullptr;
};

}  // namespace dssm::daemon
