// SPDX-License-Identifier: Apache-2.0
//
// The catalog: which hosts there are, and which streams they own, as far as known here. Own streams
// stand in the Registry; this holds the others'. It is fed by discovery (configured peers today,
// mDNS in a later round) and asked by everybody who has to find a stream. One thread, no sockets.
#pragma once

#include <cstdint>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

// A host that answers at this moment.
struct KnownHost {
  wire::Greeting greeting;  // name, id, life, version, clock bound
  wire::Address address;    // where it was reached: channels go there too
  std::map<std::pair<std::string, std::int32_t>, StreamInfo> streams;  // by name and id
};

// Told about changes, after they are in the catalog. Handlers must not change the catalog.
class CatalogObserver {
 public:
  virtual void on_host_up(const KnownHost&) {}
  virtual void on_host_down(const KnownHost&, const Error&) {}
  virtual void on_remote_stream_added(const KnownHost&, const StreamInfo&) {}
  virtual void on_remote_stream_removed(const KnownHost&, const StreamInfo&) {}

 protected:
  ~CatalogObserver() = default;
};

class Catalog {
 public:
  explicit Catalog(std::string own_host) : own_host_(std::move(own_host)) {}
  Catalog(const Catalog&) = delete;
  Catalog& operator=(const Catalog&) = delete;

  void add_observer(CatalogObserver& observer);
  void remove_observer(CatalogObserver& observer);

  // --- fed by discovery -----------------------------------------------------------------------

  // The host answers. When it is known already by another address, the first one stays; a host that
  // comes with another `life` has restarted: its streams are told as removed first.
  void host_up(const wire::Greeting& greeting, const wire::Address& address);
  // It does not answer any more: its streams leave the catalog.
  void host_down(const wire::HostId& id, const Error& why);
  void stream_added(const wire::HostId& id, const StreamInfo& stream);  // or changed: new ring
  void stream_removed(const wire::HostId& id, const StreamId& stream);

  // --- asked ----------------------------------------------------------------------------------

  const std::map<wire::HostId, KnownHost>& hosts() const noexcept { return hosts_; }

  // The host of that name.
  //   fails  not_found (naming those that are known), conflict (two hosts of that name)
  Result<const KnownHost*> find_host(const std::string& name) const;

  // The host that owns `id`, when it is none of this host's own: by the host in `id`, or, without
  // one, the only one that has a stream of that name.
  //   fails  not_found (what is known, what to do), conflict (naming all that have it)
  Result<const KnownHost*> find_owner(const StreamId& id) const;

 private:
  std::string own_host_;
  std::map<wire::HostId, KnownHost> hosts_;
  std::vector<CatalogObserver*> observers_;
};

}  // namespace dssm::daemon
