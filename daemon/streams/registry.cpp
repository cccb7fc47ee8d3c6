// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/registry.hpp"

#include <fmt/format.h>

#include <algorithm>

#include "core/base/try.hpp"

namespace dssm::daemon {

Result<StreamId> Registry::own_id(StreamId id) const {
  if (!id.host.empty() && id.host != host_) {
    return Error{Errc::not_found,
                 fmt::format("stream '{}' belongs to host '{}', and this dssmd serves host '{}' "
                             "only; leave '@{}' out, or ask the dssmd of that host",
                             id.str(), id.host, host_, id.host)};
  }
  id.host = host_;
  DSSM_TRY(id.check());
  return id;
}

Result<std::shared_ptr<Stream>> Registry::find(const StreamId& id) const {
  const StreamId own = DSSM_TRY(own_id(id));
  const auto found = by_name_.find(Key{own.name, own.id});
  if (found != by_name_.end()) return found->second;
  return Error{Errc::not_found,
               "there is no stream '" + own.str() + "' (`dssmctl ls` lists those that are there)"};
}

void Registry::end_recovery() {
  recovery_ = Recovery::over;
  for (StreamObserver* observer : observers_) observer->on_recovered();
}

bool Registry::may_come_back(const StreamId& id) const {
  // An invalid name is refused at once, and another host's stream is not held by a program here.
  return may_miss_streams() && own_id(id) && !knows(id);
}

void Registry::add_limits(LimitUses& out) const {
  std::uint64_t most = 0;
  for (const auto& [account, streams] : charged_to_) most = std::max(most, streams);
  const std::uint64_t max_memory = budget().limit();
  out.push_back({"max_streams", charged_, limits_.max_streams, "streams"});
  out.push_back({"max_streams of one user or host", most, limits_.max_share.of(limits_.max_streams),
                 "streams"});
  out.push_back({"max_memory", budget().used(), max_memory, "bytes"});
  out.push_back({"max_memory of one user or host", budgets_.most_used(),
                 limits_.max_share.of(max_memory), "bytes"});
}

Result<void> Registry::check_quota(const std::string& account) const {
  if (charged_ >= limits_.max_streams) {
    return Error{Errc::limit_exceeded,
                 fmt::format("there are max_streams = {} streams already, counting those of other "
                             "hosts that are read or written here; remove some (dssmctl rm) or "
                             "raise the key max_streams",
                             limits_.max_streams)};
  }
  const auto charged = charged_to_.find(account);
  if (charged == charged_to_.end() || charged->second < limits_.max_share.of(limits_.max_streams)) {
    return {};
  }
  return Error{
      Errc::limit_exceeded,
      fmt::format("{} has {} streams already, counting those of other hosts; remove some "
                  "(dssmctl rm) or raise the key max_share: it may have {}% of "
                  "max_streams = {}",
                  account, charged->second, limits_.max_share.percent, limits_.max_streams)};
}

void Registry::charge_stream(const std::string& account) {
  if (!account.empty()) ++charged_to_[account];
  ++charged_;
}

void Registry::release_stream(const std::string& account) noexcept {
  --charged_;
  const auto charged = charged_to_.find(account);
  if (charged != charged_to_.end() && --charged->second == 0) charged_to_.erase(charged);
}

Result<RingQuota> Registry::acquire_quota(const std::string& account) {
  DSSM_TRY(check_quota(account));
  return RingQuota(*this, account);
}

Result<OpenedRing> Registry::create(const StreamId& id, const TypeInfo& type,
                                    const History& history, std::int32_t creator_pid,
                                    const std::string& account) {
  const StreamId own = DSSM_TRY(own_id(id));
  const std::string context = "stream '" + own.str() + "'";
  if (const auto found = by_name_.find(Key{own.name, own.id}); found != by_name_.end()) {
    Stream& stream = *found->second;
    DSSM_TRY(stream.type().check_usable_as(type), context);
    if (stream.type().is_less_described_than(type)) {
      DSSM_TRY(describe_as(stream, type), context);
    }
    return OpenedRing{found->second, false};
  }
  DSSM_TRY(check_quota(account), context);
  std::shared_ptr<Stream> stream =
      DSSM_TRY(make(own, type, history, creator_pid, account), context);
  add(stream);
  return OpenedRing{std::move(stream), true};
}

Result<std::shared_ptr<Stream>> Registry::replace(const StreamId& id, const TypeInfo& type,
                                                  const History& history, std::int32_t creator_pid,
                                                  const std::string& account) {
  const std::shared_ptr<Stream> old = DSSM_TRY(find(id));
  const std::string context = "replace stream '" + old->id().str() + "'";
  if (old->account() != account) DSSM_TRY(check_quota(account), context);
  std::shared_ptr<Stream> stream =
      DSSM_TRY(make(old->id(), type, history, creator_pid, account), context);
  DSSM_TRY(remove(old->id()));
  add(stream);
  return stream;
}

Result<std::shared_ptr<Stream>> Registry::make(const StreamId& own, const TypeInfo& type,
                                               const History& history, std::int32_t creator_pid,
                                               const std::string& account) {
  if (history.cycle <= Duration::zero()) {
    return Error{Errc::invalid_argument,
                 fmt::format("its cycle is {} ns; give the expected time between two samples",
                             to_ns(history.cycle))};
  }
  return Stream::create(
      {own, type, history.depth, history.cycle, creator_pid, account, next_order_}, budgets_);
}

Result<std::shared_ptr<Stream>> Registry::adopt_untrusted(const StreamId& id, OfferedFiles files) {
  const StreamId own = DSSM_TRY(own_id(id));
  const std::string context = "stream '" + own.str() + "'";
  if (const auto found = by_name_.find(Key{own.name, own.id}); found != by_name_.end()) {
    if (found->second->is_ring(files.ring.get())) {
      found->second->take_doorbell_untrusted(files.client, std::move(files.doorbell));
      return found->second;
    }
    return Error{Errc::conflict, context +
                                     ": another ring has that name by now; close this one and "
                                     "reopen the stream"};
  }
  std::shared_ptr<Stream> stream =
      DSSM_TRY(Stream::adopt_untrusted(std::move(files), budgets_), context);
  if (stream->id() != own) {
    return Error{Errc::protocol,
                 fmt::format("{}: the offered ring is that of '{}'", context, stream->id().str())};
  }
  DSSM_TRY(check_quota(stream->account()), context);
  return add_adopted(std::move(stream));
}

Result<std::shared_ptr<Stream>> Registry::adopt_stored_untrusted(OfferedFiles files) {
  Result<std::shared_ptr<Stream>> stream = Stream::adopt_untrusted(std::move(files), budgets_);
  if (!stream) return stream;
  DSSM_TRY(check_quota((*stream)->account()));
  const StreamId& id = (*stream)->id();
  // With not_found, the caller would take the stream for removed.
  if (Result<StreamId> own = own_id(id); !own) return Error{Errc::conflict, own.error().message};
  if (by_name_.contains(Key{id.name, id.id})) {
    return Error{Errc::conflict, "stream '" + id.str() + "': another ring has that name"};
  }
  return add_adopted(*std::move(stream));
}

Result<std::shared_ptr<Stream>> Registry::add_adopted(std::shared_ptr<Stream> stream) {
  if (stream->purpose() != Purpose::own) {
    return Error{Errc::protocol, "stream '" + stream->id().str() +
                                     "': the offered ring is a copy for another host"};
  }
  add(stream);
  return stream;
}

Result<void> Registry::remove(const StreamId& id) {
  const std::shared_ptr<Stream> stream = DSSM_TRY(find(id));
  DSSM_TRY(stream->mark_removed(), "stream '" + stream->id().str() + "'");
  by_name_.erase(Key{stream->id().name, stream->id().id});
  in_order_.erase(std::find(in_order_.begin(), in_order_.end(), stream));
  release_stream(stream->account());
  for (StreamObserver* observer : observers_) observer->on_stream_removed(*stream);
  return {};
}

Result<void> Registry::describe(const StreamId& id, const TypeInfo& type, bool replace) {
  const std::shared_ptr<Stream> stream = DSSM_TRY(find(id));
  const std::string context = "describe stream '" + stream->id().str() + "'";
  TypeInfo known = stream->type();
  if (replace) known = {"", known.payload_bytes, known.alignment_bytes, {}};
  DSSM_TRY(known.check_usable_as(type), context);
  if (!known.is_less_described_than(type)) return {};
  DSSM_TRY(describe_as(*stream, type), context);
  return {};
}

Result<void> Registry::describe_as(Stream& stream, const TypeInfo& type) {
  DSSM_TRY(stream.describe_as(type, budgets_.of(stream.account())));
  for (StreamObserver* observer : observers_) observer->on_stream_described(stream);
  return {};
}

Result<void> Registry::set_property(const StreamId& id, const std::string& property,
                                    const std::string& account) {
  const std::shared_ptr<Stream> stream = DSSM_TRY(find(id));
  const std::string context = "stream '" + stream->id().str() + "'";
  if (property.size() > limits_.max_property_bytes) {
    return Error{Errc::limit_exceeded,
                 fmt::format("{}: a property of {} bytes is longer than max_property = {} bytes; "
                             "shorten it or raise the key max_property",
                             context, property.size(), limits_.max_property_bytes)};
  }
  DSSM_TRY(stream->set_property(property, budgets_.of(account)), context);
  for (StreamObserver* observer : observers_) observer->on_property_set(*stream);
  return {};
}

void Registry::add(std::shared_ptr<Stream> stream) {
  in_order_.reserve(in_order_.size() + 1);  // before there is something to undo
  by_name_.emplace(Key{stream->id().name, stream->id().id}, stream);
  charge_stream(stream->account());
  // Streams of an earlier run of dssmd come back in any order; each gets its old place in the list.
  const auto place = std::upper_bound(in_order_.begin(), in_order_.end(), stream->created_order(),
                                      [](std::uint64_t order, const std::shared_ptr<Stream>& s) {
                                        return order < s->created_order();
                                      });
  in_order_.insert(place, stream);
  next_order_ = std::max(next_order_, stream->created_order() + 1);
  for (StreamObserver* observer : observers_) observer->on_stream_added(*stream);
}

}  // namespace dssm::daemon
