// SPDX-License-Identifier: Apache-2.0
//
// dssmctl nodes: the processes of all hosts that have streams open. One request to dssmd, which
// asks the other hosts.
#include "client/dssmctl/nodes.hpp"

#include <fmt/format.h>
#include <fnmatch.h>

#include <algorithm>
#include <set>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

std::vector<std::string> names_of(const NodeInfo& node, Role role) {
  std::vector<std::string> names;
  for (const NodeStream& use : node.streams) {
    if (use.role == role) names.push_back(stream_name_on(node.host, use.stream));
  }
  return names;
}

Json uses_json(const NodeInfo& node, Role role) {
  Json uses = Json::array();
  for (const NodeStream& use : node.streams) {
    if (use.role != role) continue;
    uses.push_back({{"stream", use.stream.str()}, {"via", name_of(use.via)}});
  }
  return uses;
}

// Not a host that did not answer.
bool is_process(const NodeInfo& node) { return node.error.empty(); }

// Why there are no processes to show; there are `all` that were not asked for.
std::string why_no_nodes(const NodesOptions& options, std::ptrdiff_t all) {
  if (all == 0) return "no process has a stream open";
  const std::string others =
      fmt::format("there {} {} other{}", all == 1 ? "is" : "are", all, all == 1 ? "" : "s");
  if (options.pattern.empty()) return "no process of these hosts has a stream open; " + others;
  return fmt::format("no process whose program fits '{}' has a stream open; {}",
                     escaped(options.pattern), others);
}

// A host that did not answer is shown whatever the name of the process.
bool is_wanted(const NodesOptions& options, const NodeInfo& node) {
  const std::vector<std::string>& hosts = options.hosts;
  if (!hosts.empty() && std::find(hosts.begin(), hosts.end(), node.host) == hosts.end()) {
    return false;
  }
  return options.pattern.empty() || !is_process(node) ||
         ::fnmatch(options.pattern.c_str(), node.program.c_str(), 0) == 0;
}

// A program's PC need not have a dssmd.
Result<void> check_hosts(Session& session, const NodesOptions& options,
                         const std::vector<NodeInfo>& nodes) {
  if (options.hosts.empty()) return {};
  std::set<std::string> known;
  for (const NodeInfo& node : nodes) known.insert(node.host);
  for (const HostInfo& host : DSSM_TRY(session.list_hosts())) {
    if (!host.name.empty()) known.insert(host.name);
  }
  for (const std::string& name : options.hosts) {
    if (known.contains(name)) continue;
    return Error{Errc::not_found,
                 fmt::format("list the processes of host '{}': no such host is known here; known "
                             "are '{}'; see `dssmctl hosts`",
                             name, fmt::join(known, "', '"))};
  }
  return {};
}

}  // namespace

std::string stream_name_on(std::string_view host, const StreamId& stream) {
  const std::string name = short_name(stream);
  return stream.host == host ? name : name + "@" + stream.host;
}

void print_nodes(const std::vector<NodeInfo>& nodes, Output& out) {
  Table table({{"HOST"}, {"PID", Table::Align::right}, {"PROGRAM"}, {"WRITES"}, {"READS"}});
  for (const NodeInfo& node : nodes) {
    if (!is_process(node)) continue;
    const std::vector<std::string> writes = names_of(node, Role::writer),
                                   reads = names_of(node, Role::reader);
    const auto name_in = [](const std::vector<std::string>& names, std::size_t row) {
      return row < names.size() ? escaped(names[row]) : row == 0 ? "-" : "";
    };
    for (std::size_t row = 0; row == 0 || row < std::max(writes.size(), reads.size()); ++row) {
      std::vector<std::string> cells(3);
      if (row == 0) {
        cells = {escaped(node.host), node.pid > 0 ? std::to_string(node.pid) : "-",
                 or_dash(escaped(node.program))};
      }
      cells.push_back(name_in(writes, row));
      cells.push_back(name_in(reads, row));
      table.add_row(std::move(cells));
    }
  }
  table.print(out);
  for (const NodeInfo& node : nodes) {
    if (is_process(node)) continue;
    out.add(fmt::format("{}: not known: {}\n", escaped(node.host), escaped_message(node.error)));
  }
}

Json node_json(const NodeInfo& node) {
  Json json;
  json["host"] = node.host;
  json["pid"] = node.pid > 0 ? Json(node.pid) : Json();
  json["uid"] = node.uid ? Json(*node.uid) : Json();
  json["program"] = or_null(node.program);
  json["writes"] = uses_json(node, Role::writer);
  json["reads"] = uses_json(node, Role::reader);
  json["error"] = or_null(node.error);
  return json;
}

Result<void> run(const NodesOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  std::vector<NodeInfo> nodes = DSSM_TRY(session.list_nodes());
  DSSM_TRY(check_hosts(session, options, nodes));
  const auto all_nodes = std::count_if(nodes.begin(), nodes.end(), is_process);
  std::erase_if(nodes, [&](const NodeInfo& node) { return !is_wanted(options, node); });
  if (!options.json) {
    print_nodes(nodes, out);
    if (std::none_of(nodes.begin(), nodes.end(), is_process)) {
      out.flush();
      print_error(fmt::format("dssmctl: nodes: {}\n", why_no_nodes(options, all_nodes)));
    }
    return {};
  }
  Json all = Json::array();
  for (const NodeInfo& node : nodes) all.push_back(node_json(node));
  out.add(json_document({{"nodes", std::move(all)}}));
  return {};
}

}  // namespace dssm::ctl
