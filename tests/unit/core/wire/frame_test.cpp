// SPDX-License-Identifier: Apache-2.0
#include "core/wire/frame.hpp"

#include <gtest/gtest.h>

#include <cstring>

#include "core/wire/local_protocol.hpp"
#include "network.pb.h"

namespace dssm::wire {
namespace {

void feed(FrameBuffer& buffer, std::string_view bytes) {
  while (!bytes.empty()) {
    const auto space = buffer.space();
    ASSERT_GE(space.size(), 4096u);
    const std::size_t n = std::min(space.size(), bytes.size());
    std::memcpy(space.data(), bytes.data(), n);
    buffer.commit(n);
    bytes.remove_prefix(n);
  }
}

std::string frame_of(std::size_t program_bytes, std::uint64_t serial) {
  local::Request request;
  request.set_serial(serial);
  request.mutable_hello()->set_program(std::string(program_bytes, 'x'));
  return encode_frame(request);
}

// By hand: length 2, field 1 (serial) varint 5. What stock protobuf's delimited readers expect.
TEST(Frame, IsAVarintLengthAndAMessage) {
  local::Request request;
  request.set_serial(5);
  EXPECT_EQ(encode_frame(request), std::string("\x02\x08\x05", 3));
}

TEST(FrameBuffer, GivesOutWholeFramesHoweverTheyArrive) {
  std::string stream;
  const std::size_t sizes[] = {0, 1, 100, 127, 128, 5000, 70'000, 3};
  std::uint64_t serial = 0;
  for (const std::size_t size : sizes) stream += frame_of(size, ++serial);
  for (const std::size_t chunk :
       {std::size_t{1}, std::size_t{7}, std::size_t{4096}, stream.size()}) {
    FrameBuffer buffer(1 << 20);
    std::uint64_t seen = 0;
    for (std::size_t at = 0; at < stream.size(); at += chunk) {
      feed(buffer, std::string_view(stream).substr(at, chunk));
      for (;;) {
        auto frame = buffer.next();
        ASSERT_TRUE(frame);
        if (!*frame) break;
        local::Request request;
        ASSERT_TRUE(request.ParseFromArray((*frame)->data(), static_cast<int>((*frame)->size())));
        EXPECT_EQ(request.serial(), ++seen);
        EXPECT_EQ(request.hello().program().size(), sizes[seen - 1]);
      }
    }
    EXPECT_EQ(seen, std::size(sizes));
  }
}

TEST(FrameBuffer, RefusesALengthBeyondItsLimitBeforeTheFrameIsThere) {
  FrameBuffer buffer(1000);
  feed(buffer, std::string("\xe9\x07", 2));  // 1001
  const auto frame = buffer.next();
  ASSERT_FALSE(frame);
  EXPECT_EQ(frame.error().code, Errc::protocol);
  EXPECT_NE(frame.error().message.find("1001"), std::string::npos);
}

TEST(FrameBuffer, RefusesALengthThatIsNoVarint) {
  FrameBuffer buffer(1000);
  feed(buffer, std::string(10, '\xff'));
  EXPECT_FALSE(buffer.next());
}

TEST(LocalProtocol, CarriesTypesThereAndBack) {
  const TypeInfo type{
      "Odometry", 40, 8, {{"x", Scalar::float64, 0, 1, 8}, {"v", Scalar::int32, 8, 8, 4}}};
  proto::Type message;
  to_message(type, message);
  EXPECT_EQ(type_untrusted(message).value(), type);
  const StreamId id{"lidar", 3, "pc2"};
  proto::StreamId id_message;
  to_message(id, id_message);
  EXPECT_EQ(stream_id_untrusted(id_message).value(), id);
}

TEST(LocalProtocol, CarriesEveryErrorCode) {
  for (int code = 0; code <= static_cast<int>(Errc::system); ++code) {
    proto::Failure message;
    to_message(Error{static_cast<Errc>(code), "why"}, message);
    EXPECT_EQ(failure(message).code, static_cast<Errc>(code));
    EXPECT_EQ(failure(message).message, "why");
  }
}

TEST(LocalProtocol, ChecksTypesThatCome) {
  proto::Type message;
  message.set_payload_bytes(8);
  message.set_alignment_bytes(8);
  EXPECT_TRUE(type_untrusted(message));
  message.add_fields()->set_scalar(300);
  EXPECT_FALSE(type_untrusted(message));
  message.clear_fields();
  for (std::size_t i = 0; i <= kMaxFields; ++i) {
    proto::Field& field = *message.add_fields();
    field.set_scalar(static_cast<std::uint32_t>(Scalar::uint8));
    field.set_count(1);
  }
  EXPECT_EQ(type_untrusted(message).error().code, Errc::limit_exceeded);
}

TEST(FinalFailure, HasTheSameBytesInBothProtocols) {
  const std::string frame = final_failure({Errc::limit_exceeded, "full"});
  FrameBuffer buffer(kMaxLocalFrameBytes);
  feed(buffer, frame);
  const auto message = buffer.next();
  ASSERT_TRUE(message && *message);
  local::Response response;
  net::Frame network;
  const int bytes = static_cast<int>((*message)->size());
  ASSERT_TRUE(response.ParseFromArray((*message)->data(), bytes));
  ASSERT_TRUE(network.ParseFromArray((*message)->data(), bytes));
  EXPECT_EQ(response.failure().code(), "limit_exceeded");
  EXPECT_EQ(network.failure().message(), "full");
  EXPECT_EQ(response.serial(), 0u);
}

}  // namespace
}  // namespace dssm::wire
