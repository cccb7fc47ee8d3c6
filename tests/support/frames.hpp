// SPDX-License-Identifier: Apache-2.0
//
// Frames of the network protocol as tests make and read them. Received ones are decoded by stock
// protobuf, not by the decoder of the product.
#pragma once

#include <google/protobuf/io/coded_stream.h>
#include <gtest/gtest.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <optional>
#include <span>
#include <sstream>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

#include "core/wire/frame.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/sample_frame.hpp"

namespace dssm::test {

using Bytes = std::vector<std::byte>;

inline Bytes to_bytes(std::string_view text) {
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}
inline Bytes to_bytes(const net::Frame& frame) { return to_bytes(wire::encode_frame(frame)); }
inline Bytes payload_of(const net::Frame& frame) { return to_bytes(frame.payload()); }

// The bytes of a file of tests/golden: hexadecimal, with comments behind '#'.
inline std::string golden_bytes(const std::filesystem::path& file) {
  std::ifstream in(file);
  EXPECT_TRUE(in) << file;
  std::string bytes, word;
  for (std::string line; std::getline(in, line);) {
    std::istringstream words(line.substr(0, line.find('#')));
    while (words >> word) bytes += static_cast<char>(std::stoi(word, nullptr, 16));
  }
  return bytes;
}

// What a dssmd or program of host `host` says of itself.
inline wire::Greeting greeting_of(const std::string& host, const std::string& program = "dssmd") {
  wire::Greeting greeting;
  greeting.host = host;
  greeting.host_id = wire::host_id_for(host);
  greeting.instance_id = wire::random_number();
  greeting.program = program;
  greeting.version = "0.1.0";
  greeting.features = {std::string(wire::kFeatureTorn)};
  return greeting;
}

inline wire::Greeting without_features(wire::Greeting greeting) {
  greeting.features.clear();
  return greeting;
}

inline net::Frame hello_frame(const wire::Greeting& greeting,
                              std::uint32_t protocol_version = wire::kNetworkProtocolVersion) {
  net::Frame frame;
  wire::to_message(greeting, *frame.mutable_hello());
  frame.mutable_hello()->set_protocol_version(protocol_version);
  return frame;
}

// --- requests

inline net::Frame with_serial(std::uint64_t serial, net::Frame frame = {}) {
  frame.set_serial(serial);
  return frame;
}

inline net::Frame open_frame(const std::string& name) {
  net::Frame frame;
  frame.mutable_open()->mutable_id()->set_name(name);
  return frame;
}

inline net::Frame create_frame(const std::string& name, std::uint64_t payload_bytes,
                               std::uint64_t depth) {
  net::Frame frame;
  proto::Create& create = *frame.mutable_create();
  create.mutable_id()->set_name(name);
  create.mutable_type()->set_payload_bytes(payload_bytes);
  create.mutable_type()->set_alignment_bytes(1);
  create.set_depth(depth);
  create.set_cycle_ns(1'000'000);
  return frame;
}

inline net::Frame subscribe_from_oldest_frame() {
  net::Frame frame;
  frame.mutable_subscribe()->set_from_oldest(true);
  return frame;
}

inline net::Frame read_frame(std::int64_t tid) {
  net::Frame frame;
  frame.mutable_read()->set_tid(tid);
  return frame;
}

inline net::Frame read_newest_frame() {
  net::Frame frame;
  frame.mutable_read()->set_newest(true);
  return frame;
}

inline net::Frame start_publishing_frame(std::uint64_t publisher) {
  net::Frame frame;
  frame.mutable_start_publishing()->set_publisher(publisher);
  return frame;
}

inline net::Frame list_frame() {
  net::Frame frame;
  frame.mutable_list();
  return frame;
}

inline net::Frame watch_frame() {
  net::Frame frame;
  frame.mutable_watch();
  return frame;
}

inline net::Frame ping_frame() {
  net::Frame frame;
  frame.mutable_ping();
  return frame;
}

inline net::Frame remove_frame(const std::string& name) {
  net::Frame frame;
  frame.mutable_remove()->mutable_id()->set_name(name);
  return frame;
}

// --- answers and events

inline net::Frame answer_to(const net::Frame& request) { return with_serial(request.serial()); }

// Without a request: a final failure.
inline net::Frame failure_frame(Errc code, const std::string& text,
                                const net::Frame& request = {}) {
  net::Frame frame = answer_to(request);
  wire::to_message(Error{code, text}, *frame.mutable_failure());
  return frame;
}

inline net::Frame opened_frame(const net::Frame& request, const StreamInfo& stream) {
  net::Frame frame = answer_to(request);
  wire::to_message(stream, *frame.mutable_opened()->mutable_stream());
  return frame;
}

inline net::Frame subscribed_frame(const net::Frame& request, std::uint64_t incarnation,
                                   std::int64_t first) {
  net::Frame frame = answer_to(request);
  frame.mutable_subscribed()->set_incarnation(incarnation);
  frame.mutable_subscribed()->set_first_tid(first);
  frame.mutable_subscribed()->set_newest(first - 1);
  return frame;
}

inline net::Frame gap_frame(std::int64_t first, std::uint64_t count) {
  net::Frame frame;
  frame.mutable_gap()->set_first_tid(first);
  frame.mutable_gap()->set_count(count);
  return frame;
}

inline net::Frame removed_frame() {
  net::Frame frame;
  frame.mutable_ended()->set_removed(true);
  return frame;
}

// The bytes of a frame with a sample.
//   torn  nullopt: without that field
inline Bytes sample_bytes(SampleInfo info, std::span<const std::byte> payload,
                          std::uint64_t serial = 0, std::optional<bool> torn = {}) {
  std::array<std::byte, wire::kMaxSampleHeaderBytes> header;
  info.payload_bytes = payload.size();
  const std::size_t bytes = wire::encode_sample_header(
      header, serial, info, torn ? wire::Trailer::torn : wire::Trailer::none);
  Bytes frame(header.begin(), header.begin() + static_cast<std::ptrdiff_t>(bytes));
  frame.insert(frame.end(), payload.begin(), payload.end());
  if (torn) {
    const auto trailer = wire::torn_trailer(*torn);
    frame.insert(frame.end(), trailer.begin(), trailer.end());
  }
  return frame;
}

// --- receiving

// Collects received bytes, and gives out frames. A value.
class FrameInput {
 public:
  std::span<std::byte> space() { return buffer_.space(); }
  void commit(std::size_t bytes) {
    buffer_.commit(bytes);
    pending_bytes_ += bytes;
  }

  // The next complete frame, a sample with its payload. Bytes that are not a frame fail the test.
  std::optional<net::Frame> next() {
    const auto message = buffer_.next();
    EXPECT_TRUE(message) << message.error().message;
    if (!message || !*message) return {};
    const auto bytes = static_cast<std::uint32_t>((*message)->size());
    pending_bytes_ -= bytes + google::protobuf::io::CodedOutputStream::VarintSize32(bytes);
    std::optional<net::Frame> frame(std::in_place);
    EXPECT_TRUE(frame->ParseFromArray((*message)->data(), static_cast<int>(bytes)));
    return frame;
  }

  // Received, and not given out yet.
  std::size_t pending_bytes() const { return pending_bytes_; }

 private:
  wire::FrameBuffer buffer_{65U << 20};  // the largest payload, and the frame around it
  std::size_t pending_bytes_ = 0;
};

// All frames of `bytes`. A rest that is not a complete frame fails the test.
inline std::vector<net::Frame> frames_of(std::span<const std::byte> bytes) {
  std::vector<net::Frame> frames;
  FrameInput input;
  while (!bytes.empty()) {
    const std::span<std::byte> space = input.space();
    const std::size_t part = std::min(space.size(), bytes.size());
    std::memcpy(space.data(), bytes.data(), part);
    input.commit(part);
    bytes = bytes.subspan(part);
    while (std::optional<net::Frame> frame = input.next()) frames.push_back(*std::move(frame));
  }
  EXPECT_EQ(input.pending_bytes(), 0u) << "a frame is cut off";
  return frames;
}

}  // namespace dssm::test
