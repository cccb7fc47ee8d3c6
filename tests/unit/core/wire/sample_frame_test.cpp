// SPDX-License-Identifier: Apache-2.0
//
// What is written by hand against what protobuf writes and reads.
#include "core/wire/sample_frame.hpp"

#include <gtest/gtest.h>

#include <string>

#include "core/wire/frame.hpp"
#include "core/wire/varint.hpp"
#include "network.pb.h"

namespace dssm::wire {
namespace {

const std::int64_t kTids[] = {0, 1, INT64_MAX};
const std::int64_t kTimes[] = {INT64_MIN, -1, 0, 1'700'000'000'000'000'000, INT64_MAX};
const std::uint64_t kSerials[] = {0, 1, 127, 128, 1'000'000, UINT64_MAX};
const std::size_t kSizes[] = {0, 1, 50, 127, 128, 20'000, 3 << 20};

std::span<const std::byte> bytes_of(const std::string& text) {
  return std::as_bytes(std::span(text));
}

std::string written(std::uint64_t serial, SampleInfo info, const std::string& payload,
                    Trailer trailer, bool torn) {
  std::array<std::byte, kMaxSampleHeaderBytes> header;
  info.payload_bytes = payload.size();
  const std::size_t bytes = encode_sample_header(header, serial, info, trailer);
  std::string frame(reinterpret_cast<const char*>(header.data()), bytes);
  frame += payload;
  if (trailer == Trailer::torn) {
    const auto field = torn_trailer(torn);
    frame.append(reinterpret_cast<const char*>(field.data()), field.size());
  }
  return frame;
}

// Cuts the length off, checks it, and parses the rest.
net::Frame parsed(const std::string& frame) {
  const auto bytes = bytes_of(frame);
  const std::byte* at = bytes.data();
  const std::byte* end = at + bytes.size();
  std::uint64_t length = 0;
  net::Frame message;
  EXPECT_EQ(read_varint(at, end, kMaxLengthBytes, length), VarintStatus::ok);
  EXPECT_EQ(length, static_cast<std::uint64_t>(end - at));
  EXPECT_TRUE(message.ParseFromArray(at, static_cast<int>(end - at)));
  return message;
}

template <class Check>
void for_many_samples(Check check) {
  for (const std::size_t size : kSizes) {
    for (const std::uint64_t serial : kSerials) {
      const std::int64_t tid = kTids[serial % std::size(kTids)];
      const std::int64_t time = kTimes[(serial + size) % std::size(kTimes)];
      const SampleInfo info{tid, time_from_ns(time), Duration(time < 0 ? INT64_MAX : 4000)};
      check(serial, info, std::string(size, 'x'));
    }
  }
}

TEST(SampleFrame, IsWhatProtobufReads) {
  for_many_samples([](std::uint64_t serial, const SampleInfo& info, const std::string& payload) {
    for (const bool torn : {false, true}) {
      for (const Trailer trailer : {Trailer::none, Trailer::torn}) {
        const net::Frame frame = parsed(written(serial, info, payload, trailer, torn));
        EXPECT_EQ(frame.serial(), serial);
        EXPECT_TRUE(frame.has_sample());
        EXPECT_EQ(frame.sample().tid(), info.tid);
        EXPECT_EQ(frame.sample().time_ns(), to_ns(info.time));
        EXPECT_EQ(frame.sample().clock_error_ns(),
                  static_cast<std::uint64_t>(to_ns(info.clock_error)));
        EXPECT_EQ(frame.payload(), payload);
        EXPECT_EQ(frame.torn(), trailer == Trailer::torn && torn);
        EXPECT_EQ(frame.body_case(), net::Frame::BODY_NOT_SET);
      }
    }
  });
}

// Stock protobuf leaves zeros out; without zeros both write the same bytes.
TEST(SampleFrame, IsWhatProtobufWrites) {
  const SampleInfo info{7, time_from_ns(1), Duration(2)};
  net::Frame frame;
  frame.set_serial(300);
  frame.mutable_sample()->set_tid(7);
  frame.mutable_sample()->set_time_ns(1);
  frame.mutable_sample()->set_clock_error_ns(2);
  frame.set_payload("abc");
  frame.set_torn(true);
  const std::string message = frame.SerializeAsString();
  EXPECT_EQ(written(300, info, "abc", Trailer::torn, true),
            std::string(1, static_cast<char>(message.size())) + message);
}

TEST(SampleHead, IsReadBackFromWhatWasWritten) {
  for_many_samples([](std::uint64_t serial, const SampleInfo& info, const std::string& payload) {
    for (const Trailer trailer : {Trailer::none, Trailer::torn}) {
      const std::string frame = written(serial, info, payload, trailer, false);
      SampleHead head;
      ASSERT_EQ(read_sample_head_untrusted(bytes_of(frame), head), HeadStatus::sample);
      EXPECT_EQ(head.serial, serial);
      EXPECT_EQ(head.tid, info.tid);
      EXPECT_EQ(head.time_ns, to_ns(info.time));
      EXPECT_EQ(head.clock_error_ns, static_cast<std::uint64_t>(to_ns(info.clock_error)));
      EXPECT_EQ(head.payload_bytes, payload.size());
      EXPECT_EQ(head.trailer_bytes, trailer == Trailer::torn ? kTornTrailerBytes : 0);
      EXPECT_EQ(head.frame_bytes + head.length_bytes, frame.size());
      EXPECT_EQ(frame.substr(head.bytes, payload.size()), payload);
      // All of the head, and nothing else, is needed to tell.
      for (std::size_t cut = 0; cut < head.bytes; ++cut) {
        SampleHead part;
        EXPECT_EQ(read_sample_head_untrusted(bytes_of(frame.substr(0, cut)), part),
                  HeadStatus::incomplete);
      }
      EXPECT_EQ(read_sample_head_untrusted(bytes_of(frame.substr(0, head.bytes)), head),
                HeadStatus::sample);
    }
  });
}

TEST(Varint, IsReadBackFromWhatWasWritten) {
  for (unsigned shift = 0; shift < 64; ++shift) {
    for (const std::uint64_t value : {(1ULL << shift) - 1, 1ULL << shift, (1ULL << shift) + 1}) {
      std::array<std::byte, kMaxVarintBytes> bytes;
      const std::byte* end = write_varint(bytes.data(), value);
      EXPECT_EQ(static_cast<std::size_t>(end - bytes.data()), varint_bytes(value));
      const std::byte* at = bytes.data();
      std::uint64_t back = 0;
      EXPECT_EQ(read_varint(at, end - 1, kMaxVarintBytes, back), VarintStatus::cut);
      EXPECT_EQ(at, bytes.data());
      ASSERT_EQ(read_varint(at, end, kMaxVarintBytes, back), VarintStatus::ok);
      EXPECT_EQ(back, value);
      EXPECT_EQ(at, end);
    }
  }
}

TEST(Varint, HasAnEnd) {
  const std::string endless(20, '\xff');
  const auto bytes = bytes_of(endless);
  const std::byte* at = bytes.data();
  std::uint64_t value = 0;
  EXPECT_EQ(read_varint(at, at + 20, kMaxVarintBytes, value), VarintStatus::too_long);
}

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
}  // namespace dssm::wire
