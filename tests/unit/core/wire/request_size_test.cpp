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
  const proto::Type type = request.create().type();
  *request.mutable_describe()->mutable_type() = type;
  EXPECT_EQ(refusal_of(request), "") << "described instead";
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

// --- elements

std::string elements_refusal_of(const std::string& bytes) {
  const Result<void> checked = check_elements_untrusted(std::as_bytes(std::span(bytes)));
  return checked ? "" : checked.error().message;
}

// A host that another one connects to could stop that one's loop, for it reads more than requests.
TEST(FrameElements, AreRefusedWhenTheyAreManyForTheirBytes) {
  const std::string streams = message(30, empty_messages('\x0a', 100'000));
  EXPECT_EQ(elements_refusal_of(streams),
            "a frame of 100005 bytes has more elements than messages of that length have");
  const std::string type = message(2, empty_messages('\x22', 100'000));
  EXPECT_NE(elements_refusal_of(message(7, type)), "") << "of a Create, which no client takes";
  EXPECT_NE(elements_refusal_of(message(12, message(1, type))), "");
  EXPECT_NE(elements_refusal_of(message(31, message(2, type))), "");
  EXPECT_NE(elements_refusal_of(message(30, message(1, type))), "");
  EXPECT_NE(elements_refusal_of(message(3, empty_messages('\x3a', 100'000))), "");
  EXPECT_NE(elements_refusal_of(message(35, empty_messages('\x0a', 100'000))), "");
  const std::string group("\x9b\x06\x9c\x06");
  EXPECT_NE(elements_refusal_of(group + streams), "") << "a group ends the count";
  EXPECT_NE(elements_refusal_of(message(12, message(1, group + type))), "");
  std::string apart;  // protobuf merges them
  for (int i = 0; i < 10'000; ++i) apart += message(30, empty_messages('\x0a', 2));
  EXPECT_NE(elements_refusal_of(apart), "");
}

TEST(FrameElements, AreTakenAsTheLongestAnswersHaveThem) {
  net::Frame list;
  for (int i = 0; i < 15'000; ++i) {
    proto::Stream& stream = *list.mutable_stream_list()->add_streams();
    stream.mutable_id()->set_name("a");
    stream.mutable_id()->set_id(i);
    stream.mutable_id()->set_host("pc2");
    stream.mutable_type()->set_payload_bytes(8);
    stream.set_depth(16);
    stream.set_cycle_ns(1'000'000);
    stream.set_incarnation(UINT64_MAX);
    stream.set_newest_time_ns(INT64_MAX);
  }
  EXPECT_EQ(elements_refusal_of(list.SerializeAsString()), "");
  net::Frame types;
  for (int i = 0; i < 1000; ++i) {
    proto::Stream& stream = *types.mutable_stream_list()->add_streams();
    stream.mutable_id()->set_name("a");
    for (int field = 0; field < 20; ++field) {
      proto::Field& one = *stream.mutable_type()->add_fields();
      one.set_name("x");
      one.set_scalar(1);
      one.set_offset_bytes(static_cast<std::uint64_t>(field) + 1);
    }
  }
  EXPECT_EQ(elements_refusal_of(types.SerializeAsString()), "") << "the shortest names";
  net::Frame opened;
  proto::Stream& stream = *opened.mutable_opened()->mutable_stream();
  for (std::size_t i = 0; i < kMaxFields; ++i) stream.mutable_type()->add_fields()->set_scalar(1);
  for (int i = 0; i < 3000; ++i) stream.add_users()->set_pid(1);
  EXPECT_EQ(elements_refusal_of(opened.SerializeAsString()), "");
  net::Frame property;
  property.mutable_property()->set_property(std::string(kMaxPropertyBytes, '\x9b'));
  EXPECT_EQ(elements_refusal_of(property.SerializeAsString()), "");
}

TEST(RequestSizes, RefuseWhatIsNoMessage) {
  const std::string garbage(2 * kMaxRequestBytes, '\xff');
  EXPECT_NE(refusal_of(garbage), "");
}

}  // namespace
}  // namespace dssm::wire
