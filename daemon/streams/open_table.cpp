// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/open_table.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <utility>

namespace dssm::daemon {

void OpenTable::add_limits(LimitUses& out) const {
  std::size_t most = 0;
  for (const auto& [client, opens] : by_client_) most = std::max(most, opens.size());
  std::size_t of_user = 0;
  for (const auto& [user, opens] : by_user_) of_user = std::max(of_user, opens);
  out.push_back({"max_opens", entries_.size(), limits_.max_opens, "open streams"});
  out.push_back(
      {"max_opens of one user", of_user, limits_.max_share.of(limits_.max_opens), "open streams"});
  out.push_back({"max_opens_per_client", most, limits_.max_opens_per_client, "open streams"});
}

Result<void> OpenTable::check_quota(const ClientIdentity& client) const {
  if (entries_.size() >= limits_.max_opens) {
    return Error{Errc::limit_exceeded,
                 fmt::format("all programs together have max_opens = {} streams open; close some "
                             "or raise the key max_opens",
                             limits_.max_opens)};
  }
  const auto own = by_client_.find(client.number);
  if (own != by_client_.end() && own->second.size() >= limits_.max_opens_per_client) {
    return Error{Errc::limit_exceeded,
                 fmt::format("this program has max_opens_per_client = {} streams open; close some "
                             "or raise the key max_opens_per_client",
                             limits_.max_opens_per_client)};
  }
  const auto of_user = by_user_.find(client.uid);
  if (of_user != by_user_.end() && of_user->second >= limits_.max_share.of(limits_.max_opens)) {
    return Error{Errc::limit_exceeded,
                 fmt::format("programs of {} have {} streams open; close some or raise the key "
                             "max_share: they may open {}% of max_opens = {}",
                             client.account(), of_user->second, limits_.max_share.percent,
                             limits_.max_opens)};
  }
  return {};
}

OpenNumber OpenTable::add(OpenEntry entry) {
  const OpenNumber number = next_++;
  // First the entry, which the others refer to: each may find no memory.
  const OpenEntry& added = entries_.emplace(number, std::move(entry)).first->second;
  by_client_[added.client->number].insert(number);
  if (is_limited(added.client->uid)) ++by_user_[added.client->uid];
  OfStream& of_stream = by_stream_[added.stream.get()];
  of_stream.opens.insert(number);
  ++(added.role == Role::writer ? of_stream.counts.writers : of_stream.counts.readers);
  ++(added.role == Role::writer ? of_stream.writing : of_stream.reading)[added.client->number];
  return number;
}

bool OpenTable::is_writing(const Stream& stream, ClientNumber client) const {
  const auto found = by_stream_.find(&stream);
  return found != by_stream_.end() && found->second.writing.contains(client);
}

bool OpenTable::any_creates(const Stream& stream) const {
  const auto found = by_stream_.find(&stream);
  if (found == by_stream_.end()) return false;
  const std::set<OpenNumber>& opens = found->second.opens;
  return std::any_of(opens.begin(), opens.end(),
                     [this](OpenNumber number) { return entries_.at(number).creates; });
}

Result<void> OpenTable::remove(ClientNumber client, OpenNumber number) {
  const auto own = by_client_.find(client);
  if (own == by_client_.end() || own->second.erase(number) == 0) {
    return Error{Errc::not_found, fmt::format("handle {} is not open on this connection", number)};
  }
  if (own->second.empty()) by_client_.erase(own);
  forget(number);
  return {};
}

bool OpenTable::remove_some(ClientNumber client, bool crashed, std::size_t most) {
  const auto own = by_client_.find(client);
  if (own == by_client_.end()) return false;
  for (; most > 0 && !own->second.empty(); --most) {
    const OpenNumber number = *own->second.begin();
    own->second.erase(own->second.begin());
    forget(number, crashed);
  }
  if (!own->second.empty()) return true;
  by_client_.erase(own);
  return false;
}

void OpenTable::forget(OpenNumber number, bool crashed) {
  const OpenEntry entry = std::move(entries_.extract(number).mapped());
  const auto of_user = by_user_.find(entry.client->uid);
  if (of_user != by_user_.end() && --of_user->second == 0) by_user_.erase(of_user);
  const auto of_stream = by_stream_.find(entry.stream.get());
  of_stream->second.opens.erase(number);
  Counts& counts = of_stream->second.counts;
  const bool is_writer = entry.role == Role::writer;
  --(is_writer ? counts.writers : counts.readers);
  auto& uses = is_writer ? of_stream->second.writing : of_stream->second.reading;
  const auto use = uses.find(entry.client->number);
  if (--use->second == 0) {
    uses.erase(use);
    if (is_writer) entry.stream->remove_doorbell(entry.client->number);
    // Once, however often it had the stream open.
    if (crashed) {
      entry.stream->add_crashed(
          entry.role, fmt::format("{} (pid {})", entry.client->program, entry.client->pid));
    }
  }
  if (of_stream->second.opens.empty()) by_stream_.erase(of_stream);
}

OpenTable::Counts OpenTable::counts(const Stream& stream) const {
  const auto found = by_stream_.find(&stream);
  return found == by_stream_.end() ? Counts{} : found->second.counts;
}

std::vector<StreamUser> OpenTable::users(const Stream& stream) const {
  std::vector<StreamUser> users;
  const auto found = by_stream_.find(&stream);
  if (found == by_stream_.end()) return users;
  for (const OpenNumber number : found->second.opens) users.push_back(user(entries_.at(number)));
  return users;
}

StreamUser OpenTable::user(const OpenEntry& entry) {
  StreamUser user{entry.client->pid, entry.client->uid, entry.client->program, entry.role};
  if (entry.stream->purpose() == Purpose::mirror) user.via = StreamVia::mirror;
  if (entry.stream->purpose() == Purpose::remote_writer) user.via = StreamVia::remote_writer;
  return user;
}

std::vector<OpenTable::Reading> OpenTable::readers_of(const Stream& stream) const {
  std::vector<Reading> readers;
  const auto found = by_stream_.find(&stream);
  if (found == by_stream_.end()) return readers;
  for (const OpenNumber number : found->second.opens) {
    const OpenEntry& entry = entries_.at(number);
    if (entry.role == Role::reader) {
      readers.push_back({entry.client->number, number, entry.any_host});
    }
  }
  return readers;
}

std::vector<std::shared_ptr<const Stream>> OpenTable::open_streams(const std::string& name,
                                                                   std::int32_t id) const {
  std::vector<std::shared_ptr<const Stream>> streams;
  for (const auto& [stream, of_stream] : by_stream_) {
    if (stream->id().name != name || stream->id().id != id) continue;
    streams.push_back(entries_.at(*of_stream.opens.begin()).stream);
  }
  return streams;
}

}  // namespace dssm::daemon
