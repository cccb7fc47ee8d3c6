// SPDX-License-Identifier: Apache-2.0
//
// dssmctl info: all that is known about one stream; without a stream, about dssmd itself.
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/stream_json.hpp"
#include "client/dssmctl/table.hpp"
#include "client/dssmctl/text.hpp"
#include "client/dssmctl/verbs.hpp"

namespace dssm::ctl {
namespace {

// "depth:        10 slots"
void add_line(Output& out, std::string_view key, const std::string& value) {
  constexpr std::size_t kKeyWidth = 14;
  std::string line = std::string(key) + ":";
  line.append(kKeyWidth - std::min(kKeyWidth - 1, line.size()), ' ');
  out.add(line + value + "\n");
}

void print_samples(const StreamInfo& stream, Output& out) {
  if (stream.newest == kNoTid) return add_line(out, "samples", "none yet");
  const Duration age = saturating_sub(WallClock::now(), stream.newest_time);
  add_line(out, "samples",
           "tid " + std::to_string(stream.oldest) + " to " + std::to_string(stream.newest));
  add_line(out, "newest",
           seconds_text(to_ns(stream.newest_time)) + " (" + duration_text(age) + " ago)");
  if (stream.rate_hz > 0) add_line(out, "rate", fixed_text(stream.rate_hz, 3) + " Hz");
}

void print_fields(const StreamInfo& stream, Output& out) {
  if (stream.type.fields.empty()) return;
  constexpr auto kRight = Table::Align::right;
  Table table({{"FIELD"}, {"KIND"}, {"OFFSET", kRight}, {"COUNT", kRight}, {"STRIDE", kRight}});
  for (const Field& field : stream.type.fields) {
    table.add_row({escaped(field.name), std::string(name_of(field.kind)),
                   std::to_string(field.offset_bytes), std::to_string(field.count),
                   field.count > 1 ? std::to_string(field.stride_bytes) : "-"});
  }
  out.add("\n");
  table.print(out);
}

void print_users(const StreamInfo& stream, Output& out) {
  if (stream.users.empty()) return;
  constexpr auto kRight = Table::Align::right;
  Table table({{"USED BY"}, {"ROLE"}, {"PID", kRight}, {"UID", kRight}});
  for (const StreamUser& user : stream.users) {
    table.add_row({escaped(user.program), std::string(role_name(user.role)),
                   std::to_string(user.pid), std::to_string(user.uid)});
  }
  out.add("\n");
  table.print(out);
}

// Of another host's stream: the copy that this PC keeps of it, while a program reads it here.
void print_mirror(const MirrorInfo& mirror, Output& out) {
  add_line(out, "mirror",
           std::string(name_of(mirror.state)) +
               (mirror.error.empty() ? "" : ": " + escaped_message(mirror.error)));
  add_line(out, "received",
           mirror.newest == kNoTid ? "nothing yet"
                                   : std::to_string(mirror.received_samples) + " samples, " +
                                         bytes_text(mirror.received_bytes) + ", up to tid " +
                                         std::to_string(mirror.newest));
  if (!mirror.clock.empty()) add_line(out, "clock", escaped_message(mirror.clock));
  add_line(out, "missing", std::to_string(mirror.gap_samples) + " samples");
  add_line(out, "reconnects", std::to_string(mirror.reconnects));
  add_line(out, "restarts", std::to_string(mirror.restarts));
}

void print_stream(const StreamInfo& stream, Output& out) {
  out.add(out.bold(escaped(stream.id.str())) + "\n");
  add_line(out, "owner", "host " + escaped(stream.id.host));
  add_line(out, "type", escaped(stream.type.str()));
  add_line(out, "depth", std::to_string(stream.depth) + " slots");
  add_line(out, "cycle", duration_text(stream.cycle));
  print_samples(stream, out);
  add_line(out, "writers", std::to_string(stream.writers));
  add_line(out, "readers", std::to_string(stream.readers));
  add_line(out, "channels", std::to_string(stream.channels) + " to other hosts");
  add_line(out, "memory", bytes_text(stream.memory_bytes));
  add_line(out, "property", stream.property_bytes ? bytes_text(stream.property_bytes) : "none");
  add_line(out, "incarnation", std::to_string(stream.incarnation));
  if (stream.creator_pid != 0) {  // not known of a mirror whose owner is unavailable
    add_line(out, "created by", "pid " + std::to_string(stream.creator_pid));
  }
  if (stream.mirror) print_mirror(*stream.mirror, out);
  print_fields(stream, out);
  print_users(stream, out);
}

Result<void> print_daemon(Session& session, const InfoOptions& options, Output& out) {
  const Result<DaemonInfo> daemon = session.daemon_info();
  if (!daemon) return daemon.error();
  const Result<std::vector<HostInfo>> hosts = session.list_hosts();
  if (!hosts) return hosts.error();
  const std::vector<std::string> addresses =
      hosts->empty() ? std::vector<std::string>() : hosts->front().addresses;
  if (options.json) {
    out.add(json_document({{"host", daemon->host},
                           {"addresses", addresses},
                           {"version", daemon->version},
                           {"pid", daemon->pid},
                           {"streams", daemon->streams},
                           {"memory_bytes", daemon->memory_bytes},
                           {"memory_limit_bytes", daemon->memory_limit_bytes}}));
    return {};
  }
  out.add(out.bold("dssmd " + escaped(daemon->version)) + "\n");
  add_line(out, "host", escaped(daemon->host));
  add_line(out, "addresses", addresses.empty() ? "none" : list_text(addresses));
  add_line(out, "pid", std::to_string(daemon->pid));
  add_line(out, "streams", std::to_string(daemon->streams));
  add_line(out, "memory",
           bytes_text(daemon->memory_bytes) + " of " + bytes_text(daemon->memory_limit_bytes));
  return {};
}

}  // namespace

Result<void> run(const InfoOptions& options, Output& out) {
  std::optional<StreamId> id;
  if (!options.stream.empty()) {
    Result<StreamId> parsed = StreamId::parse(options.stream);
    if (!parsed) return std::move(parsed).error();
    id = std::move(*parsed);
  }
  Result<Session> session = connect(options);
  if (!session) return std::move(session).error();
  if (!id) return print_daemon(*session, options, out);
  Result<StreamInfo> stream = session->stream_info(*id);
  if (!stream) return with_similar_names(std::move(stream).error(), *session, *id);
  if (options.json) {
    Json json = stream_json(*stream, WallClock::now());
    add_details(json, *stream);
    out.add(json_document(json));
  } else {
    print_stream(*stream, out);
  }
  return {};
}

}  // namespace dssm::ctl
