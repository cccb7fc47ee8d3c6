// SPDX-License-Identifier: Apache-2.0
#include "client/src/read_request.hpp"

#include <gtest/gtest.h>

#include "core/wire/frame.hpp"
#include "network.pb.h"

namespace dssm::detail {
namespace {

TEST(ReadRequest, HasTheBytesThatProtobufWrites) {
  using Which = ReadRequest::Which;
  for (const std::uint64_t serial : {std::uint64_t{1}, std::uint64_t{127}, std::uint64_t{128},
                                     std::uint64_t{1} << 40, UINT64_MAX}) {
    for (const std::int64_t value : {std::int64_t{0}, std::int64_t{1}, std::int64_t{-1},
                                     std::int64_t{1} << 33, INT64_MAX, INT64_MIN}) {
      for (const Which which : {Which::tid, Which::time, Which::newest, Which::newer_than}) {
        net::Frame frame;
        frame.set_serial(serial);
        net::Read& read = *frame.mutable_read();
        if (which == Which::tid) read.set_tid(value);
        if (which == Which::time) read.set_time_ns(value);
        if (which == Which::newest) read.set_newest(true);
        if (which == Which::newer_than) read.set_newer_than(value);
        std::array<std::byte, kMaxReadRequestBytes> bytes{};
        const std::size_t length = encode_read_request(bytes, serial, {which, value});
        ASSERT_LE(length, bytes.size());
        EXPECT_EQ(std::string(reinterpret_cast<const char*>(bytes.data()), length),
                  wire::encode_frame(frame));
      }
    }
  }
}

}  // namespace
}  // namespace dssm::detail
