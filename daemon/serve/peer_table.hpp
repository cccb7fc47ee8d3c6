// SPDX-License-Identifier: Apache-2.0
//
// The connections over the network, by peer, and the memory that they use. Everything that a peer
// can make grow (frames that wait for it, samples that are received from it, ...) is charged to its
// account, so that one peer cannot use up the memory of the others. An address counts as a peer
// unless a certificate says who is there.
#pragma once

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
  PeerAccount(std::string its_name, std::uint64_t memory_bytes)
      : name(std::move(its_name)), budget(memory_bytes) {}
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
  };

  explicit PeerTable(const Limits& limits) : limits_(limits) {}
  PeerTable(const PeerTable&) = delete;
  PeerTable& operator=(const PeerTable&) = delete;

  // For new connections, and for the budgets of existing accounts.
  void set_limits(const Limits& limits);

  void add_limits(LimitUses& out) const;

  // Whether admit() would fail: for all but configured peers, and for this peer in any case.
  bool is_full() const noexcept { return connections_ >= limits_.max_connections; }
  bool is_full_for(const std::string& peer, bool encrypted) const;

  // A place for one more connection of `peer`: its address without a port or, when its certificate
  // says who it is, that.
  //   is_configured  the host is in the configuration (key peers): it does not count for
  //                  max_connections, so that others cannot keep it out
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
  std::map<std::string, std::unique_ptr<PeerAccount>> accounts_;
};

}  // namespace dssm::daemon
