// SPDX-License-Identifier: Apache-2.0
//
// A peer on the network that speaks the protocol by hand: so that tests can do what no client of
// ours would. Blocking; a dssmd that does not answer ends the wait after kPatienceSeconds.
#pragma once

#include <deque>
#include <dssm/sample.hpp>
#include <memory>
#include <string>
#include <string_view>
#include <vector>

#include "core/base/unique_fd.hpp"
#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"
#include "core/wire/frame_decoder.hpp"
#include "core/wire/network_protocol.hpp"
#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {

// A frame that came.
struct Received {
  net::Frame frame;  // with `sample`, without payload
  std::vector<std::byte> payload;
  bool torn = false;
  bool ended = false;  // the connection ended instead
};

class RawPeer final : private wire::FrameDelegate {
 public:
  // Connects to "127.0.0.1:1234"; without `greet` it says nothing.
  explicit RawPeer(const std::string& address, bool greet = true, bool torn = true);
  RawPeer(const RawPeer&) = delete;
  RawPeer& operator=(const RawPeer&) = delete;

  void send(const net::Frame& frame);
  void send_bytes(std::string_view bytes);
  void send_sample(std::int64_t number, std::span<const std::byte> payload, Time time,
                   std::uint64_t serial = 0);

  Received receive();  // the next frame of any kind
  // Sends `request` under a new serial and returns its answer; whatever comes before it is dropped.
  Received ask(net::Frame request);

  // Reads to the end; returns the message of the last words.
  std::string final_failure();

  // Opens or creates a stream for this channel.
  proto::Opened open(const std::string& name);
  proto::Opened create(const std::string& name, std::uint64_t payload_bytes, std::uint64_t depth);

  int fd() const { return socket_.get(); }
  void close() { socket_.reset(); }
  const proto::Hello& server() const { return server_; }

 private:
  Result<void> on_sample_begin(const wire::IncomingSample& sample, std::byte*& out) override;
  Result<void> on_sample_end(const wire::IncomingSample& sample, bool torn) override;
  Result<void> on_frame(net::Frame& frame) override;

  UniqueFd socket_;
  wire::FrameDecoder decoder_{*this, wire::kMaxNetworkFrameBytes};
  std::deque<Received> received_;
  Received arriving_;
  proto::Hello server_;
  std::uint64_t serial_ = 0;
};

net::Frame network_hello(std::uint32_t version = wire::kNetworkProtocolVersion, bool torn = true);
net::Frame network_list();
net::Frame subscribe_from_oldest();

// A program of dssmd's own PC that writes a stream, by the descriptors that dssmd handed out.
class LocalWriter {
 public:
  LocalWriter(RawClient& client, const std::string& name, std::uint64_t payload_bytes,
              std::uint64_t depth);
  // Sample `tid` has the time 1,000,000 + 1000 * tid ns and payload_of(tid).
  Tid write();
  void write(int count) {
    for (int i = 0; i < count; ++i) write();
  }
  std::size_t payload_bytes() const { return payload_.size(); }
  Tid newest() const { return ring::RingReader(*mapping_).newest(); }
  // Gives the stream back to a dssmd that was restarted. It is this program's while `client` is
  // connected.
  void offer(RawClient& client) const;

 private:
  std::string name_;
  std::vector<UniqueFd> descriptors_;
  std::shared_ptr<const ring::RingMapping> mapping_;
  std::shared_ptr<ring::Bell> bell_;
  std::vector<std::byte> payload_;
};

// Different for each tid, in each place.
void fill_payload(Tid tid, std::span<std::byte> payload);
bool is_payload_of(Tid tid, std::span<const std::byte> payload);

// Physical memory of process `pid` that is not a file's or shared, in bytes.
std::uint64_t private_memory(pid_t pid);

}  // namespace dssm::test
