// SPDX-License-Identifier: Apache-2.0
//
// <ssm.h>, <libssm.h>: registration, and the lists of registered processes and open streams.
#include <algorithm>
#include <cstdio>
#include <cstring>
#include <dssm/session.hpp>
#include <optional>

#include "../include/libssm.h"
#include "process.hpp"

using dssm::ssm::process;

namespace {

struct Edge {
  dssm::StreamId stream;
  int creator_pid, opener_pid, mode;
};

// The pids of the registered processes, each once, in the order of registration.
std::optional<std::vector<int>> registered_pids() {
  const auto clients = process().request([](dssm::Session& dssmd) { return dssmd.list_clients(); });
  if (!clients) return std::nullopt;
  std::vector<int> pids;
  for (const dssm::ClientInfo& client : *clients) {
    if (std::find(pids.begin(), pids.end(), client.pid) == pids.end()) pids.push_back(client.pid);
  }
  return pids;
}

// The open streams, with the processes that created and opened them. Readers that programs open by
// DSSM's own interface count too.
std::optional<std::vector<Edge>> edges() {
  const auto opens = process().request([](dssm::Session& dssmd) { return dssmd.list_opens(); });
  if (!opens) return std::nullopt;
  std::vector<Edge> found;
  for (const dssm::OpenInfo& open : *opens) {
    if (open.tag & dssm::ssm::kTagEdge) {
      found.push_back(
          {open.stream, open.creator_pid, open.opener_pid, static_cast<int>(open.tag & 0xff)});
    } else if (open.tag == 0 && open.role == dssm::Role::reader) {
      found.push_back({open.stream, open.creator_pid, open.opener_pid, SSM_READ});
    }
  }
  const auto pids = registered_pids();  // an edge ends with either of its processes
  if (!pids) return std::nullopt;
  std::erase_if(found, [&](const Edge& edge) {
    return std::find(pids->begin(), pids->end(), edge.creator_pid) == pids->end();
  });
  return found;
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
  const auto pids = registered_pids();
  return pids ? static_cast<int>(pids->size()) : -1;
}

int getSSM_node_info(int n, int* node_num) {
  const auto pids = registered_pids();
  if (!pids || n < 0 || static_cast<std::size_t>(n) >= pids->size()) return 0;
  if (node_num) *node_num = (*pids)[static_cast<std::size_t>(n)];
  return 1;
}

int getSSM_edge_num(void) {
  const auto found = edges();
  return found ? static_cast<int>(found->size()) : -1;
}

int getSSM_edge_info(int n, char* name, size_t name_size, int* id, int* node1, int* node2,
                     int* dir) {
  const auto found = edges();
  if (!found || n < 0 || static_cast<std::size_t>(n) >= found->size()) return 0;
  const Edge& edge = (*found)[static_cast<std::size_t>(n)];
  if (name && name_size > 0) {
    const std::size_t length = std::min(edge.stream.name.size(), name_size - 1);
    std::memcpy(name, edge.stream.name.data(), length);
    name[length] = '\0';
  }
  if (id) *id = edge.stream.id;
  if (node1) *node1 = edge.creator_pid;
  if (node2) *node2 = edge.opener_pid;
  if (dir) *dir = edge.mode;
  return 1;
}

int damp(SSM_sid, int, int) { return 0; }
int add_info(const char*, uint32_t, uint16_t) { return 0; }
int get_info_size(void) { return 0; }
int get_info(char*, uint32_t) { return 0; }

}  // extern "C"
