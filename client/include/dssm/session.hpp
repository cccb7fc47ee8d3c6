// SPDX-License-Identifier: Apache-2.0
//
// A Session is this process's connection to its PC's dssmd: it creates, opens, lists and watches
// streams. Samples do not pass through dssmd: readers and writers use shared memory.
//
// While dssmd is unavailable (restart, crash), readers and writers keep working. The session
// reconnects by itself and offers the rings that it still holds to the new dssmd. Calls that need
// dssmd wait for it up to `request_timeout`.
//
//   threads  any thread may call any function. A session has one thread of its own, and up to three
//            more from the first subscribe() on, all with all signals blocked
//   fork     a child must connect a session of its own; using the parent's there is undefined
//   moved    a moved-from session may only be assigned to or destroyed
//   errors   each function names its own; unavailable (no answer in time) and protocol can come
//            from all that return a Result
#pragma once

#include <dssm/clock_status.hpp>
#include <dssm/executor.hpp>
#include <dssm/host_state.hpp>
#include <dssm/playback_clock.hpp>
#include <dssm/reader.hpp>
#include <dssm/stream.hpp>
#include <dssm/writer.hpp>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

namespace dssm::detail {
class Client;
}

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

struct SessionOptions {
  std::string socket_path = {};  // empty: $DSSM_SOCKET, else /run/dssm/dssmd.sock
  std::string program = {};      // shown by dssmctl; empty: this program's name
  // How long a call waits for dssmd's answer, reconnecting included.
  Duration request_timeout = std::chrono::seconds(5);
  // Gets lines for people: what await_reader() and subscribe() wait for, after 2 s and once for
  // each reason, with names like the wanted one; and errors of subscriptions without on_error. The
  // calls come from await_reader()'s caller and from threads of the session. It must not call the
  // session. Empty: they are printed to standard error, as "dssm: ..."; a function that does
  // nothing silences them.
  std::function<void(const std::string&)> on_notice = {};
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
  std::uint32_t tag = 0;  // from create_raw() or open_raw_...(); SSM stores its open mode here
  Role role = Role::reader;
};

// One stream that a process has open.
struct NodeStream {
  StreamId stream;  // with its owner's host
  Role role = Role::reader;
  StreamVia via = StreamVia::local;
};

// Another host, whose playback clock is to follow.
struct PlaybackFollower {
  std::string host;
  std::optional<Error> error;  // why it does not
};

// A process that has streams open, on any host.
struct NodeInfo {
  std::string host;                  // where it runs
  std::int32_t pid = 0;              // 0: not known (a program of an older version)
  std::optional<std::uint32_t> uid;  // empty: not known
  std::string program;
  std::vector<NodeStream> streams;  // by name, readers first; each once
  std::string error;  // why nothing is known of the processes of `host`, for people; empty: it is
};

// What a host proves itself with to other PCs (docs/security.md).
struct CredentialsInfo {
  std::string name;  // whom the certificate names: "host 'pc1'"
  Time valid_until{};
  std::string problem;  // why other hosts refuse it, for people; empty: nothing is known
};

// How much of one of dssmd's limits is used (docs/limits.md).
struct LimitInfo {
  std::string name;        // of the key, "max_streams", or of what is limited
  std::uint64_t used = 0;  // of a limit for each user, program or host: by the one with the most
  std::uint64_t limit = 0;
  std::string unit;  // "bytes", "streams", "programs", ...
};

struct DaemonInfo {
  std::string host;
  std::string version;
  std::int32_t pid = 0;
  std::uint64_t streams = 0;
  std::uint64_t memory_bytes = 0;        // of all rings
  std::uint64_t memory_limit_bytes = 0;  // for all rings
  MdnsInfo mdns;
  std::optional<CredentialsInfo> credentials;  // empty: connections are not encrypted
  std::vector<LimitInfo> limits;               // empty: an older dssmd
  std::string config_file;                     // empty: none, or an older dssmd
  std::string clock_policy;                    // the value of that key; empty: an older dssmd
  // The program of another host that drives this PC's playback clock, "dssmctl play@pc1": it soon
  // replaces what is set here. Empty: none, no right to use the clock, or an older dssmd.
  std::string playback_driver;
};

// Who may do what with a stream on this PC, by dssmd's configuration (docs/security.md "Rights").
struct RightLine {
  std::string line;   // as configured: "group:drivers read,write lidar*"
  std::string verbs;  // what it allows: "read,write", "all"
};
struct StreamRights {
  bool restricted =
      false;  // false: nothing is configured, so every program and host may do everything
  std::string own_verbs;         // what this process may do: "read,write", "all", "none"
  std::vector<RightLine> lines;  // that concern the stream, in the order of the configuration
};

// A host of the fleet as this PC's dssmd sees it: this PC itself, each configured peer, and each
// host found by mDNS.
struct HostInfo {
  std::string name;                    // empty until it has answered
  std::vector<std::string> addresses;  // as configured and as reached: "pc2:13776"
  std::string version;                 // of its dssmd
  HostState state = HostState::unknown;
  HostReason reason = HostReason::none;  // why it is not up, or which warning concerns it
  Duration since{};                      // how long it has been in this state
  Duration round_trip{};                 // of the last heartbeat (one a second); 0: none yet
  Duration min_round_trip{};             // of all heartbeats of this connection; 0: none yet
  // What the network carries from it to here, as it measured while it sent history within the last
  // minute; 0: not known, or the network is not what limits.
  std::uint64_t carried_bytes_per_s = 0;
  std::uint32_t streams = 0;           // that it owns
  std::optional<ClockSnapshot> clock;  // aged to the present; empty: it reports none
  std::string clock_reference;  // what its clock follows: a host's name or an address, or empty
  Duration clock_distance = kUnknownClockError;  // greatest distance from this PC's clock
  // Why the times of its samples are not good here, in a sentence, for people; empty: they are, or
  // it is this PC, or not up. With clock_policy "enforce", reads by time refuse them for that.
  // Streams for which clock_streams has another policy or limit may differ.
  std::string clock_reason;
  bool clock_refused = false;
  bool insecure = false;              // its traffic is unencrypted
  std::string error;                  // `reason` in a sentence, for people; empty: none
  std::string id;                     // 32 hex digits, independent of the name; empty: unknown
  std::vector<std::string> found_by;  // "peer" (configured), "mdns"; empty: this PC

  // Of its samples' times, against the reference PC.
  Duration clock_bound() const noexcept { return clock ? clock->bound : kUnknownClockError; }
};

// The result of ping().
struct RoundTrip {
  Duration round_trip{};  // from dssmd to dssmd and back
  std::string address;    // that was used; empty: this PC
};

// A change of the list of streams.
struct StreamEvent {
  enum class Kind : std::uint8_t { added, removed };
  Kind kind = Kind::added;
  StreamInfo stream;  // for removed: identity only
  // Added: the stream was known before, and its property was set, or removed (then
  // stream.property_bytes is 0). Changes that follow each other closely may be reported once.
  bool property_set = false;
  // For property_set: samples after this one are written with the new property; kNoTid: all are.
  // Empty: that is not known, after a reconnect.
  std::optional<Tid> property_after;
  // Added: the stream was known before, and its type has another description now.
  bool described = false;
};

// How a stream is created.
struct CreateOptions {
  // An existing stream of that type keeps its ring, also with less history than is asked for; one
  // of another type is never replaced.
  bool keep_existing = false;
  std::uint32_t tag = 0;  // stored with the open, see OpenInfo
};

// A handle; copies share one connection.
class Session {
 public:
  // Connects.
  //   fails  no_daemon (nothing listens), no_permission (not in the socket's group), protocol
  //          (dssmd has an incompatible version), invalid_argument (socket_path)
  static Result<Session> connect(SessionOptions options = {});

  Session(const Session&);
  Session& operator=(const Session&);
  Session(Session&&) noexcept;
  Session& operator=(Session&&) noexcept;
  ~Session();

  // --- streams

  // A stream's name may name its host: "lidar@pc2". A name without a host means this PC's own
  // stream of that name if there is one, else the only known stream of that name on another host.
  // create without a host creates on this PC. Local and remote streams are read and written alike.

  // Creates the stream and opens it for writing. An existing stream of that type
  // (TypeInfo::check_usable_as()) with at least that history keeps its ring, and the writer
  // continues its tids; RawWriter::depth() and cycle() tell what it has. With another type, or with
  // less history, its ring is replaced by a new one if no process has it open.
  //   fails  invalid_argument (name, sizes), type_mismatch (exists with another type and is open),
  //          conflict (exists with less history and is open; several hosts have a stream of that
  //          name), limit_exceeded, no_memory
  Result<RawWriter> create_raw(const StreamId& id, const TypeInfo& type, const History& history,
                               const CreateOptions& options = {});

  // Opens an existing stream. With `wanted`, fails with type_mismatch unless
  // TypeInfo::check_usable_as(wanted); a stream of this PC that is written takes name, alignment
  // and fields that its type lacks from `wanted`, as it does from create_raw().
  //   fails  not_found, type_mismatch, conflict (several hosts have a stream of that name),
  //          clock_out_of_bounds (reading another host's stream)
  Result<RawWriter> open_raw_writer(const StreamId& id, const TypeInfo* wanted = nullptr,
                                    std::uint32_t tag = 0);
  Result<RawReader> open_raw_reader(const StreamId& id, const TypeInfo* wanted = nullptr,
                                    std::uint32_t tag = 0,
                                    FetchHistory history = FetchHistory::when_read);

  // Opens a stream for reading. Repeats, until `deadline` or for `timeout`, what fails with an
  // error that is_retryable(): waits for the stream to be created, for its host to answer, and for
  // the clocks of both PCs to be good enough. SessionOptions::on_notice is informed.
  //   fails  as open_raw_reader(): at once with an error that is not retryable, at the deadline
  //          with the last one
  Result<RawReader> await_raw_reader(const StreamId& id, MonoTime deadline,
                                     const TypeInfo* wanted = nullptr,
                                     FetchHistory history = FetchHistory::when_read);
  Result<RawReader> await_raw_reader(const StreamId& id, Duration timeout,
                                     const TypeInfo* wanted = nullptr,
                                     FetchHistory history = FetchHistory::when_read) {
    return await_raw_reader(id, deadline_in(timeout), wanted, history);
  }

  // The same with a type; `name` is parsed by StreamId::parse(), whose errors they also return.
  // create() with a duration also returns those of History::for_life().
  template <Payload T>
  Result<Writer<T>> create(std::string_view name, const History& history,
                           const CreateOptions& options = {}) {
    return typed<Writer<T>>(
        name, [&](const StreamId& id) { return create_raw(id, type_of<T>(), history, options); });
  }
  template <Payload T>
  Result<Writer<T>> create(std::string_view name, Duration life, Duration cycle,
                           const CreateOptions& options = {}) {
    Result<History> history = History::for_life(life, cycle);
    if (!history) return std::move(history).error();
    return create<T>(name, *history, options);
  }
  template <Payload T>
  Result<Writer<T>> open_writer(std::string_view name) {
    const TypeInfo type = type_of<T>();
    return typed<Writer<T>>(name, [&](const StreamId& id) { return open_raw_writer(id, &type); });
  }
  template <Payload T>
  Result<Reader<T>> open_reader(std::string_view name,
                                FetchHistory history = FetchHistory::when_read) {
    const TypeInfo type = type_of<T>();
    return typed<Reader<T>>(
        name, [&](const StreamId& id) { return open_raw_reader(id, &type, 0, history); });
  }
  template <Payload T>
  Result<Reader<T>> await_reader(std::string_view name, MonoTime deadline = kNever,
                                 FetchHistory history = FetchHistory::when_read) {
    const TypeInfo type = type_of<T>();
    return typed<Reader<T>>(
        name, [&](const StreamId& id) { return await_raw_reader(id, deadline, &type, history); });
  }
  template <Payload T>
  Result<Reader<T>> await_reader(std::string_view name, Duration timeout,
                                 FetchHistory history = FetchHistory::when_read) {
    return await_reader<T>(name, deadline_in(timeout), history);
  }

  // Calls `callback(const Sample<T>&)`, or `callback(const Sample<T>&, Reader<T>&)`, for each
  // sample of the stream until the result is destroyed (dssm/executor.hpp). Of the reader, see
  // RawCallback. Waits at most 0.5 s: a stream that cannot be opened by then, or that fails to open
  // with an error that is_retryable(), is awaited in the background.
  //   fails  as open_raw_reader() with errors that are not retryable, if known by then (later they
  //          go to options.on_error); system (no thread left)
  template <Payload T, SampleCallback<T> Callback>
  Result<StreamCallback> subscribe(std::string_view name, Callback callback,
                                   const SubscribeOptions& options = {}) {
    auto call = std::make_unique<detail::TypedSampleCall<T, Callback>>(std::move(callback));
    const TypeInfo type = type_of<T>();
    return typed<StreamCallback>(name, [&](const StreamId& id) {
      return subscribe_to(id, &type, std::move(call), options);
    });
  }
  // The same with bytes, of any type or, with `wanted`, of that one.
  Result<StreamCallback> subscribe_raw(const StreamId& id, RawCallback callback,
                                       const SubscribeOptions& options = {},
                                       const TypeInfo* wanted = nullptr);

  // Removes a stream: it leaves the list at once and can be created again. Processes that have it
  // open keep its ring until they close it.
  //   fails  not_found, conflict (several hosts have a stream of that name)
  Result<void> remove(const StreamId& id);

  // All streams: this PC's, then those of the other hosts in the order of host names; each host's
  // in the order of creation. A host that does not answer within 0.5 s is listed with the last
  // known data of its streams; a host that is down is left out. Types come without their fields
  // when there are many (more than 1024 on one host); stream_info() has them.
  Result<std::vector<StreamInfo>> list_streams();

  // This PC's streams only, in the order of creation.
  Result<std::vector<StreamInfo>> list_own_streams();

  // One stream, with the processes that have it open on all hosts (up to 64 behind each connection
  // of another host; StreamInfo counts all).
  //   fails  not_found, conflict (several hosts have a stream of that name)
  Result<StreamInfo> stream_info(const StreamId& id);

  // Who may do what with the stream, which need not exist; this PC's rights, also for a stream of
  // another host.
  //   fails  no_permission (this process may do nothing with it)
  Result<StreamRights> stream_rights(const StreamId& id);

  // Calls `on_event` for each existing stream, then for each one added or removed, until the watch
  // is destroyed. A stream that is recreated is reported as added again, and so is one whose
  // property was set or that was described (StreamEvent::property_set, StreamEvent::described). The
  // calls come from the session's thread, and from watch() itself: `on_event` must return soon and
  // must not call the session. After a reconnect only differences are reported; a property differs
  // if its length does.
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

  // A block of bytes attached to a stream, which need not be open. At most 1 MiB, or the
  // limit that dssmd is configured with; 0 bytes remove it.
  //   fails  not_found (no such stream; property() also: none set), limit_exceeded, conflict
  Result<void> set_property(const StreamId& id, std::span<const std::byte> property);
  Result<std::vector<std::byte>> property(const StreamId& id);

  // Gives a stream, which need not be open, the name, alignment and fields of `type`, as far as it
  // has none: for streams of programs that do not describe their types. It keeps them as long as it
  // exists; what programs have open keeps its description until they open it again. Takes the right
  // to set properties.
  //   replace  also the name and fields that it has
  //   fails    not_found, invalid_argument (TypeInfo::check()), type_mismatch (another size;
  //            without `replace` also another name or other fields), limit_exceeded, no_permission
  Result<void> describe(const StreamId& id, const TypeInfo& type, bool replace = false);

  // --- other hosts

  // This PC first, then the configured peers and the hosts found by mDNS, each with its present
  // state.
  Result<std::vector<HostInfo>> list_hosts();

  // The processes of all hosts that have streams open, and those without a dssmd of their own that
  // are connected to one of these hosts: this PC's first, then by host; each host's by program and
  // pid.
  // A host that does not answer within 0.5 s, or whose dssmd is too old, has one entry with an
  // `error`. Streams that this process may not see are left out.
  //   fails  limit_exceeded (more than a hundred thousand opens)
  Result<std::vector<NodeInfo>> list_nodes();

  // What reads by time do with the samples of each host on each other one, and how far their clocks
  // may be apart: a pair for each two hosts that are up and each direction, sorted by reader, then
  // owner. A reader that does not answer within 0.5 s, or whose dssmd is too old, has one entry,
  // with an `error` and without an owner; a pair of which its reader states nothing has an `error`.
  //   fails  limit_exceeded (tens of thousands of pairs)
  Result<std::vector<ClockPair>> list_clock_pairs();

  // Measures a round trip from this PC's dssmd to that host's, over their open connection.
  //   fails  not_found (no host of that name is up), conflict (several are), unavailable (no
  //          answer)
  Result<RoundTrip> ping(const std::string& host);

  // --- this PC's dssmd

  // The PC's shared playback clock. It stays usable after the Session is destroyed.
  Result<PlaybackClock> open_playback_clock();

  // Has the playback clocks of all other hosts that are up follow this PC's, as it is now, for 5 s:
  // for players of recordings, which repeat it each second, and at once after each change. With
  // `ends` they show the real time again. A change that all are to make at the same moment is made
  // by PlaybackClock::change_at() some 50 ms before.
  //   driver   a number chosen at random, of this player alone; not 0. While the clocks follow one,
  //            all others are refused
  //   returns  all other hosts that are up, by name. The error of one that does not follow:
  //            no_permission, conflict (it follows another driver), unavailable (no answer within
  //            500 ms), protocol (its dssmd is too old), invalid_argument (its clock is wrong)
  //   fails    conflict (this PC's clock follows another driver), no_permission
  Result<std::vector<PlaybackFollower>> share_playback_clock(std::uint64_t driver,
                                                             bool ends = false);
  // The same for this PC's clock alone: for 5 s no other driver is accepted, of this PC or of
  // another one.
  //   fails    as share_playback_clock()
  Result<void> hold_playback_clock(std::uint64_t driver, bool ends = false);
  // The processes connected to dssmd.
  Result<std::vector<ClientInfo>> list_clients();
  // All streams that processes have open.
  Result<std::vector<OpenInfo>> list_opens();
  Result<DaemonInfo> daemon_info();

  // Whether the session is connected at this moment.
  bool is_connected() const noexcept;

 private:
  explicit Session(std::shared_ptr<detail::Client> client) noexcept;
  Result<StreamCallback> subscribe_to(const StreamId& id, const TypeInfo* wanted,
                                      std::unique_ptr<detail::SampleCall> call,
                                      SubscribeOptions options);

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
