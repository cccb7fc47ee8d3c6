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

std::string refusal_of(const std::string& bytes) {
  const Result<void> checked = check_request_size_untrusted(std::as_bytes(std::span(bytes)));
  return checked ? "" : checked.error().message;
}
template <class Message>
std::string refusal_of(const Message& message) {
  return refusal_of(message.SerializeAsString());
}

// A field that contains a message of these bytes.
std::string message(std::uint32_t field, const std::string& content) {
  std::array<std::byte, 2 * kMaxLengthBytes> head;
  const std::byte* const end =
      write_varint(write_varint(head.data(), field << 3 | 2), content.size());
  return std::string(reinterpret_cast<const char*>(head.data()),
                     static_cast<std::size_t>(end - head.data())) +
         content;
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
  EXPECT_NE(refusal_of(all), "");
}

TYPED_TEST(RequestSize, RefusesLongRequestsOfOtherKinds) {
  TypeParam long_name;
  long_name.mutable_open()->mutable_id()->set_name(std::string(kMaxRequestBytes, 'x'));
  EXPECT_NE(refusal_of(long_name).find("at most 16384 are taken"), std::string::npos);
  // Beside the property, in the same message.
  EXPECT_NE(refusal_of(message(22, empty_messages('\x0a', 2 * kMaxRequestBytes))), "");
}

// Ways to have bytes counted as those of something else than what protobuf makes of them.
TYPED_TEST(RequestSize, IsNotDeceived) {
  const std::string no_create("\x3a\x00", 2), group("\x9b\x06\x9c\x06");
  const std::string fields = empty_messages('\x22', 100'000);
  const std::string create = message(7, message(2, fields));
  EXPECT_NE(refusal_of(create), "");
  EXPECT_NE(refusal_of(no_create + message(3, empty_messages('\x3a', 100'000))), "")
      << "another body beside a Create";
  EXPECT_NE(refusal_of(no_create + group + create), "") << "a group ends the count";
  EXPECT_NE(refusal_of(message(7, group + message(2, fields))), "");
  EXPECT_NE(refusal_of(message(7, message(2, group + fields))), "");
  std::string long_tags;  // 2^32 more than that of `fields`
  for (int i = 0; i < 20'000; ++i) long_tags += std::string("\xa2\x80\x80\x80\x10\x00", 6);
  EXPECT_NE(refusal_of(message(7, message(2, long_tags))), "");
}

TYPED_TEST(RequestSize, FindsTheSerialOfWhatIsNotParsed) {
  TypeParam request;
  request.mutable_open();
  request.set_serial(300);
  const auto serial_of = [](std::string bytes) {
    return serial_untrusted(std::as_bytes(std::span(bytes)));
  };
  EXPECT_EQ(serial_of(request.SerializeAsString()), 300u);
  request.set_serial(0);
  EXPECT_EQ(serial_of(request.SerializeAsString()), 0u);
  EXPECT_EQ(serial_of(""), 0u);
  EXPECT_EQ(serial_of("\x08"), 0u);
}

TEST(RequestSizes, RefuseWhatIsNoMessage) {
  const std::string garbage(2 * kMaxRequestBytes, '\xff');
  EXPECT_NE(refusal_of(garbage), "");
}

}  // namespace
}  // namespace dssm::wire
