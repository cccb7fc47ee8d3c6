// SPDX-License-Identifier: Apache-2.0
//
// A stream's writer on dssmd's own PC, with payloads that readers can check.
#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"
#include "tests/process/daemon/raw_client.hpp"

namespace dssm::test {

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
