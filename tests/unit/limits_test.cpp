// SPDX-License-Identifier: Apache-2.0
//
// The tables of docs/limits.md say what the code says: each row names a constant or a key of the
// configuration, and has its value. A row without a constant here is an error, and so is the
// reverse.
#include <gtest/gtest.h>

#include <cstdlib>
#include <dssm/pconnector.hpp>
#include <fstream>
#include <map>
#include <regex>
#include <string>

#include "client/src/outbox.hpp"
#include "client/src/subscriber.hpp"
#include "core/base/text.hpp"
#include "core/ring/layout.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/robust_lock.hpp"
#include "core/wire/clock_report.hpp"
#include "core/wire/local_protocol.hpp"
#include "core/wire/messages.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/request_size.hpp"
#include "daemon/base/acceptor.hpp"
#include "daemon/base/log.hpp"
#include "daemon/base/turn_queue.hpp"
#include "daemon/clock/fleet_clock.hpp"
#include "daemon/fleet/catalog.hpp"
#include "daemon/fleet/mdns/service_publisher.hpp"
#include "daemon/fleet/peer_connection.hpp"
#include "daemon/fleet/peers.hpp"
#include "daemon/link/frame_connection.hpp"
#include "daemon/link/sample_pump.hpp"
#include "daemon/local/fleet_service.hpp"
#include "daemon/local/local_service.hpp"
#include "daemon/local/server.hpp"
#include "daemon/remote/mirror_ring.hpp"
#include "daemon/remote/outgoing_ring.hpp"
#include "daemon/remote/remote_writer.hpp"
#include "daemon/serve/data_communicator.hpp"
#include "daemon/serve/peer_table.hpp"
#include "daemon/serve/stream_channel.hpp"
#include "daemon/service/config.hpp"
#include "daemon/streams/descriptor_store.hpp"
#include "daemon/streams/stream.hpp"

namespace dssm::daemon {
namespace {

// By the name in the last column: the value as the table shows it.
using Values = std::map<std::string, std::string>;

std::string count(std::uint64_t number) { return std::to_string(number); }

std::string bytes(std::uint64_t number) {
  if (number % (1U << 20) == 0) return count(number >> 20) + " MiB";
  if (number % (1U << 10) == 0) return count(number >> 10) + " KiB";
  return count(number) + " bytes";
}

std::string time(Duration duration) {
  const std::int64_t ms = to_ns(duration) / 1'000'000;
  return ms % 1000 == 0 ? std::to_string(ms / 1000) + " s" : std::to_string(ms) + " ms";
}

// Macros, so that a name is written once.
#define DSSM_COUNT(name) \
  { #name, count(std::uint64_t{name}) }
#define DSSM_BYTES(name) \
  { #name, bytes(std::uint64_t{name}) }
#define DSSM_TIME(name) \
  { #name, time(name) }

Values values_of_the_code() {
  Config config;
  config.name = "pc1";
  EXPECT_TRUE(finish(config));
  const PConnectorOptions remote;
  return {
      {"max_clients", count(config.max_clients)},
      {"max_clients_per_user", count(config.max_clients_per_user)},
      {"max_streams", count(config.max_streams)},
      {"max_memory", "half of the machine's memory"},
      {"max_opens", count(config.max_opens)},
      {"max_opens_per_client", count(config.max_opens_per_client)},
      {"max_share", count(config.max_share_percent) + "%"},
      {"max_property", bytes(config.max_property_bytes)},
      {"max_connections", count(config.max_connections)},
      {"max_connections_per_host", count(config.max_connections_per_host)},
      {"max_peer_memory", bytes(config.max_peer_memory_bytes)},
      {"PeerTable::Limits::all_bytes()", count(PeerTable::kFullPeers) + " times max_peer_memory"},
      {"PConnectorOptions::max_unsent_samples", count(remote.max_unsent_samples)},
      {"PConnectorOptions::max_unsent_bytes", bytes(remote.max_unsent_bytes)},
      {"PConnectorOptions::request_timeout", time(remote.request_timeout)},
      DSSM_BYTES(kMaxNameBytes),
      DSSM_BYTES(kMaxFullNameBytes),
      DSSM_BYTES(kMaxHostBytes),
      DSSM_BYTES(wire::kMaxProgramBytes),
      DSSM_BYTES(kMaxTypeNameBytes),
      DSSM_COUNT(kMaxFields),
      DSSM_BYTES(kMaxTypeBytes),
      DSSM_BYTES(kMaxPayloadBytes),
      DSSM_COUNT(kMaxDepth),
      DSSM_COUNT(CatalogRequests::kMaxListedFields),
      DSSM_BYTES(wire::kMaxPropertyBytes),
      DSSM_COUNT(ring::kMaxPublishers),
      DSSM_BYTES(wire::kMaxCrashedProgramBytes),
      DSSM_BYTES(wire::kMaxSentenceBytes),
      DSSM_COUNT(kMaxClients),
      DSSM_COUNT(kMaxOpens),
      DSSM_COUNT(kMaxStreams),
      DSSM_COUNT(kMaxConnections),
      DSSM_COUNT(kBacklog),
      DSSM_TIME(kLocalHelloTimeout),
      DSSM_TIME(kLocalOutputTimeout),
      DSSM_TIME(DataCommunicator::kIdleTimeout),
      DSSM_TIME(DataCommunicator::kOutputTimeout),
      DSSM_BYTES(kMaxMessageBytes),
      DSSM_BYTES(kMaxMessageBytesPerUser),
      DSSM_BYTES(kPausingBytes),
      DSSM_TIME(kLongRequestTimeout),
      DSSM_BYTES(kMaxQueuedBytes),
      DSSM_COUNT(kMaxQueuedDescriptors),
      DSSM_COUNT(kMaxUnclaimedDescriptors),
      DSSM_COUNT(wire::kMaxFdsPerMessage),
      DSSM_COUNT(LocalService::kMaxAwaited),
      DSSM_COUNT(LocalService::kMaxAwaitedPerUser),
      DSSM_BYTES(LocalService::kMaxAwaitedBytesPerUser),
      DSSM_BYTES(LocalService::kPingBytes),
      DSSM_BYTES(LocalService::kMaxDeferredBytes),
      DSSM_BYTES(LocalService::kMaxDeferredBytesPerUser),
      DSSM_BYTES(LocalService::kDeferredBytes),
      DSSM_BYTES(LocalService::kMaxNewsBytes),
      DSSM_COUNT(FleetService::kMaxEarlyRequests),
      DSSM_BYTES(FleetService::kMaxEarlyBytes),
      DSSM_COUNT(RateLimitedLogger::kLinesPerPeriod),
      DSSM_COUNT(DescriptorStore::kMaxDescriptors),
      DSSM_TIME(ring::RobustLock::kMaxWait),
      DSSM_COUNT(ring::RingReader::kMaxRetries),
      DSSM_BYTES(PeerTable::kConnectionBytes),
      DSSM_BYTES(PeerTable::kTlsBytes),
      DSSM_TIME(wire::kHelloTimeout),
      DSSM_TIME(wire::kPeerTimeout),
      DSSM_BYTES(DataCommunicator::kMaxQueuedBytes),
      DSSM_COUNT(wire::kMaxFeatures),
      DSSM_BYTES(wire::kMaxFeatureBytes),
      DSSM_BYTES(wire::kMaxLocalRequestBytes),
      DSSM_BYTES(wire::kMaxLocalFrameBytes),
      DSSM_BYTES(wire::kMaxNetworkFrameBytes),
      DSSM_BYTES(wire::kMaxRequestBytes),
      DSSM_BYTES(wire::kMaxCreateBytes),
      DSSM_COUNT(wire::kMaxParsedFields),
      DSSM_BYTES(wire::kMinElementBytes),
      DSSM_BYTES(wire::kMinNodeBytes),
      DSSM_BYTES(wire::kMinFieldBytes),
      DSSM_BYTES(wire::kFreeElementBytes),
      DSSM_COUNT(kRequestsPerTurn),
      DSSM_TIME(kMaxTurn),
      DSSM_COUNT(DataCommunicator::kRequestsPerTurn),
      DSSM_TIME(DataCommunicator::kMaxTurn),
      DSSM_TIME(TurnQueue::kMaxTurn),
      DSSM_COUNT(LocalService::kStreamsPerTurn),
      DSSM_BYTES(LocalService::kStreamBytesPerTurn),
      DSSM_COUNT(LocalService::kOpensPerTurn),
      DSSM_COUNT(FleetService::kEarlyPerTurn),
      DSSM_COUNT(StreamWatch::kStreamsPerTurn),
      DSSM_BYTES(FrameConnection::kBytesPerTurn),
      DSSM_BYTES(wire::FrameDecoder::kCollectedPerReceive),
      DSSM_COUNT(FrameConnection::kReceivesPerTurn),
      DSSM_COUNT(FrameConnection::kSamplesPerTurn),
      DSSM_BYTES(SamplePump::kBytesPerTurn),
      DSSM_COUNT(StreamChannel::kMaxFinds),
      DSSM_COUNT(SamplePump::kSamplesPerTurn),
      DSSM_COUNT(Acceptor::kConnectionsPerTurn),
      DSSM_COUNT(Peers::kMaxFoundHosts),
      DSSM_COUNT(Peers::kMaxAddressesOfHost),
      DSSM_COUNT(ServicePublisher::kMaxGroups),
      DSSM_COUNT(kMaxStreamsPerHost),
      DSSM_BYTES(kMaxBytesPerHost),
      DSSM_COUNT(PeerConnection::kMaxWaiting),
      DSSM_BYTES(PeerConnection::kMaxWaitingBytes),
      DSSM_COUNT(wire::ClockReport::kMaxLinks),
      DSSM_COUNT(wire::ClockReport::kMaxAddresses),
      DSSM_COUNT(wire::kMaxClockPairs),
      DSSM_COUNT(wire::kMaxChannelUsers),
      DSSM_COUNT(FleetClock::kMaxPairs),
      DSSM_COUNT(SamplePump::kMaxPassedOver),
      DSSM_COUNT(MirrorRing::kMaxLostAhead),
      DSSM_COUNT(OutgoingRing::kMinSlots),
      DSSM_TIME(RemoteWriter::kDrainTimeout),
      DSSM_BYTES(detail::Subscriber::kMaxBufferedBytes),
      DSSM_COUNT(detail::Outbox::kMaxUnackedRanges),
  };
}

// "| limit | value | bounds | when it is reached | in the code |". What stands in brackets after a
// value explains it.
Values values_of_the_document() {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");
  std::ifstream file(std::string(root ? root : ".") + "/docs/limits.md");
  const std::regex row(
      R"(\| [^|]+ \| ([^|(]+?)(?: \([^|]*\))? \|[^|]*\|[^|]*\| (?:key )?`(.+)` \|)");
  Values values;
  std::smatch match;
  for (std::string line; std::getline(file, line);) {
    if (!line.starts_with("| ") || line.starts_with("| limit |")) continue;
    if (!std::regex_match(line, match, row)) {
      ADD_FAILURE() << "not a row of a limit: " << line;
    } else if (!values.emplace(match[2], match[1]).second) {
      ADD_FAILURE() << "two rows of " << match[2];
    }
  }
  return values;
}

TEST(Limits, AreInTheDocumentAsInTheCode) {
  const Values documented = values_of_the_document(), real = values_of_the_code();
  for (const auto& [name, value] : real) {
    const auto row = documented.find(name);
    EXPECT_EQ(row == documented.end() ? "no row" : row->second, value) << name;
  }
  for (const auto& [name, value] : documented) {
    EXPECT_TRUE(real.contains(name)) << name << " is not compared; add it to values_of_the_code()";
  }
}

TEST(Limits, HaveARowForEachKeyThatIsOne) {
  const Values documented = values_of_the_document();
  for (const ConfigKey& key : config_keys()) {
    if (!key.name.starts_with("max_") || key.name == "max_drift") continue;
    EXPECT_TRUE(documented.contains(std::string(key.name))) << key.name;
  }
}

}  // namespace
}  // namespace dssm::daemon
