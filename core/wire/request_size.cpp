// SPDX-License-Identifier: Apache-2.0
#include "core/wire/request_size.hpp"

#include <fmt/format.h>

#include <algorithm>
#include <cstdint>

#include "core/wire/varint.hpp"
#include "local.pb.h"
#include "network.pb.h"

namespace dssm::wire {
namespace {

using Bytes = std::span<const std::byte>;
using Frame = net::Frame;
using Request = local::Request;

// Both protocols number what they have in common alike.
static_assert(int{Frame::kCreateFieldNumber} == int{Request::kCreateFieldNumber});
static_assert(int{Frame::kDescribeFieldNumber} == int{Request::kDescribeFieldNumber});
static_assert(int{Frame::kSetPropertyFieldNumber} == int{Request::kSetPropertyFieldNumber});

// Calls visit(field number, content) for each field of a message, with an empty content unless it
// has a length; visit() returns false to stop. False then, and when the bytes are no message, or
// one with groups, which no message of ours has.
template <class Visit>
bool for_each_field(Bytes message, Visit visit) noexcept {
  const std::byte* at = message.data();
  const std::byte* const end = at + message.size();
  while (at != end) {
    std::uint64_t tag = 0, value = 0, content = 0;
    // protobuf takes the lower 32 bits of a longer tag.
    if (read_varint(at, end, kMaxLengthBytes, tag) != VarintStatus::ok || tag > UINT32_MAX) {
      return false;
    }
    const bool has_length = (tag & 7) == 2;
    switch (tag & 7) {
      case 0:
        if (read_varint(at, end, kMaxVarintBytes, value) != VarintStatus::ok) return false;
        break;
      case 1:
        content = 8;
        break;
      case 2:
        if (read_varint(at, end, kMaxLengthBytes, content) != VarintStatus::ok) return false;
        break;
      case 5:
        content = 4;
        break;
      default:
        return false;
    }
    if (content > static_cast<std::uint64_t>(end - at)) return false;
    if (!visit(tag >> 3, has_length ? Bytes(at, static_cast<std::size_t>(content)) : Bytes())) {
      return false;
    }
    at += content;
  }
  return true;
}

// The bytes of field `number`, all that there are together; 0 when the bytes are no message.
std::size_t field_bytes(Bytes message, std::uint64_t number) noexcept {
  std::size_t bytes = 0;
  const bool is_message = for_each_field(message, [&](std::uint64_t field, Bytes content) {
    if (field == number) bytes += content.size();
    return true;
  });
  return is_message ? bytes : 0;
}

// What a request has of Creates and Describes, which have a type alike.
static_assert(int{proto::Create::kTypeFieldNumber} == int{proto::Describe::kTypeFieldNumber});
struct Types {
  std::size_t bytes = 0;
  std::size_t type_fields = 0;
};

// False when the bytes are no message.
bool measure_types(Bytes request, Types& found) noexcept {
  return for_each_field(request, [&](std::uint64_t field, Bytes about) {
    if (field != Frame::kCreateFieldNumber && field != Frame::kDescribeFieldNumber) return true;
    found.bytes += about.size();
    return for_each_field(about, [&](std::uint64_t number, Bytes type) {
      if (number != proto::Create::kTypeFieldNumber) return true;
      return for_each_field(type, [&](std::uint64_t of_type, Bytes) {
        found.type_fields += of_type == proto::Type::kFieldsFieldNumber;
        return true;
      });
    });
  });
}

// Where a frame has what is repeated: numbers of fields, from the outside.
using Path = std::span<const int>;
using proto::ClockReport;
using proto::Hello;
using proto::Stream;
using proto::Type;
constexpr int kFeatures[] = {Frame::kHelloFieldNumber, Hello::kFeaturesFieldNumber};
constexpr int kHelloChain[] = {Frame::kHelloFieldNumber, Hello::kClockFieldNumber,
                               ClockReport::kChainFieldNumber};
constexpr int kHelloAddresses[] = {Frame::kHelloFieldNumber, Hello::kClockFieldNumber,
                                   ClockReport::kAddressesFieldNumber};
constexpr int kPingChain[] = {Frame::kPingFieldNumber, net::Ping::kClockFieldNumber,
                              ClockReport::kChainFieldNumber};
constexpr int kPingAddresses[] = {Frame::kPingFieldNumber, net::Ping::kClockFieldNumber,
                                  ClockReport::kAddressesFieldNumber};
constexpr int kPongChain[] = {Frame::kPongFieldNumber, net::Pong::kClockFieldNumber,
                              ClockReport::kChainFieldNumber};
constexpr int kPongAddresses[] = {Frame::kPongFieldNumber, net::Pong::kClockFieldNumber,
                                  ClockReport::kAddressesFieldNumber};
constexpr int kCreateFields[] = {Frame::kCreateFieldNumber, proto::Create::kTypeFieldNumber,
                                 Type::kFieldsFieldNumber};
constexpr int kDescribeFields[] = {Frame::kDescribeFieldNumber, proto::Describe::kTypeFieldNumber,
                                   Type::kFieldsFieldNumber};
constexpr int kOpenedFields[] = {Frame::kOpenedFieldNumber, proto::Opened::kStreamFieldNumber,
                                 Stream::kTypeFieldNumber, Type::kFieldsFieldNumber};
constexpr int kOpenedUsers[] = {Frame::kOpenedFieldNumber, proto::Opened::kStreamFieldNumber,
                                Stream::kUsersFieldNumber};
constexpr int kEventFields[] = {Frame::kStreamEventFieldNumber,
                                proto::StreamEvent::kStreamFieldNumber, Stream::kTypeFieldNumber,
                                Type::kFieldsFieldNumber};
constexpr int kEventUsers[] = {Frame::kStreamEventFieldNumber,
                               proto::StreamEvent::kStreamFieldNumber, Stream::kUsersFieldNumber};
constexpr int kStreams[] = {Frame::kStreamListFieldNumber, proto::StreamList::kStreamsFieldNumber};
constexpr int kListFields[] = {Frame::kStreamListFieldNumber,
                               proto::StreamList::kStreamsFieldNumber, Stream::kTypeFieldNumber,
                               Type::kFieldsFieldNumber};
constexpr int kListUsers[] = {Frame::kStreamListFieldNumber, proto::StreamList::kStreamsFieldNumber,
                              Stream::kUsersFieldNumber};
constexpr int kPairs[] = {Frame::kClockPairListFieldNumber,
                          proto::ClockPairList::kPairsFieldNumber};
constexpr int kChannelUsers[] = {Frame::kSetUsersFieldNumber, net::SetUsers::kUsersFieldNumber};
constexpr int kNodes[] = {Frame::kNodeListFieldNumber, proto::NodeList::kNodesFieldNumber};
constexpr int kNodeStreams[] = {Frame::kNodeListFieldNumber, proto::NodeList::kNodesFieldNumber,
                                proto::Node::kStreamsFieldNumber};
struct Repeated {
  Path path;
  std::size_t min_bytes = kMinElementBytes;  // of an element, on average
};
constexpr Repeated kRepeated[] = {
    {kFeatures},
    {kHelloChain},
    {kHelloAddresses},
    {kPingChain},
    {kPingAddresses},
    {kPongChain},
    {kPongAddresses},
    {kOpenedUsers},
    {kEventUsers},
    {kStreams},
    {kListUsers},
    {kPairs},
    {kChannelUsers},
    {kNodes, kMinNodeBytes},
    {kNodeStreams, kMinFieldBytes},
    {kCreateFields, kMinFieldBytes},
    {kDescribeFields, kMinFieldBytes},
    {kOpenedFields, kMinFieldBytes},
    {kEventFields, kMinFieldBytes},
    {kListFields, kMinFieldBytes},
};

// Adds what the elements of `message` at `path` have at least. False when that is more than
// `allowed`, or when the bytes are no message.
bool add_elements(Bytes message, Path path, std::size_t each, std::size_t allowed,
                  std::size_t& sum) noexcept {
  return for_each_field(message, [&](std::uint64_t field, Bytes content) {
    if (field != static_cast<std::uint64_t>(path.front())) return true;
    if (path.size() > 1) return add_elements(content, path.subspan(1), each, allowed, sum);
    sum += each;
    return sum <= allowed;
  });
}

// How much of a message of either protocol is not the inside of a payload or a property. The whole,
// when it is no message.
std::size_t plain_bytes(Bytes message) noexcept {
  std::size_t bulk = 0;
  const bool is_message = for_each_field(message, [&](std::uint64_t field, Bytes content) {
    if (field == Frame::kPayloadFieldNumber) bulk += content.size();
    if (field == Frame::kSetPropertyFieldNumber) {
      bulk += field_bytes(content, proto::SetProperty::kPropertyFieldNumber);
    }
    if (field == Frame::kPropertyFieldNumber) {
      bulk += field_bytes(content, proto::Property::kPropertyFieldNumber);
    }
    return true;
  });
  return is_message ? message.size() - bulk : message.size();
}

}  // namespace

Result<void> check_request_size_untrusted(Bytes message) {
  const std::size_t plain = message.size() <= kMaxRequestBytes ? 0 : plain_bytes(message);
  if (plain <= kMaxRequestBytes) return {};
  Types types;
  if (!measure_types(message, types)) {
    return Error{
        Errc::protocol,
        fmt::format("a request of {} bytes is not a message of this protocol", message.size())};
  }
  const std::size_t others = plain - std::min(plain, types.bytes);
  if (others > kMaxRequestBytes || types.bytes > kMaxCreateBytes) {
    return Error{Errc::limit_exceeded,
                 fmt::format("a request of {} bytes has {} that are neither payload nor property; "
                             "at most {} are taken, and {} to create or describe a stream",
                             message.size(), plain, kMaxRequestBytes, kMaxCreateBytes)};
  }
  if (types.type_fields > kMaxParsedFields) {
    return Error{Errc::limit_exceeded,
                 fmt::format("a request describes a type of {} fields; at most {} are read",
                             types.type_fields, kMaxParsedFields)};
  }
  return {};
}

Result<void> check_elements_untrusted(Bytes frame) {
  const std::size_t allowed = kFreeElementBytes + frame.size();
  // An element has two bytes at least.
  if (frame.size() / 2 * kMinElementBytes <= allowed) return {};
  std::size_t sum = 0;
  const bool may_be_parsed = for_each_field(frame, [&](std::uint64_t field, Bytes content) {
    return std::all_of(std::begin(kRepeated), std::end(kRepeated), [&](const Repeated& one) {
      return field != static_cast<std::uint64_t>(one.path.front()) ||
             add_elements(content, one.path.subspan(1), one.min_bytes, allowed, sum);
    });
  });
  if (may_be_parsed) return {};
  return Error{
      Errc::protocol,
      sum > allowed
          ? fmt::format("a frame of {} bytes has more elements than messages of that "
                        "length have",
                        frame.size())
          : fmt::format("a frame of {} bytes is not a message of this protocol", frame.size())};
}

std::uint64_t serial_untrusted(Bytes message) noexcept {
  const std::byte* at = message.data();
  std::uint64_t tag = 0, serial = 0;
  const bool is_first =
      read_varint(at, at + message.size(), 1, tag) == VarintStatus::ok &&
      tag == Request::kSerialFieldNumber << 3 &&
      read_varint(at, message.data() + message.size(), kMaxVarintBytes, serial) == VarintStatus::ok;
  return is_first ? serial : 0;
}

}  // namespace dssm::wire
