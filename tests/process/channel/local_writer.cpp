// SPDX-License-Identifier: Apache-2.0
#include "tests/process/channel/local_writer.hpp"

#include <gtest/gtest.h>

#include <cstring>
#include <fstream>

namespace dssm::test {

LocalWriter::LocalWriter(RawClient& client, const std::string& name, std::uint64_t payload_bytes,
                         std::uint64_t depth)
    : name_(name), payload_(payload_bytes) {
  local::Request request = create_request(name, depth);
  request.mutable_create()->mutable_type()->clear_name();
  request.mutable_create()->mutable_type()->set_payload_bytes(payload_bytes);
  Answer answer = client.ask(request);
  EXPECT_TRUE(answer.response.has_opened()) << answer.response.failure().message();
  descriptors_ = std::move(answer.descriptors);
  mapping_ =
      ring::RingMapping::open_untrusted(descriptors_.at(0).get(), ring::Access::read_write).value();
  bell_ = ring::Bell::open_untrusted(descriptors_.at(1).get()).value();
}

void LocalWriter::offer(RawClient& client) const {
  const Answer answer = client.ask(offer_request(name_, true), numbers(descriptors_));
  EXPECT_TRUE(answer.response.has_opened()) << answer.response.failure().message();
}

Tid LocalWriter::write() {
  ring::RingWriter writer(*mapping_, *bell_, descriptors_.at(3).get());
  const Tid tid = writer.newest() + 1;
  fill_payload(tid, payload_);
  return writer.write(payload_, time_from_ns(1'000'000 + tid * 1000), Duration(5));
}

// Words, so that a test of 64 MiB samples takes no minutes.
void fill_payload(Tid tid, std::span<std::byte> payload) {
  for (std::size_t at = 0; at < payload.size(); at += 8) {
    const std::uint64_t word = (static_cast<std::uint64_t>(tid) << 32) + at;
    std::memcpy(payload.data() + at, &word, std::min<std::size_t>(8, payload.size() - at));
  }
}

bool is_payload_of(Tid tid, std::span<const std::byte> payload) {
  for (std::size_t at = 0; at < payload.size(); at += 8) {
    const std::uint64_t word = (static_cast<std::uint64_t>(tid) << 32) + at;
    if (std::memcmp(payload.data() + at, &word, std::min<std::size_t>(8, payload.size() - at))) {
      return false;
    }
  }
  return true;
}

std::uint64_t private_memory(pid_t pid) {
  std::ifstream file("/proc/" + std::to_string(pid) + "/status");
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with("RssAnon:")) return std::stoull(line.substr(8)) << 10;
  }
  ADD_FAILURE() << "no RssAnon in /proc/PID/status";
  return 0;
}

}  // namespace dssm::test
