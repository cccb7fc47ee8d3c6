// SPDX-License-Identifier: Apache-2.0
//
// dssmctl describe: names for the bytes of streams whose programs do not describe them.
#include "client/dssmctl/describe_stream.hpp"

#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Of the programs that have `stream` open here: writers first, and each once.
Result<std::vector<StreamUser>> programs_here(Session& session, const StreamInfo& stream) {
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  std::vector<StreamUser> programs;
  for (const Role role : {Role::writer, Role::reader}) {
    for (const StreamUser& user : stream.users) {
      const bool is_here = user.host.empty() || user.host == daemon.host;
      const auto is_same = [&](const StreamUser& one) { return one.pid == user.pid; };
      if (user.role == role && is_here && user.pid > 0 && user.pid != ::getpid() &&
          std::ranges::none_of(programs, is_same)) {
        programs.push_back(user);
      }
    }
  }
  return programs;
}

std::string file_of(const StreamUser& program) { return fmt::format("/proc/{}/exe", program.pid); }

Result<DebugType> type_in(const std::string& path, const StreamInfo& stream,
                          const std::string& type_name) {
  const std::string& name = type_name.empty() ? stream.type.name : type_name;
  return choose_type(DSSM_TRY(debug_types_untrusted(path, name, stream.type.payload_bytes)), stream,
                     name, path);
}

Result<ProgramType> first_type(const std::vector<StreamUser>& programs, const StreamInfo& stream,
                               const std::string& type_name) {
  Error error{Errc::not_found,
              fmt::format("describe '{}': no program of this PC has it open; give the file of one "
                          "with --from",
                          stream.id.str())};
  std::string reasons;
  for (const StreamUser& program : programs) {
    const std::string source = fmt::format("'{}' (pid {})", escaped(program.program), program.pid);
    Result<DebugType> found = type_in(file_of(program), stream, type_name);
    if (found) return ProgramType{*std::move(found), source};
    reasons += fmt::format("{}{}: {}", reasons.empty() ? "" : "; ", source, found.error().message);
  }
  if (!reasons.empty()) error.message = reasons + "; --from takes the type from another file";
  return error;
}

// --- the verb

// What the stream has already is not to be lost unless that is asked for.
Result<void> check_replaceable(const StreamInfo& stream, const DescribeOptions& options) {
  if (options.force) return {};
  if (!stream.type.fields.empty()) {
    return Error{Errc::conflict,
                 fmt::format("describe '{0}': its fields are described already (`dssmctl info {0}` "
                             "shows them); --force replaces them",
                             stream.id.str())};
  }
  if (!options.type.empty() && !stream.type.name.empty() && options.type != stream.type.name) {
    return Error{Errc::conflict,
                 fmt::format("describe '{}': its programs call its type '{}', not '{}'; --force "
                             "replaces the name",
                             stream.id.str(), stream.type.name, options.type)};
  }
  return {};
}

// `found` for a stream whose own type has no fields, but may have a name, which is kept.
void keep_declared_name(TypeInfo& found, const TypeInfo& own) {
  if (own.name.empty()) return;
  found.name = own.name;
  found.alignment_bytes = own.alignment_bytes;
}

Result<ProgramType> describe_stream(Session& session, const StreamInfo& stream,
                                    const DescribeOptions& options) {
  DSSM_TRY(check_replaceable(stream, options));
  ProgramType type;
  if (options.from.empty()) {
    type = DSSM_TRY(type_of_programs(session, stream, options.type));
  } else {
    type = {DSSM_TRY(type_in(options.from, stream, options.type)),
            fmt::format("'{}'", escaped(options.from))};
  }
  TypeInfo& described = type.found.type;
  if (described.fields.empty()) {
    return Error{
        Errc::invalid_argument,
        fmt::format("describe '{}': '{}' has no field that can be described: {}", stream.id.str(),
                    escaped(type.found.full_name), list_text(type.found.left_out))};
  }
  if (!options.force) keep_declared_name(described, stream.type);
  DSSM_TRY(session.describe(stream.id, described, options.force));
  return type;
}

void print_described(const StreamInfo& stream, const ProgramType& type, bool with_fields,
                     Output& out) {
  out.add(fmt::format("{}: {}, from {}\n", out.bold(escaped(stream.id.str())),
                      escaped(type.found.type.str()), type.source));
  if (with_fields) print_fields(type.found.type, out);
  for (const std::string& member : type.found.left_out) {
    out.add(fmt::format("not described: {}\n", escaped(member)));
  }
}

Json described_json(const StreamInfo& stream, const ProgramType& type) {
  return {{"stream", stream.id.str()},
          {"type", type.found.type.name},
          {"payload_bytes", type.found.type.payload_bytes},
          {"alignment_bytes", type.found.type.alignment_bytes},
          {"from", type.source},
          {"fields", fields_json(type.found.type)},
          {"left_out", type.found.left_out}};
}

// All streams that are not described and that programs of this PC have open.
Result<void> describe_all(Session& session, const DescribeOptions& options, Output& out) {
  Json all = Json::array();
  std::optional<Error> failure;
  for (const StreamInfo& listed : DSSM_TRY(session.list_streams())) {
    // Lists leave out the fields of many types; the stream may be gone by now.
    const Result<StreamInfo> stream = session.stream_info(listed.id);
    if (!stream || !stream->type.fields.empty()) continue;
    if (DSSM_TRY(programs_here(session, *stream)).empty()) continue;
    const Result<ProgramType> type = describe_stream(session, *stream, options);
    if (!type) {
      failure = type.error();
      print_error(fmt::format("dssmctl: describe: {}\n", escaped_message(type.error().message)));
      continue;
    }
    all.push_back(described_json(*stream, *type));
    if (!options.json) print_described(*stream, *type, false, out);
  }
  if (options.json) {
    out.add(json_document({{"streams", std::move(all)}}));
  } else if (all.empty() && !failure) {
    out.add("nothing to do: all streams that programs of this PC have open are described\n");
  }
  if (!failure) return {};
  return Error{failure->code, "some streams could not be described"};
}

}  // namespace

Result<ProgramType> type_of_programs(Session& session, const StreamInfo& stream,
                                     const std::string& type_name) {
  return first_type(DSSM_TRY(programs_here(session, stream)), stream, type_name);
}

namespace {

std::optional<ProgramType> obvious_type_of(Session& session, const StreamInfo& stream) {
  Result<std::vector<StreamUser>> programs = programs_here(session, stream);
  if (!programs) return std::nullopt;
  // A file may be made to harm who parses it.
  std::erase_if(*programs, [](const StreamUser& program) {
    struct stat file {};
    return ::stat(file_of(program).c_str(), &file) != 0 ||
           (file.st_uid != 0 && file.st_uid != ::geteuid());
  });
  Result<ProgramType> type = first_type(*programs, stream, "");
  const bool is_obvious = type && (type->found.is_stream_type || !stream.type.name.empty() ||
                                   is_named_alike(type->found.type.name, stream.id.name));
  if (!is_obvious || type->found.type.fields.empty()) return std::nullopt;
  return *std::move(type);
}

}  // namespace

std::optional<ProgramType> obvious_type_of_programs(Session& session, const StreamId& id) {
  const Result<StreamInfo> stream = session.stream_info(id);
  return stream ? obvious_type_of(session, *stream) : std::nullopt;
}

std::map<std::pair<std::string, std::uint64_t>, TypeInfo> obvious_types_of_programs(
    Session& session, const std::vector<StreamInfo>& streams, Duration at_most) {
  std::map<std::pair<std::string, std::uint64_t>, TypeInfo> types;
  const MonoTime end = deadline_in(at_most);
  for (const StreamInfo& listed : streams) {
    if (MonoClock::now() >= end) break;
    // Lists leave out the fields of many types; the stream may be gone by now.
    const Result<StreamInfo> stream = session.stream_info(listed.id);
    if (!stream || !stream->type.fields.empty()) continue;
    if (std::optional<ProgramType> type = obvious_type_of(session, *stream)) {
      keep_declared_name(type->found.type, stream->type);
      types.emplace(std::pair(listed.id.str(), stream->incarnation), std::move(type->found.type));
    }
  }
  return types;
}

TypeInfo obvious_type(Session& session, const RawReader& reader, std::string_view verb) {
  if (!reader.type().fields.empty()) return {};
  const auto type = obvious_type_of_programs(session, reader.id());
  if (!type) return {};
  print_error(fmt::format(
      "dssmctl: {}: '{}' is shown as {} of {}; `dssmctl describe {}` shows it so everywhere\n",
      verb, escaped(reader.id().str()), escaped(type->found.type.str()), type->source,
      escaped(reader.id().str())));
  return type->found.type;
}

const TypeInfo& type_to_show(const TypeInfo& own, const TypeInfo& obvious) {
  return own.fields.empty() && own.payload_bytes == obvious.payload_bytes ? obvious : own;
}

Result<void> run(const DescribeOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  if (options.stream.empty()) return describe_all(session, options, out);
  const StreamId id = DSSM_TRY(StreamId::parse(options.stream));
  Result<StreamInfo> stream = session.stream_info(id);
  if (!stream) return with_similar_names(std::move(stream).error(), session, id);
  const ProgramType type = DSSM_TRY(describe_stream(session, *stream, options));
  if (options.json) {
    out.add(json_document({{"streams", Json::array({described_json(*stream, type)})}}));
  } else {
    print_described(*stream, type, true, out);
  }
  return {};
}

}  // namespace dssm::ctl
