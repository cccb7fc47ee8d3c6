// SPDX-License-Identifier: Apache-2.0
//
// Messages that would cost far more than they are long are refused before they are parsed.
#include "core/wire/request_size.hpp"

#include <gtest/gtest.h>

#include <array>
#include <dssm/stream.hpp>

#include "core/wire/messages.hpp"
#include "core/wire/varint.hpp"
#include "local.pb.h"
#include "network.pb.h"

namespace dssm::wire {
namespace {

template <class Message>
std::string refusal_of(const Message& message) {
  const std::string bytes = message.SerializeAsString();
  const Result<void> checked = check_request_size_untrusted(std::as_bytes(std::span(bytes)));
  return checked ? "" : checked.error().message;
}

std::string empty_messages(char tag, std::size_t bytes) {
  std::string text;
  while (text.size() < bytes) text += std::string({tag, '\0'});
  return text;
}

template <class Message>
class RequestSize : public testing::Test {};
using Protocols = testing::Types<net::Frame, local::Request>;
TYPED_TEST_SUITE(RequestSize, Protocols);

TYPED_TEST(RequestSize, TakesTheLargestProperty) {
  TypeParam request;
  request.mutable_set_property()->set_property(std::string(kMaxPropertyBytes, 'x'));
  EXPECT_EQ(refusal_of(request), "");
}

TYPED_TEST(RequestSize, TakesTheLargestType) {
  TypeParam request;
  for (std::size_t i = 0; i < kMaxFields; ++i) {
    request.mutable_create()->mutable_type()->add_fields()->set_name(std::string(40, 'x'));
  }
  EXPECT_EQ(refusal_of(request), "");
}

TYPED_TEST(RequestSize, RefusesManyFields) {
  TypeParam request;
  for (std::size_t i = 0; i <= kMaxParsedFields; ++i) {
    request.mutable_create()->mutable_type()->add_fields()->set_name("abcd");
  }
  EXPECT_NE(refusal_of(request).find("a type of 4097 fields"), std::string::npos);
}

// One way round the limit would be a field that comes many times: protobuf merges them.
TYPED_TEST(RequestSize, CountsAllThatAreMerged) {
  TypeParam request;
  request.mutable_create()->mutable_type()->add_fields()->set_name("abcd");
  std::string bytes = request.SerializeAsString(), all;
  for (std::size_t i = 0; i <= kMaxParsedFields; ++i) all += bytes;
  const Result<void> checked = check_request_size_untrusted(std::as_bytes(std::span(all)));
  ASSERT_FALSE(checked);
}

TYPED_TEST(RequestSize, RefusesLongRequestsOfOtherKinds) {
  TypeParam long_name;
  long_name.mutable_open()->mutable_id()->set_name(std::string(kMaxRequestBytes, 'x'));
  EXPECT_NE(refusal_of(long_name).find("more than 16384"), std::string::npos);
  // Beside the property, in the same message.
  const std::string ids = empty_messages('\x0a', 2 * kMaxRequestBytes);
  std::array<std::byte, kMaxLengthBytes> length;
  const std::byte* const end = write_varint(length.data(), ids.size());
  std::string message("\xb2\x01", 2);  // set_property
  message.append(reinterpret_cast<const char*>(length.data()), end - length.data());
  message += ids;
  EXPECT_FALSE(check_request_size_untrusted(std::as_bytes(std::span(message))));
}

TEST(RequestSizes, RefuseWhatIsNoMessage) {
  const std::string garbage(2 * kMaxRequestBytes, '\xff');
  EXPECT_FALSE(check_request_size_untrusted(std::as_bytes(std::span(garbage))));
}

}  // namespace
}  // namespace dssm::wire
