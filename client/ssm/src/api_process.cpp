// SPDX-License-Identifier: Apache-2.0
//
// <ssm.h>, <libssm.h>: registration, and the lists of registered processes and open streams.
#include <algorithm>
#include <cstdio>
#include <cstring>
#include <dssm/session.hpp>
#include <optional>
#include <vector>

#include "../include/libssm.h"
#include "core/base/try.hpp"
#include "process.hpp"

using dssm::ssm::process;

namespace {

struct Edge {
  dssm::StreamId stream;
  int source_pid, opener_pid, mode;
};

// What SSM's coordinator knew: the registered processes, and the open streams between them.
struct Graph {
  std::vector<int> pids;  // each once, in the order of registration
  std::vector<Edge> edges;
};

bool contains(const std::vector<int>& pids, int pid) {
  return std::find(pids.begin(), pids.end(), pid) != pids.end();
}

// The mode of an open that is an edge. Readers that programs open by DSSM's own interface count,
// too.
std::optional<int> edge_mode(const dssm::OpenInfo& open) {
  if (open.tag & dssm::ssm::kTagEdge) return static_cast<int>(open.tag & 0xff);
  if (open.tag == 0 && open.role == dssm::Role::reader) return SSM_READ;
  return std::nullopt;
}

// An edge comes from the stream's creator while that is registered, else from a process that writes
// the stream now: a restarted writer, or a second one. Where only other PCs write it, dssmd puts
// their samples into the ring here, so it is the source, and a node beside the registered ones. A
// stream that no process writes has no edges.
dssm::Result<Graph> request_graph(dssm::Session& dssmd) {
  Graph graph;
  for (const dssm::ClientInfo& client : DSSM_TRY(dssmd.list_clients())) {
    if (!contains(graph.pids, client.pid)) graph.pids.push_back(client.pid);
  }
  const std::vector<dssm::OpenInfo> opens = DSSM_TRY(dssmd.list_opens());
  std::optional<dssm::DaemonInfo> daemon;
  std::vector<dssm::StreamInfo> own;
  const auto is_written_elsewhere = [&](const dssm::StreamId& stream) {
    return stream.host != daemon->host ||
           std::any_of(own.begin(), own.end(), [&](const dssm::StreamInfo& info) {
             return info.id == stream && info.remote_writers > 0;
           });
  };
  for (const dssm::OpenInfo& open : opens) {
    const std::optional<int> mode = edge_mode(open);
    if (!mode) continue;
    int source = contains(graph.pids, open.creator_pid) ? open.creator_pid : 0;
    for (const dssm::OpenInfo& other : opens) {
      if (source != 0) break;
      if (other.stream == open.stream && other.role == dssm::Role::writer) {
        source = other.opener_pid;
      }
    }
    if (source == 0) {
      if (!daemon) {
        daemon = DSSM_TRY(dssmd.daemon_info());
        own = DSSM_TRY(dssmd.list_own_streams());
      }
      if (!is_written_elsewhere(open.stream)) continue;
      source = daemon->pid;
    }
    graph.edges.push_back({open.stream, source, open.opener_pid, *mode});
  }
  for (const Edge& edge : graph.edges) {
    if (!contains(graph.pids, edge.source_pid)) graph.pids.push_back(edge.source_pid);
  }
  return graph;
}

dssm::Result<Graph> graph() {
  return process().request([](dssm::Session& dssmd) { return request_graph(dssmd); });
}

}  // namespace

extern "C" {

void errSSM(void) { std::fprintf(stderr, "SSM Err: %s\n", dssm::ssm::last_error); }

int initSSM(void) {
  const dssm::Result<void> started = process().start();
  if (started) return 1;
  dssm::ssm::report_error("initSSM: " + started.error().message);
  return 0;
}

int endSSM(void) { return process().end() ? 1 : 0; }

int getSSM_node_num(void) {
  const auto found = graph();
  return found ? static_cast<int>(found->pids.size()) : -1;
}

int getSSM_node_info(int n, int* node_num) {
  const auto found = graph();
  if (!found || n < 0 || static_cast<std::size_t>(n) >= found->pids.size()) return 0;
  if (node_num) *node_num = found->pids[static_cast<std::size_t>(n)];
  return 1;
}

int getSSM_edge_num(void) {
  const auto found = graph();
  return found ? static_cast<int>(found->edges.size()) : -1;
}

int getSSM_edge_info(int n, char* name, size_t name_size, int* id, int* node1, int* node2,
                     int* dir) {
  const auto found = graph();
  if (!found || n < 0 || static_cast<std::size_t>(n) >= found->edges.size()) return 0;
  const Edge& edge = found->edges[static_cast<std::size_t>(n)];
  if (name && name_size > 0) {
    const std::size_t length = std::min(edge.stream.name.size(), name_size - 1);
    std::memcpy(name, edge.stream.name.data(), length);
    name[length] = '\0';
  }
  if (id) *id = edge.stream.id;
  if (node1) *node1 = edge.source_pid;
  if (node2) *node2 = edge.opener_pid;
  if (dir) *dir = edge.mode;
  return 1;
}

int damp(SSM_sid, int, int) { return 0; }
int add_info(const char*, uint32_t, uint16_t) { return 0; }
int get_info_size(void) { return 0; }
int get_info(char*, uint32_t) { return 0; }

}  // extern "C"
