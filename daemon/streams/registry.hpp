// SPDX-License-Identifier: Apache-2.0
//
// The streams that this host owns, by name. One thread, no sockets: Rights have allowed what is
// asked here.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <map>
#include <memory>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "daemon/base/limit_use.hpp"
#include "daemon/base/memory_budget.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

// Notified of streams that are added and removed.
class StreamObserver {
 public:
  virtual void on_stream_added(const Stream& stream) = 0;
  virtual void on_stream_removed(const Stream& stream) = 0;
  // It has a description now.
  virtual void on_stream_described(const Stream&) {}
  // It has another property now, or none.
  virtual void on_property_set(const Stream&) {}
  // No stream of the dssmd before this one comes back any more.
  virtual void on_recovered() {}

 protected:
  ~StreamObserver() = default;
};

class Registry;

// One ring's share of max_streams, for a ring that is not in the Registry: a mirror's, a remote
// writer's. Held while the object exists. The registry outlives it.
class RingQuota {
 public:
  RingQuota(RingQuota&& other) noexcept
      : registry_(std::exchange(other.registry_, nullptr)), account_(std::move(other.account_)) {}
  RingQuota& operator=(RingQuota&&) = delete;
  inline ~RingQuota();

  const std::string& account() const noexcept { return account_; }  // that is charged

 private:
  friend class Registry;
  inline RingQuota(Registry& registry, std::string account);
  Registry* registry_;
  std::string account_;
};

class Registry {
 public:
  struct Limits {
    std::uint64_t max_streams = 0;
    std::uint64_t max_memory_bytes = 0;
    std::uint64_t max_property_bytes = 0;
    MaxShare max_share = {};  // of the first two
  };

  Registry(std::string host, const Limits& limits)
      : host_(std::move(host)),
        limits_(limits),
        budgets_(limits.max_memory_bytes, limits.max_share) {}
  Registry(const Registry&) = delete;
  Registry& operator=(const Registry&) = delete;

  // For new streams; existing ones stay.
  void set_limits(const Limits& limits) {
    limits_ = limits;
    budgets_.set_limit(limits.max_memory_bytes, limits.max_share);
  }

  // Notified in the order in which they were added. Each outlives the registry or is removed
  // before; none is added or removed by an observer.
  void add_observer(StreamObserver& observer) { observers_.push_back(&observer); }
  void remove_observer(StreamObserver& observer) { std::erase(observers_, &observer); }

  void add_limits(LimitUses& out) const;

  const std::string& host() const noexcept { return host_; }

  // After a restart of dssmd, programs say again which streams they have open, and give those back
  // that dssmd has not. Until all have had the time, the names of streams that are missing are
  // neither refused nor given to others, and no ring is taken for unused.
  enum class Recovery : std::uint8_t {
    over,
    opens,    // all streams are here
    streams,  // some may be missing
  };
  void begin_recovery(Recovery from) noexcept { recovery_ = from; }
  void end_recovery();
  Recovery recovery() const noexcept { return recovery_; }
  bool may_miss_streams() const noexcept { return recovery_ == Recovery::streams; }
  // Whether a stream of that name is missing and may still come back: who asks has to wait.
  bool may_come_back(const StreamId& id) const;
  const MemoryBudget& budget() const noexcept { return budgets_.total(); }

  // For rings that are not in the registry (mirrors, remote writers) but count like those that are.
  // The registry outlives the quotas.
  //   account  who is charged, as Identity::account(); empty: no one but all
  MemoryBudgets& budgets() noexcept { return budgets_; }
  // Fails with limit_exceeded, naming the key.
  Result<RingQuota> acquire_quota(const std::string& account = {});

  // In the order of creation.
  const std::vector<std::shared_ptr<Stream>>& streams() const noexcept { return in_order_; }

  // The stream of that name; a host in `id` must be this one.
  //   fails  not_found
  Result<std::shared_ptr<Stream>> find(const StreamId& id) const;
  bool knows(const StreamId& id) const { return find(id).has_value(); }

  // Creates a stream, or gives the one of that name when the type fits, which takes what its
  // description lacks from `type`.
  //   fails  invalid_argument, type_mismatch, limit_exceeded, os errors
  Result<OpenedRing> create(const StreamId& id, const TypeInfo& type, const History& history,
                            std::int32_t creator_pid, const std::string& account = {});

  // Creates a stream in place of the one of that name, which is removed when nothing can fail any
  // more.
  //   fails  not_found, invalid_argument, limit_exceeded, os errors; then the old one stays
  Result<std::shared_ptr<Stream>> replace(const StreamId& id, const TypeInfo& type,
                                          const History& history, std::int32_t creator_pid,
                                          const std::string& account);

  // Takes back a stream that a client kept while no dssmd ran. Returns the registered stream when
  // it has the same ring.
  //   fails  conflict (another ring has that name), protocol, no_permission, limit_exceeded
  Result<std::shared_ptr<Stream>> adopt_untrusted(const StreamId& id, OfferedFiles files);

  // The same of a stream that the service manager kept; its files name it.
  //   fails  also not_found (the stream was removed)
  Result<std::shared_ptr<Stream>> adopt_stored_untrusted(OfferedFiles files);

  // The name is free at once; programs that have the stream open keep its ring.
  //   fails  not_found
  Result<void> remove(const StreamId& id);

  // Gives a stream the name and fields of `type`, as far as it has none.
  //   replace  also those that it has: only the size must be that of the stream
  //   fails    not_found, type_mismatch, limit_exceeded, os errors
  Result<void> describe(const StreamId& id, const TypeInfo& type, bool replace);

  //   fails  not_found, limit_exceeded
  Result<void> set_property(const StreamId& id, const std::string& property,
                            const std::string& account = {});

 private:
  friend class RingQuota;
  using Key = std::pair<std::string, std::int32_t>;
  Result<StreamId> own_id(StreamId id) const;
  Result<void> check_quota(const std::string& account) const;
  void charge_stream(const std::string& account);
  void release_stream(const std::string& account) noexcept;
  Result<std::shared_ptr<Stream>> make(const StreamId& own, const TypeInfo& type,
                                       const History& history, std::int32_t creator_pid,
                                       const std::string& account);
  Result<void> describe_as(Stream& stream, const TypeInfo& type);
  Result<std::shared_ptr<Stream>> add_adopted(std::shared_ptr<Stream> stream);
  void add(std::shared_ptr<Stream> stream);

  std::string host_;
  Recovery recovery_ = Recovery::over;
  Limits limits_;
  MemoryBudgets budgets_;      // before the streams, which hold shares of them
  std::uint64_t charged_ = 0;  // streams, and rings that hold a RingQuota; and by account:
  std::map<std::string, std::uint64_t> charged_to_;
  std::map<Key, std::shared_ptr<Stream>> by_name_;
  std::vector<std::shared_ptr<Stream>> in_order_;
  std::uint64_t next_order_ = 1;
  std::vector<StreamObserver*> observers_;
};

inline RingQuota::RingQuota(Registry& registry, std::string account)
    : registry_(&registry), account_(std::move(account)) {
  registry.charge_stream(account_);
}

inline RingQuota::~RingQuota() {
  if (registry_) registry_->release_stream(account_);
}

}  // namespace dssm::daemon
