// SPDX-License-Identifier: Apache-2.0
//
// Processes and what each reads and writes, as `dssmctl nodes` and `dssmctl graph` show them.
#pragma once

#include <dssm/session.hpp>
#include <string>
#include <string_view>
#include <vector>

#include "client/dssmctl/output.hpp"

namespace dssm::ctl {

// The name of a stream that a process on `host` uses: short, with its own host if it has another.
std::string stream_name_on(std::string_view host, const StreamId& stream);

// A row for each process, with further rows below it where it uses several streams; then a line for
// each host that did not answer.
void print_nodes(const std::vector<NodeInfo>& nodes, Output& out);

Json node_json(const NodeInfo& node);

// The graph in the DOT language of Graphviz: ellipses for processes, boxes for streams, a frame for
// each host, and arrows in the direction in which samples go, dashed ones over the network.
//   streams  all that there are, also those that no process uses
std::string dot_graph(const std::vector<NodeInfo>& nodes, const std::vector<StreamInfo>& streams);

// `text` inside the quotes of a label in the DOT language, which shows just that text; line breaks
// and other control characters as escape sequences.
std::string dot_text(std::string_view text);

}  // namespace dssm::ctl
