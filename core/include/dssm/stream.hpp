// SPDX-License-Identifier: Apache-2.0
//
// Names and descriptions of streams: identity, type of the samples, history, and present state.
// All are plain values.
//
//   threads  as any value: no two threads may use one object if one of them changes it
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/sample.hpp>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#pragma GCC visibility push(default)  // the library hides everything else
namespace dssm {

// Limits of the format; dssmd's configuration may be narrower.
inline constexpr std::size_t kMaxNameBytes = 31;      // SSM programs hold names in 32 bytes
inline constexpr std::size_t kMaxFullNameBytes = 63;  // a DNS-SD instance name, RFC 6763 4.1.1
inline constexpr std::size_t kMaxTypeNameBytes = 127;
inline constexpr std::size_t kMaxFields = 1024;  // of a type
inline constexpr std::uint64_t kMaxPayloadBytes = 64ULL << 20;
inline constexpr std::uint64_t kMinDepth = 2;
inline constexpr std::uint64_t kMaxDepth = 1ULL << 24;

// Identity of a stream, written `name:id@host`; ":0" and "@host" may be left out.
struct StreamId {
  std::string name;
  std::int32_t id = 0;
  std::string host;  // empty: any host

  // Parses "lidar", "lidar:1", "lidar:1@pc2".
  //   fails  invalid_argument
  static Result<StreamId> parse(std::string_view text);

  // Checks the name (UTF-8, 1 to kMaxNameBytes bytes without control characters, ':' and '@'), that
  // id >= 0, and that str() has at most kMaxFullNameBytes.
  //   fails  invalid_argument
  Result<void> check() const;

  // "name:id", with "@host" when there is a host.
  std::string str() const;

  friend bool operator==(const StreamId&, const StreamId&) = default;
};

// The type of a field's elements.
enum class Scalar : std::uint8_t {
  boolean = 1,
  character,
  int8,
  uint8,
  int16,
  uint16,
  int32,
  uint32,
  int64,
  uint64,
  float32,
  float64
};

std::uint32_t scalar_bytes(Scalar kind) noexcept;
std::string_view name_of(Scalar kind) noexcept;  // "float64"; static storage

// One field of a payload. Nested structs are written with dots: "pose.x". Arrays have count > 1;
// for an array of structs each member is a field with the struct's size as stride: "points.x".
struct Field {
  std::string name;
  Scalar kind = Scalar::uint8;
  std::uint64_t offset_bytes = 0;
  std::uint64_t count = 1;
  std::uint64_t stride_bytes = 0;  // distance between elements; meaningful when count > 1
  // Of a bit field: how many bits of the element it is, and the first of them, counted from the
  // least significant bit on. 0 bits: the whole element.
  std::uint8_t bits = 0;
  std::uint8_t first_bit = 0;

  friend bool operator==(const Field&, const Field&) = default;
};

// The type of a payload. An empty name means plain bytes and matches every name.
struct TypeInfo {
  std::string name;
  std::uint64_t payload_bytes = 0;  // of a sample, at most
  std::uint32_t alignment_bytes = 1;
  std::vector<Field> fields;  // may be empty: not described

  // "Odometry (40 bytes, aligned to 8)" or "40 bytes".
  std::string str() const;

  // The same with the first fields: "'Odometry' (40 bytes, aligned to 8) { float64 x at 0; float64
  // v[2] at 24; }".
  std::string description() const;

  // Whether a program that expects `wanted` may use this stream: same size, same name and alignment
  // where both have a name, and the same fields where both are described.
  //   fails  type_mismatch, with both descriptions and the first difference
  Result<void> check_usable_as(const TypeInfo& wanted) const;

  // Whether `other`, which check_usable_as() accepts, has a name or fields that are missing here. A
  // stream takes them from the next program that opens it for writing.
  bool is_less_described_than(const TypeInfo& other) const noexcept;

  // Checks sizes, alignment (a power of two up to 64) and that each field lies inside the payload.
  //   fails  invalid_argument
  Result<void> check() const;

  friend bool operator==(const TypeInfo&, const TypeInfo&) = default;
};

// How many samples a ring keeps.
struct History {
  std::uint64_t depth = 0;  // slots; depth - 1 samples are readable at any moment
  Duration cycle{};         // expected time between two samples, for tools and time search

  // Slots for `life` of history at one sample per `cycle`, with SSM's margin of 20 %:
  // trunc(1.2 * life / cycle + 1).
  //   fails  invalid_argument unless 0 < cycle <= life, limit_exceeded beyond kMaxDepth slots
  static Result<History> for_life(Duration life, Duration cycle);
};

enum class Role : std::uint8_t { reader = 1, writer };

// How a process has a stream open.
enum class StreamVia : std::uint8_t {
  local,          // on the stream's own host, by its shared memory
  mirror,         // on another host, which keeps a copy of the ring
  remote_writer,  // on another host, whose dssmd sends what it writes
  connection,     // by a connection of its own to the owner's dssmd (PConnector, SSM's remote API)
};

// "local", "mirror", "remote writer", "connection"; static storage.
std::string_view name_of(StreamVia via) noexcept;

// A process that has a stream open.
struct StreamUser {
  std::int32_t pid = 0;                   // 0: not known (a program of an older version)
  std::optional<std::uint32_t> uid = {};  // empty: not known
  std::string program = {};
  Role role = Role::reader;
  StreamVia via = StreamVia::local;
  std::string host = {};  // where it runs
};

enum class MirrorState : std::uint8_t {
  unknown,            // dssmd is of a later version
  connecting,         // to the owner, for the first time
  filling,            // the owner's history is on its way
  live,               // the mirror has the newest sample as soon as the network carries it
  owner_unavailable,  // the mirror keeps what it has; dssmd reconnects
  removed,            // the stream was removed; dssmd retries
};

// "live", "owner unavailable" ...; static storage.
std::string_view name_of(MirrorState state) noexcept;

// The state of this PC's mirror of another host's stream.
struct MirrorInfo {
  MirrorState state = MirrorState::unknown;
  // Lost: the owner's ring no longer held them, the network carried less than the stream has, more
  // were written than a shorter ring here holds, or max_rate_hz left them out.
  std::uint64_t gap_samples = 0;
  std::uint64_t reconnects = 0;
  std::uint64_t restarts = 0;  // times the owner's ring was replaced by a new one
  Tid newest = kNoTid;         // newest sample in the mirror
  Time newest_time{};          // its time; meaningless without one
  std::uint64_t received_samples = 0;
  std::uint64_t received_bytes = 0;  // of payloads
  std::string error;                 // why it is not live; empty when it is
  std::string clock;           // why the times of its samples are suspect; empty when they are not
  bool clock_refused = false;  // for that, reads by time refuse them, and do not only mark
  std::uint64_t filling_samples = 0;  // of the part that is not complete; newer ones are here
  bool history_wanted = false;        // that part is being filled, else when a program reads it
  // Of the last 3 s before the newest sample: how many were written, and how many of these are
  // lost.
  std::uint64_t recent_samples = 0;
  std::uint64_t recent_lost_samples = 0;
  // So many samples a second it takes at most (dssmd's key mirror_streams), and those that it
  // leaves out count as lost. 0: all.
  double max_rate_hz = 0;
  std::uint64_t depth = 0;  // of its ring; 0: there is none yet
};

// How long an interval between two samples must be at least to count as a pause of the stream: five
// times its usual interval, and a second at least. The usual interval is the longest but one of
// `intervals`: a single pause that is over is not usual, but a stream that pauses often is
// irregular. Programs often give a cycle that is far from the real one, so `cycle` counts with less
// than two intervals only, if it is the longer one.
//   intervals  between the stamps of the newest kRecentSamples samples, in any order
Duration pause_length(std::span<const Duration> intervals, Duration cycle) noexcept;
inline constexpr std::size_t kRecentSamples = 33;

// Whether samples come, by the owner's clock. docs/glossary.md "stalled" has the exact definition.
enum class StreamState : std::uint8_t {
  unknown,  // the stamps are of another clock (a recording's), or the owner does not answer
  empty,    // nothing was written yet
  live,
  stalled,    // the newest sample is as old as a pause is long: pause_length()
  no_writer,  // as stalled, and neither a program nor another host can write to it now
};

// "live", "no writer" ...; static storage.
std::string_view name_of(StreamState state) noexcept;

// The present state of a stream. For a stream of another host, creator_pid is of its owner.
struct StreamInfo {
  StreamId id;  // with its owner's host
  TypeInfo type;
  std::uint64_t depth = 0;
  Duration cycle{};
  std::uint64_t memory_bytes = 0;    // of the ring
  std::uint64_t property_bytes = 0;  // 0: none set
  std::uint64_t incarnation = 0;     // differs between two rings of one name
  std::int32_t creator_pid = 0;
  Tid oldest = kNoTid;  // oldest readable sample
  Tid newest = kNoTid;
  Time newest_time{};  // stamp of the newest sample; meaningless while newest is kNoTid
  // From the stamps of the newest samples; 0 when unknown. Of a stream that is not live it is the
  // one that it had.
  double rate_hz = 0;
  StreamState state = StreamState::unknown;
  // How old the newest sample is, by the owner's clock; may be negative. Known when the state is
  // live, stalled or no_writer.
  Duration age{};
  // How many times it is open on all hosts, and of these over the network. Programs of other hosts
  // are counted if their dssmd states them: an older one does not, and has a channel all the same.
  std::uint32_t writers = 0;
  std::uint32_t readers = 0;
  std::uint32_t remote_writers = 0;
  std::uint32_t remote_readers = 0;
  std::uint32_t channels = 0;  // connections from other hosts that carry it
  // Programs of its host that had it open to write, or to read, and ended without closing it, by a
  // crash or a kill, since dssmd runs there and has the stream; and the last of them, for people:
  // "driver (pid 12)".
  std::uint32_t crashed_writers = 0;
  std::string last_crashed_writer;
  std::uint32_t crashed_readers = 0;
  std::string last_crashed_reader;
  std::vector<StreamUser> users;     // from Session::stream_info() only
  std::optional<MirrorInfo> mirror;  // the same; of another host's stream that is read here
};

}  // namespace dssm
#pragma GCC visibility pop
