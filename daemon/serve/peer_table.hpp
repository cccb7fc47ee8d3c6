// SPDX-License-Identifier: Apache-2.0
//
// The connections over the network, by peer, and the memory that they use. Everything that a peer
// can make grow (frames that wait for it, samples that are received from it, ...) is charged to its
// account, so that one peer cannot use up the memory of the others; and that of all peers but the
// configured ones to one budget, so that many addresses cannot use up the PC's. An address counts
// as a peer unless a certificate says who is there.
#pragma once

#include <algorithm>
#include <cstdint>
#include <dssm/result.hpp>
#include <map>
#include <memory>
#include <string>

#include "daemon/base/limit_use.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/link/history_pace.hpp"

namespace dssm::daemon {

// One peer, while there are connections of it.
struct PeerAccount {
  // all: of which its memory is taken, too; nullptr: none
  PeerAccount(const std::string& its_name, std::uint64_t memory_bytes, MemoryBudget* all)
      : name(its_name),
        budget(all ? MemoryBudget(memory_bytes, *all, its_name) : MemoryBudget(memory_bytes)) {}
  std::string name;  // "10.0.0.2", "host 'pc2'"
  MemoryBudget budget;
  HistoryPace pace;
  std::uint64_t connections = 0;
};

class PeerTable;

// One connection's quota; given back by the destructor. The table outlives it.
class PeerPlace {
 public:
  PeerPlace(PeerPlace&& other) noexcept;
  PeerPlace& operator=(PeerPlace&&) = delete;
  ~PeerPlace();

  MemoryBudget& budget() const noexcept { return account_->budget; }
  HistoryPace& pace() const noexcept { return account_->pace; }

 private:
  friend class PeerTable;
  PeerPlace(PeerTable& table, PeerAccount& account, MemoryShare share, bool is_configured);
  PeerTable* table_;
  PeerAccount* account_;
  bool is_configured_;
  MemoryShare share_;
};

class PeerTable {
 public:
  // Charged for each connection, whatever it does: its objects, and the input that the decoder
  // keeps while the connection is paused; when it is encrypted, besides, what TLS has received and
  // not decrypted, what it has encrypted and not sent, and the certificates.
  static constexpr std::uint64_t kConnectionBytes = 320U << 10;
  static constexpr std::uint64_t kTlsBytes = 224U << 10;

  struct Limits {
    std::uint64_t max_connections = 0;
    std::uint64_t max_connections_per_host = 0;
    std::uint64_t max_peer_memory_bytes = 0;
    std::uint64_t machine_bytes = 0;  // of the PC's memory

    // For all peers together: an eighth of the PC's memory, but enough for kFullPeers.
    std::uint64_t all_bytes() const noexcept {
      return std::max(kFullPeers * max_peer_memory_bytes, machine_bytes / 8);
    }
  };
  // So many can use all of max_peer_memory at the same time.
  static constexpr std::uint64_t kFullPeers = 4;

  explicit PeerTable(const Limits& limits) : limits_(limits), all_(limits.all_bytes()) {}
  PeerTable(const PeerTable&) = delete;
  PeerTable& operator=(const PeerTable&) = delete;

  // For new connections, and for the budgets of existing accounts.
  void set_limits(const Limits& limits);

  void add_limits(LimitUses& out) const;

  // Whether admit() would fail: for all but configured peers, and for this peer in any case.
  bool is_full(bool encrypted = false) const noexcept {
    return connections_ >= limits_.max_connections ||
           all_.used() + bytes_of(encrypted) > all_.limit();
  }
  bool is_full_for(const std::string& peer, bool encrypted) const;

  // A place for one more connection of `peer`: its address without a port or, when its certificate
  // says who it is, that.
  //   is_configured  the host is in the configuration (key peers): it does not count for
  //                  max_connections and in the memory of all peers, so that others cannot keep
  //                  it out
  //   fails  limit_exceeded, naming the key
  Result<PeerPlace> admit(const std::string& peer, bool encrypted = false,
                          bool is_configured = false);

 private:
  friend class PeerPlace;
  void leave(PeerAccount& account, bool is_configured);
  static std::uint64_t bytes_of(bool encrypted) noexcept {
    return kConnectionBytes + (encrypted ? kTlsBytes : 0);
  }
  Limits limits_;
  std::uint64_t connections_ = 0;  // without those of configured peers
  MemoryBudget all_;               // likewise
  std::map<std::string, std::unique_ptr<PeerAccount>> accounts_;
};

}  // namespace dssm::daemon
