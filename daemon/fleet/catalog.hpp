// SPDX-License-Identifier: Apache-2.0
//
// The catalog: which hosts there are, and which streams they own, as far as known here. Own streams
// are in the Registry; this holds the others'. Peers (configured or found) updates it; whatever has
// to find a stream searches it. One thread, no sockets.
//
// A host is known by its id. Names may collide: then both hosts are kept, and a search by that name
// fails with both of them.
#pragma once

#include <cstdint>
#include <deque>
#include <dssm/result.hpp>
#include <dssm/stream.hpp>
#include <map>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "core/wire/address.hpp"
#include "core/wire/network_protocol.hpp"

namespace dssm::daemon {

// What one host may have us remember. An honest one has at most max_streams <= 32768 streams, which
// take some 300 bytes each, and 50 for each field of their types.
inline constexpr std::size_t kMaxStreamsPerHost = 32768;
inline constexpr std::size_t kMaxBytesPerHost = 32U << 20;

// A host that answers at this moment.
struct KnownHost {
  wire::Greeting greeting;  // name, id, instance id, version, clock
  wire::Address address;    // where it was reached: channels go there too
  std::map<std::pair<std::string, std::int32_t>, StreamInfo> streams;  // by name and id
  std::size_t stream_bytes = 0;                                        // what `streams` takes
  bool is_down = false;

  std::string str() const;  // "host 'pc2' ('10.0.0.2:13776')"
};

// Notified of changes, after they are in the catalog. Handlers must not change the catalog.
class CatalogObserver {
 public:
  virtual void on_host_up(const KnownHost&) {}
  virtual void on_host_down(const KnownHost&, const Error&) {}  // its streams are removed next
  virtual void on_host_clock(const KnownHost&) {}               // it reported its clock
  // Also: it has a new ring, or its ring is described now.
  virtual void on_remote_stream_added(const KnownHost&, const StreamInfo&) {}
  // Another property, or none, from the sample after `stream.newest` on.
  virtual void on_remote_property_set(const StreamInfo& /*stream*/) {}
  // Of a host that is down: maybe after it is up again, and not if it has the stream again.
  virtual void on_remote_stream_removed(const KnownHost&, const StreamInfo&) {}

 protected:
  ~CatalogObserver() = default;
};

class Catalog {
 public:
  // Streams of a host that is down whose removal is reported before others get their turn.
  static constexpr int kRemovedPerTurn = 256;

  explicit Catalog(std::string own_host) : own_host_(std::move(own_host)) {}
  Catalog(const Catalog&) = delete;
  Catalog& operator=(const Catalog&) = delete;

  const std::string& own_host() const noexcept { return own_host_; }

  void add_observer(CatalogObserver& observer);
  void remove_observer(CatalogObserver& observer);  // also from within a handler

  // --- updated by discovery

  // The host answers. When it is known already by another address, the first one stays; a host that
  // comes with another instance id has restarted: it is reported as down first.
  void host_up(const wire::Greeting& greeting, const wire::Address& address);
  // It does not answer any more: it and its streams leave the catalog. Reports the host, and the
  // removal of its first kRemovedPerTurn streams; report_removed() reports the others.
  void host_down(const wire::HostId& id, const Error& error);
  // After host_up() and host_down(): reports some of those that are left.
  //   returns  whether there are more: to be called again, in another turn of the loop
  bool report_removed();
  // A stream is there, has a new ring, or is described. Its id names the owner's host. Descriptions
  // of fields are left out when a host has too many of them; what changes with each sample is not
  // kept.
  //   property_set  that is why the stream is reported again
  //   fails         limit_exceeded (this host has too many streams), not_found (no such host)
  Result<void> stream_added(const wire::HostId& id, StreamInfo stream, bool property_set = false);
  void stream_removed(const wire::HostId& id, const StreamId& stream);
  // The host's newest report of its clock.
  void set_clock(const wire::HostId& id, std::shared_ptr<const wire::ClockReport> clock);

  // --- searched

  const std::map<wire::HostId, KnownHost>& hosts() const noexcept { return hosts_; }

  // The host with that id; nullptr: it is not there.
  const KnownHost* find(const wire::HostId& id) const;

  // The host of that name.
  //   fails  not_found (naming those that are known), conflict (two hosts of that name)
  Result<const KnownHost*> find_host(const std::string& name) const;

  // The host that owns `id`, when it is none of this host's own: the host in `id`, which decides
  // whether it has such a stream; or, without one, the only host that has it.
  //   fails  not_found (what is known, what to do), conflict (naming all that have it)
  Result<const KnownHost*> find_owner(const StreamId& id) const;

  // Whether that very host, known by name, has such a stream at this moment.
  bool has(const StreamId& id) const;

 private:
  using Key = std::pair<std::string, std::int32_t>;
  template <class Notify>
  void notify(const Notify& call);
  std::string host_names() const;  // "'pc2', 'pc3'"

  std::string own_host_;
  std::map<wire::HostId, KnownHost> hosts_;
  std::deque<KnownHost> down_;  // with streams whose removal is still to be reported
  std::vector<CatalogObserver*> observers_;
};

}  // namespace dssm::daemon
