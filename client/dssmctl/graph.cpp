// SPDX-License-Identifier: Apache-2.0
//
// dssmctl graph: who gives samples to whom, as a drawing. Graphviz's dot(1) draws it; without --out
// its input is what is printed.
#include <fmt/format.h>

#include <cerrno>
#include <fstream>
#include <map>
#include <utility>

#include "client/dssmctl/describe.hpp"
#include "client/dssmctl/draw.hpp"
#include "client/dssmctl/names.hpp"
#include "client/dssmctl/nodes.hpp"
#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// What is inside one host's frame, as lines of the DOT language.
struct HostLines {
  std::string lines;
  std::string error;
};

// Puts the graph together. What has a name of its own there is called p0, p1 ... and s0, s1 ..., so
// that only labels hold text of others.
class Graph {
 public:
  // rate: "10.0 Hz", or "-" without one
  void add_stream(const StreamId& id, const std::string& rate) {
    if (!streams_.emplace(id.str(), streams_.size()).second) return;
    std::string label = dot_text(short_name(id));
    if (rate != "-") label += "\\n" + rate;
    hosts_[id.host].lines +=
        fmt::format("    s{} [shape=box, label=\"{}\"];\n", streams_.size() - 1, label);
  }

  void add_node(const NodeInfo& node) {
    if (!node.error.empty()) {
      hosts_[node.host].error = node.error;
      return;
    }
    const std::string label =
        dot_text(node.program) + (node.pid > 0 ? fmt::format("\\npid {}", node.pid) : "");
    hosts_[node.host].lines +=
        fmt::format("    p{} [shape=ellipse, label=\"{}\"];\n", nodes_, label);
    for (const NodeStream& use : node.streams) {
      add_stream(use.stream, "-");
      const std::size_t stream = streams_.at(use.stream.str());
      const char* style = use.via == StreamVia::local ? "" : " [style=dashed]";
      edges_ += use.role == Role::writer ? fmt::format("  p{} -> s{}{};\n", nodes_, stream, style)
                                         : fmt::format("  s{} -> p{}{};\n", stream, nodes_, style);
    }
    ++nodes_;
  }

  std::string text() const {
    std::string text = "digraph dssm {\n  rankdir=LR;\n  node [fontname=\"sans-serif\"];\n";
    text += "  graph [fontname=\"sans-serif\"];\n";
    std::size_t number = 0;
    for (const auto& [host, inside] : hosts_) {
      const std::string note = inside.error.empty() ? "" : "\\nprocesses not known";
      text += fmt::format("  subgraph cluster_{} {{\n    label=\"{}{}\";\n{}", number,
                          dot_text(host), note, inside.lines);
      // A frame without content is not drawn.
      if (inside.lines.empty()) text += fmt::format("    h{} [style=invis];\n", number);
      text += "  }\n";
      ++number;
    }
    return text + edges_ + "}\n";
  }

 private:
  std::map<std::string, HostLines> hosts_;
  std::map<std::string, std::size_t> streams_;  // by full name
  std::size_t nodes_ = 0;
  std::string edges_;
};

Error cannot_write(const std::string& file, int error) {
  return os_error("write '" + file + "'", error);
}

Result<void> write_file(const std::string& file, const std::string& text) {
  std::ofstream out(file, std::ios::binary | std::ios::trunc);
  out << text;
  out.close();
  return out ? Result<void>() : cannot_write(file, errno);
}

}  // namespace

std::string dot_text(std::string_view text) {
  // Control characters are escaped as in all of dssmctl's output, and so is text that is not UTF-8,
  // which dot would change.
  const std::string shown = is_utf8(text) && !has_control(text) ? std::string(text) : escaped(text);
  std::string label;
  for (const char c : shown) {
    if (c == '"' || c == '\\') {
      label += '\\';
      label += c;
    } else if (c == '&') {
      label += "&amp;";
    } else {
      label += c;
    }
  }
  return label;
}

std::string dot_graph(const std::vector<NodeInfo>& nodes, const std::vector<StreamInfo>& streams) {
  Graph graph;
  for (const StreamInfo& stream : streams) graph.add_stream(stream.id, rate_text(stream));
  for (const NodeInfo& node : nodes) graph.add_node(node);
  return graph.text();
}

Result<void> run(const GraphOptions& options, Output& out) {
  Session session = DSSM_TRY(connect(options));
  const std::vector<StreamInfo> streams = DSSM_TRY(session.list_streams());
  const std::vector<NodeInfo> nodes = DSSM_TRY(session.list_nodes());
  if (options.json) {
    Json all_nodes = Json::array(), all_streams = Json::array();
    for (const NodeInfo& node : nodes) all_nodes.push_back(node_json(node));
    for (const StreamInfo& stream : streams) all_streams.push_back(stream_json(stream));
    out.add(json_document({{"nodes", std::move(all_nodes)}, {"streams", std::move(all_streams)}}));
    return {};
  }
  const std::string text = dot_graph(nodes, streams);
  if (options.out.empty()) {
    out.add(text);
    return {};
  }
  if (options.format == "dot") return write_file(options.out, text);
  return draw(options.out, {"dot", "-T" + options.format, "-o", options.out}, text,
              "install Graphviz (`sudo apt install graphviz`), or write a .dot file and draw it "
              "elsewhere");
}

}  // namespace dssm::ctl
