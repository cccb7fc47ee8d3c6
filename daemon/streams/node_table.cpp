// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/node_table.hpp"

#include "core/wire/messages.hpp"

namespace dssm::daemon {

void NodeTable::add(const StreamUser& user, const StreamId& stream) {
  Node& node = nodes_[{user.host, user.program, user.pid}];
  if (user.uid) node.uid = user.uid;
  node.streams.emplace(stream.name, stream.id, stream.host, user.role == Role::writer, user.via);
}

void NodeTable::to_message(proto::NodeList& out) const {
  std::set<std::string> hosts;
  for (const auto& [key, node] : nodes_) hosts.insert(std::get<0>(key));
  for (const auto& [host, error] : errors_) hosts.insert(host);
  hosts.erase(own_host_);
  add_host(own_host_, out);
  for (const std::string& host : hosts) add_host(host, out);
}

void NodeTable::add_host(const std::string& host, proto::NodeList& out) const {
  for (auto next = nodes_.lower_bound({host, "", 0});
       next != nodes_.end() && std::get<0>(next->first) == host; ++next) {
    const auto& [key, node] = *next;
    proto::Node& message = *out.add_nodes();
    message.set_host(host);
    message.set_program(std::get<1>(key));
    message.set_pid(std::get<2>(key));
    if (node.uid) message.set_uid(*node.uid);
    for (const auto& [name, id, owner, writes, via] : node.streams) {
      proto::NodeStream& stream = *message.add_streams();
      wire::to_message(StreamId{name, id, owner}, *stream.mutable_id());
      stream.set_writer(writes);
      stream.set_via(static_cast<proto::Via>(via));
    }
  }
  const auto error = errors_.find(host);
  if (error == errors_.end()) return;
  proto::Node& unknown = *out.add_nodes();
  unknown.set_host(host);
  unknown.set_error(error->second);
}

}  // namespace dssm::daemon
