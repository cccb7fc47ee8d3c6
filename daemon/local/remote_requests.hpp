// SPDX-License-Identifier: Apache-2.0
//
// Serves what programs ask about streams of other hosts, and about the hosts, through Fleet and
// OpenTable. The counterpart of LocalRequests; responses take as long as the other host takes.
#pragma once

#include <dssm/result.hpp>
#include <functional>
#include <memory>

#include "daemon/local/fleet.hpp"
#include "daemon/local/reply.hpp"

namespace dssm::daemon {

class RemoteRequests {
 public:
  RemoteRequests(const std::string& own_host, Fleet& fleet, OpenTable& opens)
      : own_host_(own_host), fleet_(fleet), opens_(opens) {}

  using Client = std::shared_ptr<const ClientIdentity>;
  // Called once: later, or at once. If the client has disconnected by then, its opens are removed
  // again.
  using Answer = std::function<void(Result<Reply>)>;

  // Whether `request` is for other hosts: it is about hosts, or names a stream of another host, or
  // one without a host that this host does not own (`own_knows`).
  bool takes(const local::Request& request,
             const std::function<bool(const StreamId&)>& own_knows) const;

  // Does what such a request asks for.
  void handle_untrusted(const Client& client, const local::Request& request,
                        DescriptorQueue& descriptors, Answer answer);

  // Adds the other hosts' streams to the list of the own ones.
  void complete_list(Reply own, Answer answer);

  // Adds the state of mDNS to the description of this dssmd.
  void complete_daemon(local::Daemon& daemon) const { *daemon.mutable_mdns() = fleet_.mdns(); }

 private:
  void create(const Client& client, const StreamId& id, const proto::Create& request,
              Answer answer);
  void open(const Client& client, const StreamId& id, const proto::Open& request, Answer answer);
  Result<Reply> offer(const Client& client, const StreamId& id, const local::Offer& request,
                      DescriptorQueue& descriptors);
  Reply list_hosts() const;
  Result<Reply> open_clock_page() const;
  void ping(const std::string& host, Answer answer);

  const std::string own_host_;
  Fleet& fleet_;
  OpenTable& opens_;
};

}  // namespace dssm::daemon
