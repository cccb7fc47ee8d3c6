// SPDX-License-Identifier: Apache-2.0
//
// Who has which stream open: one entry per successful Create, Open or Offer, until its Close or the
// end of the client's connection. An entry holds its stream, also after the stream was
// removed.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <unordered_map>
#include <vector>

#include "daemon/base/limit_use.hpp"
#include "daemon/streams/action.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {

struct ClientIdentity : Identity {
  ClientNumber number = 0;
};

// Rises with each open; unique, so it serves as the protocol's handle.
using OpenNumber = std::uint64_t;

struct OpenEntry {
  std::shared_ptr<const ClientIdentity> client;
  std::shared_ptr<Stream> stream;
  Role role = Role::reader;
  std::uint32_t tag = 0;
  bool any_host = false;  // opened by a name without a host
  bool creates = false;   // for writing, of another host: may have the stream created there
};

class OpenTable {
 public:
  struct Limits {
    std::uint64_t max_opens = 0;
    std::uint64_t max_opens_per_client = 0;
    MaxShare max_share = {};  // of max_opens
  };
  struct Counts {
    std::uint32_t writers = 0, readers = 0;
  };

  explicit OpenTable(const Limits& limits) : limits_(limits) {}

  void set_limits(const Limits& limits) { limits_ = limits; }  // for new opens
  void add_limits(LimitUses& out) const;

  // Whether `client` may open one more. Fails with limit_exceeded, naming the key.
  Result<void> check_quota(const ClientIdentity& client) const;

  OpenNumber add(OpenEntry entry);

  // Fails with not_found unless `number` is an open of `client`.
  Result<void> remove(ClientNumber client, OpenNumber number);
  // Some of the client's opens, in the order of opening.
  //   crashed  the client ended without closing them: the streams that it wrote or read count it
  //   returns  whether there are more
  bool remove_some(ClientNumber client, bool crashed, std::size_t most);

  Counts counts(const Stream& stream) const;
  bool is_writing(const Stream& stream, ClientNumber client) const;
  bool any_creates(const Stream& stream) const;
  std::vector<StreamUser> users(const Stream& stream) const;  // in the order of opening
  static StreamUser user(const OpenEntry& entry);             // without the host, which is this one

  // The opens of `stream` for reading, in the order of opening.
  struct Reading {
    ClientNumber client = 0;
    OpenNumber number = 0;
    bool any_host = false;
  };
  std::vector<Reading> readers_of(const Stream& stream) const;

  // The open streams of that name and id, of any host: own ones, removed ones, mirrors. Searches
  // all open streams.
  std::vector<std::shared_ptr<const Stream>> open_streams(const std::string& name,
                                                          std::int32_t id) const;

  // In the order of opening.
  const std::map<OpenNumber, OpenEntry>& entries() const noexcept { return entries_; }

 private:
  struct OfStream {
    std::set<OpenNumber> opens;
    Counts counts;
    std::unordered_map<ClientNumber, std::uint32_t> writing, reading;  // how many opens
  };
  void forget(OpenNumber number, bool crashed = false);

  Limits limits_;
  OpenNumber next_ = 1;
  std::map<OpenNumber, OpenEntry> entries_;
  std::unordered_map<ClientNumber, std::set<OpenNumber>> by_client_;
  std::unordered_map<std::uint32_t, std::size_t> by_user_;  // how many; those with limits
  std::unordered_map<const Stream*, OfStream> by_stream_;
};

}  // namespace dssm::daemon
