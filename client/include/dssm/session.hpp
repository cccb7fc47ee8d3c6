// SPDX-License-Identifier: Apache-2.0
//
// A Session is this process's connection to its PC's dssmd: it creates, opens, lists and watches
// streams. Reading and writing itself goes past dssmd, through shared memory.
//
// When dssmd goes away (restart, crash), readers and writers keep working; the session reconnects
// by itself, offers back the rings it still holds, and calls that need dssmd wait for it up to
// `request_timeout`.
//
//   threads  all functions may be called from any thread. A session runs one thread of its own,
//            with all signals blocked.
//   fork     a child must connect a session of its own; using the parent's there is undefined
//   errors   besides those named at each function: unavailable (no answer in time), protocol
#pragma once

#include <dssm/clock_status.hpp>
#include <dssm/playback_clock.hpp>
#include <dssm/reader.hpp>
#include <dssm/stream.hpp>
#include <dssm/writer.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

namespace detail {
class Client;
}

struct SessionOptions {
  std::string socket_path = {};  // empty: $DSSM_SOCKET, else /run/dssm/dssmd.sock
  std::string program = {};      // shown by dssmctl; empty: this program's name
  Duration request_timeout = std::chrono::seconds(5);
};

// A process connected to dssmd, in the order of connection.
struct ClientInfo {
  std::int32_t pid = 0;
  std::uint32_t uid = 0;
  std::string program;
};

// One stream opened by one process, in the order of opening.
struct OpenInfo {
  StreamId stream;
  std::int32_t creator_pid = 0;  // who created the stream
  std::int32_t opener_pid = 0;
  std::uint32_t tag =
      0;  // as given to open_reader() or open_writer(); SSM keeps its open mode here
  Role role = Role::reader;
};

struct DaemonInfo {
  std::string host;
  std::string version;
  std::int32_t pid = 0;
  std::uint64_t streams = 0;
  std::uint64_t memory_bytes = 0;        // of all rings
  std::uint64_t memory_limit_bytes = 0;  // for all rings

  // How it fares with finding other hosts by mDNS.
  struct Mdns {
    std::string phase;              // "off", "waiting" (for the Avahi daemon), "running"
    std::string error;              // why it waits, or what goes wrong; empty: nothing
    std::string avahi_version;      // "avahi 0.8"
    std::uint32_t announced = 0;    // services: streams, and the host itself
    std::uint32_t withheld = 0;     // services that could not be announced
    bool own_host_seen = false;     // this host's own announcement is visible here
    std::uint32_t hosts_heard = 0;  // other hosts heard of by multicast
  };
  Mdns mdns;
};

// What a host says of its clock (docs/clocks.md), aged until now.
struct ClockInfo {
  ClockStatus status = ClockStatus::unknown;
  ClockReason reason = ClockReason::none;
  ClockBasis basis = ClockBasis::nothing;
  Duration offset{};      // its clock minus what its chronyd takes for the right time
  std::string reference;  // whom it follows: a host's name or an address; empty: nobody
  std::uint16_t stratum = 0;
  Duration update_interval{};                // between two measurements of its chronyd
  Duration age{};                            // of the last one
  Duration root_bound = kUnknownClockError;  // from UTC
  Duration distance = kUnknownClockError;    // greatest distance from this PC's clock
};

// A host of the fleet, as this PC's dssmd sees it: this PC itself, each configured peer, and each
// host that was found by mDNS.
struct HostInfo {
  std::string name;                    // empty while it never answered
  std::vector<std::string> addresses;  // as configured and as reached: "pc2:13776"
  std::string version;                 // of its dssmd
  std::string state;          // "self", "up", "connecting", "down", "refused", "closed" (it
                              // was found by mDNS, but listens on its own loopback only)
  Duration since{};           // how long it has been in this state
  Duration round_trip{};      // of the last heartbeat, which comes once a second; 0: none
  Duration min_round_trip{};  // of this connection's heartbeats; 0: none
  std::uint32_t streams = 0;  // that it owns
  Duration clock_bound = kUnknownClockError;  // of its samples' stamps, against the reference PC
  std::optional<ClockInfo> clock;             // nothing: it says nothing of it
  bool insecure = false;                      // its traffic crosses the network in the clear
  std::string error;  // why it is not up, or a warning that concerns it; empty: all is well
  std::string id;     // 32 hex digits, of the host whatever it is called; empty: not known
  std::vector<std::string> found_by;  // "peer" (configured), "mdns"; empty: it is this PC
};

// A sign of life that was asked for.
struct RoundTrip {
  Duration round_trip{};  // from dssmd to dssmd and back
  std::string address;    // where it was reached; empty: it is this PC
};

// What a watcher is told.
struct StreamEvent {
  enum class Kind : std::uint8_t { added, removed };
  Kind kind = Kind::added;
  StreamInfo stream;  // for removed: identity only
};

class Session {
 public:
  // Connects. Fails with no_daemon (nothing listens), no_permission (not in the socket's group),
  // protocol (dssmd speaks an incompatible version).
  static Result<Session> connect(SessionOptions options = {});

  Session(const Session&);  // copies share the connection
  Session& operator=(const Session&);
  Session(Session&&) noexcept;
  Session& operator=(Session&&) noexcept;
  ~Session();

  // --- streams

  // A stream's name may say whose it is: "lidar@pc2". Without a host, this PC's own stream of that
  // name is meant if there is one, else the only other host's that is known; a new one is created
  // on this PC. Wherever a stream is, reading and writing it is the same.

  // Creates the stream and opens it for writing. When it exists with the same payload size, its
  // ring is kept, whatever history was asked for, and the writer continues its tids.
  //   fails  invalid_argument (name, sizes), type_mismatch (exists with another size or type),
  //          limit_exceeded, no_memory
  Result<RawWriter> create_raw(const StreamId& id, const TypeInfo& type, const History& history,
                               std::uint32_t tag = 0);

  // Opens an existing stream. With `wanted`, fails with type_mismatch unless
  // TypeInfo::check_usable_as(wanted).
  //   fails  not_found, type_mismatch, clock_out_of_bounds (for reading on another host)
  Result<RawWriter> open_raw_writer(const StreamId& id, const TypeInfo* wanted = nullptr,
                                    std::uint32_t tag = 0);
  Result<RawReader> open_raw_reader(const StreamId& id, const TypeInfo* wanted = nullptr,
                                    std::uint32_t tag = 0);

  // Opens a stream for reading, waiting until `deadline` for it to be created, for its host to
  // answer, and for the clocks of that and of this PC to be good enough.
  //   fails  as open_raw_reader(); not_found, unavailable, clock_out_of_bounds when the deadline
  //          passed
  Result<RawReader> await_raw_reader(const StreamId& id, MonoTime deadline,
                                     const TypeInfo* wanted = nullptr);

  // The same with a type; `name` as StreamId::parse() reads it.
  template <Payload T>
  Result<Writer<T>> create(std::string_view name, const History& history) {
    return typed<Writer<T>>(
        name, [&](const StreamId& id) { return create_raw(id, type_of<T>(), history); });
  }
  template <Payload T>
  Result<Writer<T>> create(std::string_view name, Duration life, Duration cycle) {
    Result<History> history = History::for_life(life, cycle);
    if (!history) return std::move(history).error();
    return create<T>(name, *history);
  }
  template <Payload T>
  Result<Writer<T>> open_writer(std::string_view name) {
    const TypeInfo type = type_of<T>();
    return typed<Writer<T>>(name, [&](const StreamId& id) { return open_raw_writer(id, &type); });
  }
  template <Payload T>
  Result<Reader<T>> open_reader(std::string_view name) {
    const TypeInfo type = type_of<T>();
    return typed<Reader<T>>(name, [&](const StreamId& id) { return open_raw_reader(id, &type); });
  }
  template <Payload T>
  Result<Reader<T>> await_reader(std::string_view name, MonoTime deadline = kNever) {
    const TypeInfo type = type_of<T>();
    return typed<Reader<T>>(
        name, [&](const StreamId& id) { return await_raw_reader(id, deadline, &type); });
  }

  // Removes a stream: it leaves the list at once and can be created anew; processes that have it
  // open keep their ring until they close it.
  //   fails  not_found
  Result<void> remove(const StreamId& id);

  // All streams: first this PC's, then the other hosts' in the order of their names, each in the
  // order of creation. A host that does not answer within half a second is listed with what is
  // known of its streams; one that is down is left out.
  Result<std::vector<StreamInfo>> list_streams();

  // Those of this PC only, in the order of creation.
  Result<std::vector<StreamInfo>> list_own_streams();

  // One stream, with its users.
  //   fails  not_found
  Result<StreamInfo> stream_info(const StreamId& id);

  // Calls `on_event` for each stream that is there, then for each that comes or goes, until the
  // watch is destroyed or the session's last copy is. Called from the session's thread: be short,
  // and do not call the session from it. After a reconnect the streams that are there are told
  // again, and those that are gone as removed.
  class Watch {
   public:
    Watch(Watch&&) noexcept;
    Watch& operator=(Watch&&) noexcept;
    ~Watch();  // waits for a running callback

   private:
    friend class Session;
    struct State;
    explicit Watch(std::unique_ptr<State> state) noexcept;
    std::unique_ptr<State> state_;
  };
  Result<Watch> watch(std::function<void(const StreamEvent&)> on_event);

  // --- properties

  // A small constant block attached to a stream. No open is needed. At most 16 MiB, or what dssmd
  // is configured to take.
  //   fails  not_found (no stream; for get also: none set), limit_exceeded
  Result<void> set_property(const StreamId& id, std::span<const std::byte> property);
  Result<std::vector<std::byte>> property(const StreamId& id);

  // --- other hosts

  // This PC first, then the configured peers and those found by mDNS, each with its state at this
  // moment.
  Result<std::vector<HostInfo>> list_hosts();

  // Asks the dssmd of that host for a sign of life, over the connection that this PC's dssmd keeps.
  //   fails  not_found (no host of that name is up), conflict (several are), unavailable (it does
  //          not answer)
  Result<RoundTrip> ping(const std::string& host);

  // --- the rest

  Result<PlaybackClock> open_playback_clock();
  Result<std::vector<ClientInfo>> list_clients();
  Result<std::vector<OpenInfo>> list_opens();
  Result<DaemonInfo> daemon_info();

  // Whether the connection stands at this moment.
  bool is_connected() const noexcept;

 private:
  explicit Session(std::shared_ptr<detail::Client> client) noexcept;

  template <class Typed, class Open>
  static Result<Typed> typed(std::string_view name, Open open) {
    Result<StreamId> id = StreamId::parse(name);
    if (!id) return std::move(id).error();
    auto raw = open(*id);
    if (!raw) return std::move(raw).error();
    return Typed(std::move(*raw));
  }

  std::shared_ptr<detail::Client> client_;
};

}  // namespace dssm
#pragma GCC visibility pop
