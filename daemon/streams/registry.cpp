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
  return Error{Errc::not_found, "there is no stream '" + own.str() +
                                    "'; create it first (`dssmctl ls` lists those that are there)"};
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
  out.push_back({"max_streams", in_order_.size() + other_rings_, limits_.max_streams, "streams"});
  out.push_back({"max_memory", budget_.used(), budget_.limit(), "bytes"});
}

Result<void> Registry::check_quota() const {
  if (by_name_.size() + other_rings_ < limits_.max_streams) return {};
  return Error{
      Errc::limit_exceeded,
      fmt::format("there are max_streams = {} streams already, counting those of other hosts that "
                  "are read or written here; remove some (dssmctl rm) or raise the key max_streams",
                  limits_.max_streams)};
}

Result<RingQuota> Registry::acquire_quota() {
  DSSM_TRY(check_quota());
  return RingQuota(other_rings_);
}

Result<OpenedRing> Registry::create(const StreamId& id, const TypeInfo& type,
                                    const History& history, std::int32_t creator_pid) {
  const StreamId own = DSSM_TRY(own_id(id));
  const std::string context = "stream '" + own.str() + "'";
  if (const auto found = by_name_.find(Key{own.name, own.id}); found != by_name_.end()) {
    DSSM_TRY(found->second->type().check_usable_as(type), context);
    return OpenedRing{found->second, false};
  }
  DSSM_TRY(check_quota(), context);
  std::shared_ptr<Stream> stream = DSSM_TRY(make(own, type, history, creator_pid), context);
  add(stream);
  return OpenedRing{std::move(stream), true};
}

Result<std::shared_ptr<Stream>> Registry::replace(const StreamId& id, const TypeInfo& type,
                                                  const History& history,
                                                  std::int32_t creator_pid) {
  const std::shared_ptr<Stream> old = DSSM_TRY(find(id));
  std::shared_ptr<Stream> stream = DSSM_TRY(make(old->id(), type, history, creator_pid),
                                            "replace stream '" + old->id().str() + "'");
  DSSM_TRY(remove(old->id()));
  add(stream);
  return stream;
}

Result<std::shared_ptr<Stream>> Registry::make(const StreamId& own, const TypeInfo& type,
                                               const History& history, std::int32_t creator_pid) {
  if (history.cycle <= Duration::zero()) {
    return Error{Errc::invalid_argument,
                 fmt::format("its cycle is {} ns; give the expected time between two samples",
                             to_ns(history.cycle))};
  }
  return Stream::create({own, type, history.depth, history.cycle, creator_pid, next_order_},
                        budget_);
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
  DSSM_TRY(check_quota(), context);
  std::shared_ptr<Stream> stream =
      DSSM_TRY(Stream::adopt_untrusted(std::move(files), budget_), context);
  if (stream->id() != own) {
    return Error{Errc::protocol,
                 fmt::format("{}: the offered ring is that of '{}'", context, stream->id().str())};
  }
  return add_adopted(std::move(stream));
}

Result<std::shared_ptr<Stream>> Registry::adopt_stored_untrusted(OfferedFiles files) {
  DSSM_TRY(check_quota());
  Result<std::shared_ptr<Stream>> stream = Stream::adopt_untrusted(std::move(files), budget_);
  if (!stream) return stream;
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
  for (StreamObserver* observer : observers_) observer->on_stream_removed(*stream);
  return {};
}

Result<void> Registry::set_property(const StreamId& id, const std::string& property) {
  const std::shared_ptr<Stream> stream = DSSM_TRY(find(id));
  const std::string context = "stream '" + stream->id().str() + "'";
  if (property.size() > limits_.max_property_bytes) {
    return Error{Errc::limit_exceeded,
                 fmt::format("{}: a property of {} bytes is longer than max_property = {} bytes; "
                             "shorten it or raise the key max_property",
                             context, property.size(), limits_.max_property_bytes)};
  }
  DSSM_TRY(stream->set_property(property, budget_), context);
  return {};
}

void Registry::add(std::shared_ptr<Stream> stream) {
  in_order_.reserve(in_order_.size() + 1);  // before there is something to undo
  by_name_.emplace(Key{stream->id().name, stream->id().id}, stream);
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
