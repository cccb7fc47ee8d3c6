// SPDX-License-Identifier: Apache-2.0
#include "daemon/serve/peer_table.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <optional>
#include <utility>

namespace dssm::daemon {

PeerPlace::PeerPlace(PeerTable& table, PeerAccount& account, MemoryShare share, bool is_configured)
    : table_(&table), account_(&account), is_configured_(is_configured), share_(std::move(share)) {
  if (!is_configured_) ++table_->connections_;
  ++account_->connections;
}

PeerPlace::PeerPlace(PeerPlace&& other) noexcept
    : table_(std::exchange(other.table_, nullptr)),
      account_(other.account_),
      is_configured_(other.is_configured_),
      share_(std::move(other.share_)) {}

PeerPlace::~PeerPlace() {
  share_ = {};  // before its budget goes
  if (table_) table_->leave(*account_, is_configured_);
}

void PeerTable::set_limits(const Limits& limits) {
  limits_ = limits;
  all_.set_limit(limits.all_bytes());
  for (const auto& [peer, account] : accounts_) {
    account->budget.set_limit(limits.max_peer_memory_bytes);
  }
}

void PeerTable::add_limits(LimitUses& out) const {
  std::uint64_t connections = 0, bytes = 0;
  for (const auto& [peer, account] : accounts_) {
    connections = std::max(connections, account->connections);
    bytes = std::max(bytes, account->budget.used());
  }
  out.push_back({"max_connections", connections_, limits_.max_connections, "connections"});
  out.push_back(
      {"max_connections_per_host", connections, limits_.max_connections_per_host, "connections"});
  out.push_back({"max_peer_memory", bytes, limits_.max_peer_memory_bytes, "bytes"});
  out.push_back({"memory of all peers", all_.used(), all_.limit(), "bytes"});
}

bool PeerTable::is_full_for(const std::string& peer, bool encrypted) const {
  const auto found = accounts_.find(peer);
  if (found == accounts_.end()) return false;
  const PeerAccount& account = *found->second;
  return account.connections >= limits_.max_connections_per_host ||
         account.budget.used() + bytes_of(encrypted) > account.budget.limit();
}

Result<PeerPlace> PeerTable::admit(const std::string& peer, bool encrypted, bool is_configured) {
  if (!is_configured && connections_ >= limits_.max_connections) {
    return Error{Errc::limit_exceeded,
                 fmt::format("there are max_connections = {} connections from other hosts already; "
                             "close some or raise the key max_connections",
                             limits_.max_connections)};
  }
  const auto found = accounts_.find(peer);
  if (found != accounts_.end() && found->second->connections >= limits_.max_connections_per_host) {
    return Error{Errc::limit_exceeded,
                 fmt::format("there are max_connections_per_host = {} connections from {} "
                             "already; close some or raise the key max_connections_per_host",
                             limits_.max_connections_per_host, peer)};
  }
  std::unique_ptr<PeerAccount>& account = accounts_[peer];
  if (!account) {
    account = std::make_unique<PeerAccount>(peer, limits_.max_peer_memory_bytes,
                                            is_configured ? nullptr : &all_);
  }
  // The name in `peers` may have been looked up, or the key have changed, since the first one came.
  account->budget.move_to(is_configured ? nullptr : &all_);
  std::optional<MemoryShare> share = account->budget.try_take(bytes_of(encrypted));
  if (share) return PeerPlace(*this, *account, *std::move(share), is_configured);
  Error error{Errc::limit_exceeded,
              fmt::format("no memory is left for a connection from {}: {} are used up; close some "
                          "or raise the key max_peer_memory",
                          peer, peer_memory(account->budget))};
  if (account->connections == 0) accounts_.erase(peer);
  return error;
}

void PeerTable::leave(PeerAccount& account, bool is_configured) {
  if (!is_configured) --connections_;
  if (--account.connections == 0) accounts_.erase(std::string(account.name));
}

}  // namespace dssm::daemon
