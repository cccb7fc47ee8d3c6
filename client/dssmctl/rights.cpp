// SPDX-License-Identifier: Apache-2.0
//
// dssmctl rights: who may do what with a stream, by this PC's configuration.
#include <fmt/format.h>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// A line of the configuration begins with whom it is about.
std::string who_in(const std::string& line) {
  const std::size_t begin = std::min(line.find_first_not_of(' '), line.size());
  return line.substr(begin, line.find(' ', begin) - begin);
}

// "read,write" as a list.
Json verbs_json(const std::string& verbs) {
  Json list = Json::array();
  for (std::size_t begin = 0; verbs != "none" && begin < verbs.size();) {
    const std::size_t end = std::min(verbs.find(',', begin), verbs.size());
    list.push_back(verbs.substr(begin, end - begin));
    begin = end + 1;
  }
  return list;
}

void print_json(const StreamId& id, const StreamRights& rights, Output& out) {
  Json lines = Json::array();
  for (const RightLine& right : rights.lines) {
    lines.push_back(
        {{"who", who_in(right.line)}, {"verbs", verbs_json(right.verbs)}, {"line", right.line}});
  }
  out.add(json_document({{"stream", id.str()},
                         {"restricted", rights.restricted},
                         {"own_verbs", verbs_json(rights.own_verbs)},
                         {"rights", std::move(lines)}}));
}

}  // namespace

Result<void> run(const RightsOptions& options, Output& out) {
  const StreamId id = DSSM_TRY(StreamId::parse(options.stream));
  Session session = DSSM_TRY(connect(options));
  const StreamRights rights = DSSM_TRY(session.stream_rights(id));
  if (options.json) {
    print_json(id, rights, out);
    return {};
  }
  if (!rights.restricted) {
    out.add("every program and host may do everything: dssmd's key 'rights' has no lines\n");
    return {};
  }
  if (rights.lines.empty()) {
    out.add(
        "no line of dssmd's key 'rights' names this stream: only root and dssmd's own user may use "
        "it\n");
  } else {
    Table table({{"WHO"}, {"MAY"}, {"LINE"}});
    for (const RightLine& right : rights.lines) {
      table.add_row({escaped(who_in(right.line)), escaped(right.verbs), escaped(right.line)});
    }
    table.print(out);
  }
  out.add(fmt::format("you may: {}\n", escaped(rights.own_verbs)));
  return {};
}

}  // namespace dssm::ctl
