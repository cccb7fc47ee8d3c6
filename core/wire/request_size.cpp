// SPDX-License-Identifier: Apache-2.0
#include "core/wire/request_size.hpp"

#include <fmt/format.h>

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
static_assert(int{Frame::kSetPropertyFieldNumber} == int{Request::kSetPropertyFieldNumber});

// Calls visit(field number, content) for each field of a message, with an empty content unless it
// has a length. False when the bytes are no message.
template <class Visit>
bool for_each_field(Bytes message, Visit visit) noexcept {
  const std::byte* at = message.data();
  const std::byte* const end = at + message.size();
  while (at != end) {
    std::uint64_t tag = 0, value = 0, content = 0;
    if (read_varint(at, end, kMaxLengthBytes, tag) != VarintStatus::ok) return false;
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
        return false;  // groups: no message of ours has them
    }
    if (content > static_cast<std::uint64_t>(end - at)) return false;
    visit(tag >> 3, has_length ? Bytes(at, static_cast<std::size_t>(content)) : Bytes());
    at += content;
  }
  return true;
}

// The bytes of field `number`, all that there are together.
std::size_t field_bytes(Bytes message, std::uint64_t number) noexcept {
  std::size_t bytes = 0;
  const bool is_message = for_each_field(message, [&](std::uint64_t field, Bytes content) {
    if (field == number) bytes += content.size();
  });
  return is_message ? bytes : 0;
}

std::size_t count_type_fields(Bytes create) noexcept {
  std::size_t count = 0;
  for_each_field(create, [&](std::uint64_t field, Bytes type) {
    if (field != proto::Create::kTypeFieldNumber) return;
    for_each_field(type, [&](std::uint64_t inner, Bytes) {
      count += inner == proto::Type::kFieldsFieldNumber;
    });
  });
  return count;
}

}  // namespace

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
  });
  return is_message ? message.size() - bulk : message.size();
}

Result<void> check_request_size_untrusted(Bytes message) {
  if (message.size() <= kMaxRequestBytes) return {};
  const std::size_t plain = plain_bytes(message);
  if (plain <= kMaxRequestBytes) return {};
  std::size_t creates = 0, fields = 0;
  for_each_field(message, [&](std::uint64_t field, Bytes content) {
    if (field != Frame::kCreateFieldNumber) return;
    ++creates;
    fields += count_type_fields(content);
  });
  const std::size_t most = creates > 0 ? kMaxCreateBytes : kMaxRequestBytes;
  if (plain > most) {
    return Error{Errc::protocol, fmt::format("a request of {} bytes has more than {} that are "
                                             "neither payload nor property",
                                             message.size(), most)};
  }
  if (fields > kMaxParsedFields) {
    return Error{Errc::protocol,
                 fmt::format("a request describes a type of {} fields; at most {} are read", fields,
                             kMaxParsedFields)};
  }
  return {};
}

}  // namespace dssm::wire
