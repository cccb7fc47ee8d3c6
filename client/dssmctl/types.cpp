// SPDX-License-Identifier: Apache-2.0
//
// dssmctl find: the streams that carry a type; dssmctl show: what such a type looks like.
#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>
#include <set>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

Error no_such_type(const std::string& wanted, const std::vector<StreamInfo>& streams) {
  std::set<std::string> known;
  for (const StreamInfo& stream : streams) {
    if (!stream.type.name.empty()) known.insert(stream.type.name);
  }
  return {Errc::not_found,
          fmt::format("no stream carries the type '{}'; {}", wanted,
                      known.empty() ? "no stream has a type with a name"
                                    : fmt::format("there are '{}'", fmt::join(known, "', '")))};
}

// Streams of one name of a type may have different definitions of it.
struct Definition {
  TypeInfo type;
  std::vector<std::string> streams;
};

Result<std::vector<Definition>> definitions_of(Session& session, const std::string& type) {
  const std::vector<StreamInfo> streams = DSSM_TRY(session.list_streams());
  std::vector<Definition> definitions;
  for (const StreamInfo& listed : streams) {
    if (listed.type.name != type) continue;
    // Lists leave out the fields of many types; the stream may be gone by now.
    const Result<StreamInfo> stream = session.stream_info(listed.id);
    const TypeInfo& its = stream ? stream->type : listed.type;
    const auto same = std::find_if(definitions.begin(), definitions.end(),
                                   [&](const Definition& one) { return one.type == its; });
    Definition& one =
        same == definitions.end() ? definitions.emplace_back(Definition{its, {}}) : *same;
    one.streams.push_back(listed.id.str());
  }
  if (definitions.empty()) return no_such_type(type, streams);
  return definitions;
}

}  // namespace

Result<void> run(const FindOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  const std::vector<StreamInfo> streams = DSSM_TRY(session.list_streams());
  const DaemonInfo daemon = DSSM_TRY(session.daemon_info());
  const std::vector<std::string> names = opening_names(streams, daemon.host);
  Json found = Json::array();
  for (std::size_t i = 0; i < streams.size(); ++i) {
    const std::string& type = streams[i].type.name;
    if (type.empty() || ::fnmatch(options.type.c_str(), type.c_str(), 0) != 0) continue;
    found.push_back({{"stream", streams[i].id.str()}, {"type", type}});
    if (!options.json) out.add((out.terminal() ? escaped(names[i]) : names[i]) + "\n");
  }
  if (found.empty()) return no_such_type(options.type, streams);
  if (options.json) out.add(json_document({{"streams", std::move(found)}}));
  return {};
}

Result<void> run(const ShowOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  const std::vector<Definition> definitions = DSSM_TRY(definitions_of(session, options.type));
  Json all = Json::array();
  for (const Definition& one : definitions) {
    if (options.json) {
      all.push_back({{"payload_bytes", one.type.payload_bytes},
                     {"alignment_bytes", one.type.alignment_bytes},
                     {"fields", fields_json(one.type)},
                     {"streams", one.streams}});
      continue;
    }
    if (&one != &definitions.front()) out.add("\n");
    out.add(fmt::format("{}: {}\n", out.bold(escaped(one.type.str())), list_text(one.streams)));
    if (one.type.fields.empty()) {
      out.add("its fields are not described (DSSM_DESCRIBE, or `dssmctl describe`)\n");
    } else {
      print_fields(one.type, out);
    }
  }
  if (options.json) {
    out.add(json_document({{"type", options.type}, {"definitions", std::move(all)}}));
  }
  return {};
}

}  // namespace dssm::ctl
