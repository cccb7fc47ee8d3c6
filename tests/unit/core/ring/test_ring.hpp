// SPDX-License-Identifier: Apache-2.0
//
// A ring of the test's own, without any daemon: memory, mapping, bell, reader and writer. Reader
// and writer share one mapping, so that ThreadSanitizer sees them touch the same addresses.
#pragma once

#include <gtest/gtest.h>

#include <cstring>
#include <vector>

#include "core/ring/ring_reader.hpp"
#include "core/ring/ring_writer.hpp"

namespace dssm::ring {

struct TestRing {
  UniqueFd fd, bell_fd;
  std::shared_ptr<const RingMapping> mapping;
  std::shared_ptr<Bell> bell;

  TestRing(std::uint64_t payload_bytes, std::uint64_t depth) {
    const RingIdentity identity{{"test", 0, "pc1"}, 42, std::chrono::milliseconds(1), 8};
    fd = create_ring(identity, Geometry::of(payload_bytes, depth).value()).value();
    bell_fd = create_bell("test").value();
    mapping = RingMapping::open_untrusted(fd.get(), Access::read_write).value();
    bell = Bell::open_untrusted(bell_fd.get()).value();
  }

  RingReader reader() const { return RingReader(*mapping); }
  RingWriter writer(int doorbell = -1) const { return RingWriter(*mapping, *bell, doorbell); }
};

// Payloads that tell which sample they belong to: every byte depends on the tid and its place.
inline std::vector<std::byte> payload_for(Tid tid, std::size_t bytes) {
  std::vector<std::byte> payload(bytes);
  for (std::size_t i = 0; i < bytes; ++i) {
    payload[i] = static_cast<std::byte>(static_cast<std::uint64_t>(tid) * 31 + i * 7 + (i >> 8));
  }
  return payload;
}

}  // namespace dssm::ring
