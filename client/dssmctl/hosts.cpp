// SPDX-License-Identifier: Apache-2.0
//
// dssmctl hosts: this PC and those that its dssmd knows, one row per way to reach one. A host that
// is down is what a person wants to see here, so it is no failure.
#include <set>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// Each name once: a host with several addresses has a row for each, one that never answered has no
// name yet.
void print_names(const std::vector<HostInfo>& hosts, Output& out) {
  std::set<std::string> names;
  for (const HostInfo& host : hosts) {
    if (host.name.empty() || !names.insert(host.name).second) continue;
    out.add(escaped(host.name) + "\n");
  }
}

Result<void> print_hosts(Session& session, const HostsOptions& options, Output& out) {
  const std::vector<HostInfo> hosts = DSSM_TRY(session.list_hosts());
  if (options.json) {
    Json all = Json::array();
    for (const HostInfo& host : hosts) all.push_back(host_json(host));
    out.add(json_output({{"hosts", std::move(all)}}, options.watch));
  } else if (options.names) {
    print_names(hosts, out);
  } else {
    Table table(host_columns());
    for (const HostInfo& host : hosts) table.add_row(host_row(host));
    table.print(out);
  }
  return {};
}

}  // namespace

Result<void> run(const HostsOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  return print_once_or_watch(options.watch, options.json, out,
                             [&] { return print_hosts(session, options, out); });
}

}  // namespace dssm::ctl
