// SPDX-License-Identifier: Apache-2.0
//
// dssmctl info: all that is known about one stream or recording; without either, about dssmd
// itself.
#include <fmt/format.h>

#include <filesystem>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/recording_info.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// "depth:        10 slots"
template <class Value>
void add_line(Output& out, const std::string& key, const Value& value) {
  out.add(fmt::format("{:<13} {}\n", key + ":", value));
}

// "stalled: no sample for 98.0 s, open for writing in 1 program".
std::string silence_text(const StreamInfo& stream) {
  return fmt::format("{}: no sample for {}{}", name_of(stream.state), age_text(stream),
                     stream.state == StreamState::stalled && stream.writers > 0
                         ? fmt::format(", but open for writing in {} program{}", stream.writers,
                                       stream.writers == 1 ? "" : "s")
                         : "");
}

void print_samples(const StreamInfo& stream, bool iso, Output& out) {
  if (stream.newest == kNoTid) {
    return add_line(out, "samples", stream.state == StreamState::empty ? "none yet" : "-");
  }
  add_line(out, "samples", fmt::format("tid {} to {}", stream.oldest, stream.newest));
  add_line(out, "newest",
           fmt::format("{}{}", time_text(stream.newest_time, iso),
                       is_age_known(stream) ? fmt::format(" ({} ago)", age_text(stream)) : ""));
  if (is_silent(stream)) {
    add_line(out, "state", silence_text(stream));
  } else {
    if (stream.state != StreamState::unknown) add_line(out, "state", name_of(stream.state));
    if (stream.rate_hz > 0) add_line(out, "rate", fmt::format("{:.3f} Hz", stream.rate_hz));
  }
}

// "3, 2 of them over the network"
std::string users_text(const StreamInfo& stream, std::uint32_t all, std::uint32_t remote) {
  return fmt::format("{}{}", count_text(stream, all),
                     remote > 0 ? fmt::format(", {} of them over the network", remote) : "");
}

void print_users(const StreamInfo& stream, Output& out) {
  if (stream.users.empty()) return;
  constexpr auto kRight = Table::Align::right;
  Table table({{"USED BY"}, {"ROLE"}, {"HOST"}, {"PID", kRight}, {"UID", kRight}, {"VIA"}});
  for (const StreamUser& user : stream.users) {
    table.add_row({or_dash(escaped(user.program)), std::string(role_name(user.role)),
                   or_dash(escaped(user.host)), user.pid > 0 ? std::to_string(user.pid) : "-",
                   user.uid ? std::to_string(*user.uid) : "-", std::string(name_of(user.via))});
  }
  out.add("\n");
  table.print(out);
}

// Of another host's stream: the copy that this PC keeps of it, while a program reads it here.
void print_mirror(const StreamInfo& stream, const MirrorInfo& mirror, Output& out) {
  std::string state(name_of(mirror.state));
  if (const Duration behind = behind_owner(stream); behind > Duration()) {
    const bool is_live = mirror.state == MirrorState::live;
    state =
        fmt::format("{}{} behind its owner", is_live ? "" : state + ", ", duration_text(behind));
  }
  add_line(out, "mirror",
           fmt::format("{}{}{}", state, mirror.error.empty() ? "" : ": ",
                       escaped_message(mirror.error)));
  add_line(out, "received",
           mirror.newest == kNoTid
               ? "nothing yet"
               : fmt::format("{} samples, {}, up to tid {}", mirror.received_samples,
                             bytes_text(mirror.received_bytes), mirror.newest));
  if (!mirror.clock.empty()) add_line(out, "clock", escaped_message(mirror.clock));
  add_line(out, "missing", fmt::format("{} samples", mirror.gap_samples));
  if (const std::string carried = carried_text(stream); !carried.empty()) {
    add_line(out, "network", carried + "; the others are missing");
  }
  if (mirror.depth > 0 && mirror.depth < stream.depth) {
    add_line(out, "keeps", fmt::format("{} slots here (key mirror_streams)", mirror.depth));
  }
  if (mirror.max_rate_hz > 0) {
    add_line(
        out, "takes",
        fmt::format("at most {:g} samples a second (key mirror_streams); the others are missing",
                    mirror.max_rate_hz));
  }
  if (mirror.filling_samples > 0 && !mirror.history_wanted) {
    add_line(out, "history",
             fmt::format("{} samples are on its host only, until a program here reads them",
                         mirror.filling_samples));
  } else if (mirror.filling_samples > 0) {
    add_line(out, "filling",
             fmt::format("a part of {} samples, some of which are still to come; "
                         "newer ones are here",
                         mirror.filling_samples));
  }
  add_line(out, "reconnects", mirror.reconnects);
  add_line(out, "restarts", mirror.restarts);
}

}  // namespace

void print_stream(const StreamInfo& stream, bool iso, Output& out) {
  out.add(out.bold(escaped(stream.id.str())) + "\n");
  add_line(out, "owner", "host " + escaped(stream.id.host));
  add_line(out, "type", escaped(stream.type.str()));
  add_line(out, "depth", fmt::format("{} slots", stream.depth));
  add_line(out, "cycle", duration_text(stream.cycle));
  print_samples(stream, iso, out);
  add_line(out, "writers", users_text(stream, stream.writers, stream.remote_writers));
  add_line(out, "readers", users_text(stream, stream.readers, stream.remote_readers));
  add_line(
      out, "channels",
      fmt::format("{} to other hosts, for programs there", count_text(stream, stream.channels)));
  const auto add_crashed = [&](const std::string& programs, const std::string& last) {
    add_line(
        out, "crashed",
        fmt::format("{} ended without closing it, the last one was {}", programs, escaped(last)));
  };
  if (stream.crashed_writers > 0) {
    add_crashed(counted(stream.crashed_writers, "writer", "writers"), stream.last_crashed_writer);
  }
  if (stream.crashed_readers > 0) {
    add_crashed(counted(stream.crashed_readers, "reader", "readers"), stream.last_crashed_reader);
  }
  add_line(out, "memory", bytes_text(stream.memory_bytes));
  add_line(out, "property", stream.property_bytes ? bytes_text(stream.property_bytes) : "none");
  add_line(out, "incarnation", stream.incarnation);
  if (stream.creator_pid != 0) {  // not known of a mirror whose owner is unavailable
    add_line(out, "created by", fmt::format("pid {}", stream.creator_pid));
  }
  if (stream.mirror) print_mirror(stream, *stream.mirror, out);
  if (!stream.type.fields.empty()) {
    out.add("\n");
    print_fields(stream.type, out);
  }
  print_users(stream, out);
}

namespace {

Json credentials_json(const DaemonInfo& daemon) {
  if (!daemon.credentials) return {};
  const CredentialsInfo& own = *daemon.credentials;
  return {{"name", own.name},
          {"valid_until_ns", to_ns(own.valid_until)},
          {"problem", or_null(own.problem)}};
}

std::string credentials_text(const DaemonInfo& daemon) {
  if (!daemon.credentials) return "none: connections are not encrypted";
  const CredentialsInfo& own = *daemon.credentials;
  if (!own.problem.empty()) return escaped_message(own.problem);
  return fmt::format("{}, {}", escaped(own.name), validity_text(own));
}

Json limits_json(const DaemonInfo& daemon) {
  Json all = Json::array();
  for (const LimitInfo& one : daemon.limits) {
    all.push_back(
        {{"name", one.name}, {"used", one.used}, {"limit", one.limit}, {"unit", one.unit}});
  }
  return all;
}

void print_limits(const DaemonInfo& daemon, Output& out) {
  if (daemon.limits.empty()) return;
  constexpr auto kRight = Table::Align::right;
  Table table({{"LIMIT"}, {"USED", kRight}, {"OF", kRight}, {"UNIT"}});
  for (const LimitInfo& one : daemon.limits) {
    const bool is_bytes = one.unit == "bytes";
    const auto text = [&](std::uint64_t n) { return is_bytes ? bytes_text(n) : std::to_string(n); };
    table.add_row(
        {escaped(one.name), text(one.used), text(one.limit), is_bytes ? "" : escaped(one.unit)});
  }
  out.add("\n");
  table.print(out);
}

Result<void> print_daemon(Session& session, const InfoOptions& options, Output& out) {
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  const std::vector<HostInfo> hosts = DSSM_TRY(session.list_hosts());
  const std::vector<std::string> addresses =
      hosts.empty() ? std::vector<std::string>() : hosts.front().addresses;
  if (options.json) {
    out.add(json_output({{"host", daemon.host},
                         {"addresses", addresses},
                         {"version", daemon.version},
                         {"pid", daemon.pid},
                         {"streams", daemon.streams},
                         {"memory_bytes", daemon.memory_bytes},
                         {"memory_limit_bytes", daemon.memory_limit_bytes},
                         {"credentials", credentials_json(daemon)},
                         {"config_file", or_null(daemon.config_file)},
                         {"clock_policy", or_null(daemon.clock_policy)},
                         {"limits", limits_json(daemon)}},
                        options.watch));
    return {};
  }
  out.add(out.bold("dssmd " + escaped(daemon.version)) + "\n");
  add_line(out, "host", escaped(daemon.host));
  add_line(out, "addresses", addresses.empty() ? "none" : list_text(addresses));
  add_line(out, "pid", daemon.pid);
  add_line(out, "streams", daemon.streams);
  add_line(out, "memory",
           fmt::format("{} of {}", bytes_text(daemon.memory_bytes),
                       bytes_text(daemon.memory_limit_bytes)));
  add_line(out, "credentials", credentials_text(daemon));
  add_line(out, "config file", or_dash(escaped(daemon.config_file)));
  print_limits(daemon, out);
  return {};
}

Result<void> print_stream_info(Session& session, const StreamId& id, const InfoOptions& options,
                               Output& out) {
  Result<StreamInfo> stream = session.stream_info(id);
  if (!stream) return with_similar_names(std::move(stream).error(), session, id);
  if (options.json) {
    Json json = stream_json(*stream);
    add_details(json, *stream);
    out.add(json_output(json, options.watch));
  } else {
    print_stream(*stream, options.iso, out);
  }
  return {};
}

Result<void> print_live(const InfoOptions& options, Output& out) {
  std::optional<StreamId> id;
  if (!options.stream.empty()) id = DSSM_TRY(StreamId::parse(options.stream));
  Session session = DSSM_TRY(connect(options));
  return print_once_or_watch(options.watch, options.json, out, [&] {
    return id ? print_stream_info(session, *id, options, out) : print_daemon(session, options, out);
  });
}

}  // namespace

Result<void> run(const InfoOptions& options, Output& out) {
  if (is_recording(options.stream)) {
    print_recording(DSSM_TRY(open_readable(options.stream)), options, out);
    return {};
  }
  Result<void> shown = print_live(options, out);
  std::error_code ignored;
  if (shown || options.watch || !std::filesystem::exists(options.stream, ignored)) return shown;
  // `record -o NAME` makes a file, or fills a folder, that nothing tells from a stream's name.
  const Result<Recording> recording = open_readable(options.stream);
  if (!recording) {
    return Error{shown.error().code,
                 fmt::format("{}; and '{}' is not a recording: {}", shown.error().message,
                             escaped(options.stream), recording.error().message)};
  }
  print_recording(*recording, options, out);
  return {};
}

}  // namespace dssm::ctl
