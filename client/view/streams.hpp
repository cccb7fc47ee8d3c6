// SPDX-License-Identifier: Apache-2.0
//
// The streams that clients ask for, of the vehicle or of a recording: each is open once for all
// clients, and closed when none asked for it for half a minute. All calls come from the server's
// thread; opening, which may wait for dssmd or for another host, is done by a worker.
#pragma once

#include <cstdint>
#include <dssm/recording.hpp>
#include <dssm/session.hpp>
#include <functional>
#include <map>
#include <optional>
#include <string>
#include <utility>
#include <variant>
#include <vector>

#include "client/view/server.hpp"
#include "client/view/worker.hpp"

namespace dssm::view {

// What is shown: the vehicle, or a recording.
using Source = std::variant<Session, Recording>;
using StreamReader = std::variant<RawReader, RecordedRawReader>;  // of a stream of it

// A stream that is open.
struct OpenStream {
  explicit OpenStream(StreamReader opened);

  // Whether its own type has no fields, which may be known otherwise: live streams only.
  bool is_undescribed() const;
  // To be called when a read returned `restarted`: type and fields may be others now.
  void follow_restart();

  const TypeInfo& type() const;

  StreamReader reader;
  TypeInfo obvious;  // of the programs that have it open, or given by `dssmctl describe` since
  std::vector<Field> fields;  // readable ones; empty: its payload is not described
};

// The result of `read`, a read of a recording, which tells once of each change of the incarnation.
// Here that does not matter: the type stays.
template <class Read>
ReadStatus past_restarts(Read read) {
  ReadStatus status = read();
  while (status == ReadStatus::restarted) status = read();
  return status;
}

// The time of the oldest sample that is readable; of a mirror, this fetches the history that is not
// here.
std::optional<Time> oldest_time(const RawReader& reader);

class Streams {
 public:
  // `server` outlives it.
  Streams(Source source, Server& server) : source_(std::move(source)), server_(server) {}

  // The stream of that full name, or nullptr: it is being opened, or could not be. That is tried
  // again with each call, once a second at most.
  struct Found {
    OpenStream* stream = nullptr;  // until close_unused()
    std::string error;             // empty: it is being opened
  };
  Found find(const std::string& name);

  // Calls `done`, in this thread, with the property that the stream has; of a recording, had at `t`
  // (empty: at its end).
  //   fails  invalid_argument (not a stream's name), not_found (no such stream, or no property),
  //          limit_exceeded (too many are asked for), and as Session::property() and
  //          Recording::property()
  using PropertyDone = std::function<void(const Result<std::vector<std::byte>>&)>;
  void ask_property(const std::string& name, std::optional<Time> t, PropertyDone done);

  // The time of the oldest sample of a stream that is open here; nothing for another one, nor for a
  // mirror for whose history no program has asked. `host`: this PC's.
  std::optional<Time> known_oldest(const StreamInfo& stream, const std::string& host) const;

  // Closes what was not found for long.
  void close_unused();

 private:
  static constexpr Duration kUnusedTime = std::chrono::seconds(30);
  static constexpr Duration kRetryPeriod = std::chrono::seconds(1);
  static constexpr std::size_t kMaxStreams = 4096;   // that were asked for lately
  static constexpr std::size_t kMaxProperties = 64;  // that are asked for

  static constexpr Duration kDescribePeriod = std::chrono::seconds(2);

  struct Entry {
    std::optional<OpenStream> stream;
    std::string error;
    bool is_opening = false;
    MonoTime retry_at{};
    MonoTime used{};
    bool is_describing = false;
    MonoTime describe_at{};
  };
  // What is known of a stream whose own type has no fields.
  struct Description {
    std::uint64_t incarnation = 0;
    std::string users;  // the programs that had it open when these were asked
    TypeInfo type;      // with fields, if they are known; then for all of the incarnation
  };
  void open(const std::string& name);
  // Asks again, now and then, for the fields of a stream that has none.
  void describe(const std::string& name, Entry& entry);
  void use(const std::string& name, const Description& description);
  // The worker's.
  Result<OpenStream> open_in_source(const StreamId& id);
  Description find_description(const StreamId& id, Description known);

  Source source_;
  Server& server_;
  std::map<std::string, Entry> entries_;
  std::map<std::string, Description> descriptions_;
  // Those who wait for a property, by its stream and time.
  std::map<std::pair<std::string, std::optional<Time>>, std::vector<PropertyDone>> properties_;
  Worker worker_;
  Worker property_worker_;  // a host that does not answer does not keep streams from being opened
};

}  // namespace dssm::view
