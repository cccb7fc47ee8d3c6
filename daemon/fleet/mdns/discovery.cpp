// SPDX-License-Identifier: Apache-2.0
#include "daemon/fleet/mdns/discovery.hpp"

#include <algorithm>
#include <utility>

namespace dssm::daemon {
namespace {

// After a change: each list describes all streams, and a thousand may be created in a row.
constexpr Duration kAnnouncePause = std::chrono::milliseconds(50);

}  // namespace

Reach reach_of(const std::vector<std::string>& addresses) {
  Reach reach;
  for (const std::string& text : addresses) {
    const Result<wire::Address> address = wire::Address::parse(text);
    if (!address) continue;
    const std::vector<wire::SocketAddress> numbers = wire::resolve_number(*address);
    const bool loopback =
        std::all_of(numbers.begin(), numbers.end(),
                    [](const wire::SocketAddress& number) { return number.is_loopback(); });
    if (reach.port == 0 || (reach.closed && !loopback)) reach = {address->port, loopback};
  }
  return reach;
}

Discovery::Discovery(const EventLoop& loop, Options options, Registry& registry, Peers& peers,
                     Logger& logger)
    : options_(std::move(options)),
      registry_(registry),
      announce_timer_(EventSource::timer(loop, [this] { announce(); })),
      mdns_(loop,
            {options_.self.host_id, options_.reach.port, options_.interfaces,
             options_.avoid_interfaces},
            peers, logger) {
  peers.expect_finder(options_.leaves_pc);
  registry_.add_observer(*this);
}

Discovery::~Discovery() { registry_.remove_observer(*this); }

void Discovery::start_announcing() {
  announcing_ = options_.reach.port != 0;
  announce();
}

void Discovery::on_stream_added(const Stream&) { announce_soon(); }

void Discovery::on_stream_described(const Stream&) { announce_soon(); }

void Discovery::on_stream_removed(const Stream&) { announce_soon(); }

void Discovery::announce_soon() {
  if (!std::exchange(announce_is_due_, true)) announce_timer_.enable_in(kAnnouncePause);
}

// The host first: by it others find all the rest. A host that others cannot reach keeps the names
// of its streams to itself.
void Discovery::announce() {
  announce_is_due_ = false;
  if (!announcing_) return;
  std::vector<ServiceRecord> records;
  ServiceRecord& host = records.emplace_back();
  host.host_id = options_.self.host_id;
  host.host = options_.self.host;
  host.protocol_version = wire::kNetworkProtocolVersion;
  host.closed = options_.reach.closed;
  if (!host.closed) {
    records.reserve(1 + registry_.streams().size());
    for (const std::shared_ptr<Stream>& stream : registry_.streams()) {
      const StreamInfo info = stream->info();
      ServiceRecord record = records.front();
      record.stream = {info.id.name, info.id.id,     info.type.payload_bytes, info.depth,
                       info.cycle,   info.type.name, type_hash(info.type),    info.incarnation};
      records.push_back(std::move(record));
    }
  }
  mdns_.announce(std::move(records));
}

}  // namespace dssm::daemon
