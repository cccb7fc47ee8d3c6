// SPDX-License-Identifier: Apache-2.0
//
// The decoder against streams of frames that arrive in all kinds of pieces. What it hands out must
// not depend on the pieces, and must be what protobuf makes of the same bytes.
#include "core/wire/frame_decoder.hpp"

#include <gtest/gtest.h>

#include <random>
#include <thread>

#include "core/wire/frame.hpp"
#include "core/wire/network_protocol.hpp"
#include "core/wire/varint.hpp"
#include "tests/unit/core/wire/recorder.hpp"

namespace dssm::wire {
namespace {

constexpr std::size_t kMaxFrame = 100'000;

// A payload that tells where each of its bytes belongs.
std::string payload_of(std::size_t bytes, std::int64_t tid) {
  std::string payload(bytes, '\0');
  for (std::size_t i = 0; i < bytes; ++i) {
    payload[i] = static_cast<char>(i * 31 + i / 251 + static_cast<std::size_t>(tid));
  }
  return payload;
}

SampleInfo info_of(std::int64_t tid) {
  return {tid, time_from_ns(tid * 1'000'000'007 - 5), Duration(tid * 3)};
}

enum class Torn { left_out, no, yes };

std::string sample_frame(std::uint64_t serial, std::int64_t tid, std::size_t payload_bytes,
                         Torn torn = Torn::left_out) {
  const bool trailer = torn != Torn::left_out;
  std::array<std::byte, kMaxSampleHeaderBytes> header;
  SampleInfo info = info_of(tid);
  info.payload_bytes = payload_bytes;
  const std::size_t bytes =
      encode_sample_header(header, serial, info, trailer ? Trailer::torn : Trailer::none);
  std::string frame(reinterpret_cast<const char*>(header.data()), bytes);
  frame += payload_of(payload_bytes, tid);
  if (trailer) {
    const auto field = torn_trailer(torn == Torn::yes);
    frame.append(reinterpret_cast<const char*>(field.data()), field.size());
  }
  return frame;
}

// Puts the length in front.
std::string framed(const std::string& message) {
  std::array<std::byte, kMaxVarintBytes> length;
  const std::byte* end = write_varint(length.data(), message.size());
  return std::string(reinterpret_cast<const char*>(length.data()),
                     static_cast<std::size_t>(end - length.data())) +
         message;
}

std::string published(std::int64_t last) {
  net::Frame frame;
  frame.mutable_published()->set_last(last);
  return encode_frame(frame);
}

net::Frame sample_message(std::uint64_t serial, std::int64_t tid, std::size_t payload_bytes) {
  net::Frame frame;
  frame.set_serial(serial);
  const SampleInfo info = info_of(tid);
  frame.mutable_sample()->set_tid(info.tid);
  frame.mutable_sample()->set_time_ns(to_ns(info.time));
  frame.mutable_sample()->set_clock_error_ns(static_cast<std::uint64_t>(to_ns(info.clock_error)));
  frame.set_payload(payload_of(payload_bytes, tid));
  return frame;
}

// The fields of sample_message() in the order that `order` names: s(erial), S(ample), p(ayload),
// t(orn, as true).
std::string in_order(std::string_view order, const net::Frame& message) {
  std::string bytes;
  for (const char field : order) {
    net::Frame part;
    if (field == 's') part.set_serial(message.serial());
    if (field == 'S') *part.mutable_sample() = message.sample();
    if (field == 'p') part.set_payload(message.payload());
    if (field == 't') part.set_torn(true);
    bytes += part.SerializeAsString();
  }
  return framed(bytes);
}

struct Decoded {
  std::vector<std::string> log;
  std::string error;
  DecoderCounters counters;
  bool at_frame_end = false;
};

Decoded decode(std::string_view bytes, std::size_t payload_bytes, std::size_t at_most = SIZE_MAX) {
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  decoder.set_payload_bytes(payload_bytes);
  const Result<void> fed = feed(decoder, bytes, at_most);
  return {recorder.log, fed ? "" : fed.error().message, decoder.counters(), decoder.at_frame_end()};
}

// Checks that decoding fails with code `protocol` and a text that holds `why`.
void expect_refused(std::string_view bytes, std::size_t payload_bytes, std::string_view why) {
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  decoder.set_payload_bytes(payload_bytes);
  const Result<void> fed = feed(decoder, bytes);
  ASSERT_FALSE(fed) << "expected: " << why;
  EXPECT_EQ(fed.error().code, Errc::protocol);
  EXPECT_NE(fed.error().message.find(why), std::string::npos) << fed.error().message;
}

// Frames of all kinds with samples of at most 20 bytes: in our order with and without trailer, in
// other orders, with fields nobody knows, and others in between.
std::string mixed_stream() {
  const std::string unknown_2 = "\xa0\x06";  // field 100, a varint
  const std::string unknown_3 = std::string("\xa0\x06", 2) + '\x01';
  std::string stream = published(7) + sample_frame(0, 0, 20) + sample_frame(0, 1, 20, Torn::no) +
                       sample_frame(300, 2, 20, Torn::yes) + published(1'000'000) +
                       sample_frame(UINT64_MAX, INT64_MAX / 2'000'000'000, 20);
  stream += encode_frame(sample_message(0, 3, 20)) + encode_frame(sample_message(9, 4, 20));
  for (const char* order : {"pS", "Sp", "pSs", "tpS", "psS", "tSsp", "Spt"}) {
    stream += in_order(order, sample_message(5, 6, 20));
  }
  net::Frame message = sample_message(3, 8, 20);
  stream += framed(unknown_3 + message.SerializeAsString());
  stream += framed(message.SerializeAsString() + unknown_3);
  stream += framed(message.SerializeAsString() + unknown_2 + '\x80' + '\x01' + unknown_3);
  stream += std::string(1, '\0');  // an empty frame
  stream += encode_frame(net::Frame());
  stream += published(-1) + sample_frame(0, 10, 20);
  for (const std::size_t bytes : {0u, 1u, 19u}) {
    stream += sample_frame(0, 11, bytes) + sample_frame(0, 12, bytes, Torn::no);
    stream += in_order("pS", sample_message(0, 13, bytes));
  }
  stream += sample_frame(0, 14, 0);
  return stream;
}

TEST(FrameDecoder, HandsOutSamplesAndFramesInTheirOrder) {
  const Decoded decoded = decode(published(7) + sample_frame(4, 1, 20, Torn::yes), 20);
  ASSERT_EQ(decoded.error, "");
  ASSERT_EQ(decoded.log.size(), 2u);
  net::Frame frame;
  frame.mutable_published()->set_last(7);
  EXPECT_EQ(decoded.log[0], "frame " + frame.SerializeAsString());
  EXPECT_EQ(decoded.log[1], "sample 4/1/1000000002/3 torn " + payload_of(20, 1));
  EXPECT_TRUE(decoded.at_frame_end);
}

TEST(FrameDecoder, GivesTheSameForEverySplitIntoTwo) {
  const std::string stream = mixed_stream();
  const Decoded whole = decode(stream, 20);
  ASSERT_EQ(whole.error, "");
  ASSERT_EQ(whole.log.size(), 32u);
  EXPECT_EQ(whole.counters.samples, 27u);
  for (std::size_t at = 1; at < stream.size(); ++at) {
    Recorder recorder;
    FrameDecoder decoder(recorder, kMaxFrame);
    decoder.set_payload_bytes(20);
    ASSERT_TRUE(feed(decoder, std::string_view(stream).substr(0, at)));
    ASSERT_TRUE(feed(decoder, std::string_view(stream).substr(at)));
    ASSERT_EQ(recorder.log, whole.log) << "split at " << at;
    EXPECT_TRUE(decoder.at_frame_end());
    EXPECT_FALSE(decoder.in_payload());
  }
}

TEST(FrameDecoder, GivesTheSameForSingleBytes) {
  const std::string stream = mixed_stream();
  const Decoded whole = decode(stream, 20), single = decode(stream, 20, 1);
  ASSERT_EQ(single.error, "");
  EXPECT_EQ(single.log, whole.log);
}

TEST(FrameDecoder, CollectsOnlySamplesInAnUnusualOrderOfFields) {
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  recorder.decoder = &decoder;
  decoder.set_payload_bytes(20);
  ASSERT_TRUE(feed(decoder, mixed_stream(), 1));
  EXPECT_EQ(recorder.collected, 9);
}

TEST(FrameDecoder, GivesTheSameForRandomSplitsOfLargeSamples) {
  const unsigned seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (const std::size_t payload_bytes : {5'000u, 16'384u, 100'000u, 400'000u}) {
    std::string stream;
    for (std::int64_t tid = 0; tid < 12; ++tid) {
      const auto torn = static_cast<Torn>(random() % 3);
      stream += sample_frame(random() % 2 ? random() : 0, tid, payload_bytes, torn);
      if (random() % 3 == 0) stream += published(tid);
      if (random() % 4 == 0) stream += in_order("pS", sample_message(0, tid, payload_bytes));
    }
    const Decoded whole = decode(stream, payload_bytes);
    ASSERT_EQ(whole.error, "");
    for (int round = 0; round < 20; ++round) {
      Recorder recorder;
      FrameDecoder decoder(recorder, kMaxFrame);
      decoder.set_payload_bytes(payload_bytes);
      for (std::string_view rest = stream; !rest.empty();) {
        const std::size_t part = std::min<std::size_t>(
            rest.size(), random() % 3 ? 1 + random() % 70 : random() % 300'000);
        ASSERT_TRUE(feed(decoder, rest.substr(0, part)));
        rest.remove_prefix(part);
      }
      ASSERT_TRUE(recorder.log == whole.log) << payload_bytes;  // too long to be printed
    }
  }
}

// Whatever the order of a sample's fields: the same sample. Only behind a payload of our order
// there is no place for anything but `torn`; see the next test.
TEST(FrameDecoder, TakesFieldsInEveryOrder) {
  std::string order = "Sspt";
  std::sort(order.begin(), order.end());
  int orders = 0;
  do {
    const Decoded decoded = decode(in_order(order, sample_message(7, 5, 20)), 20);
    ASSERT_EQ(decoded.error, "") << order;
    ASSERT_EQ(decoded.log.size(), 1u);
    EXPECT_EQ(decoded.log[0], "sample 7/5/5000000030/15 torn " + payload_of(20, 5)) << order;
    ++orders;
  } while (std::next_permutation(order.begin(), order.end()));
  EXPECT_EQ(orders, 24);
}

TEST(FrameDecoder, RefusesASerialAfterALargePayloadThatItCouldNotWaitFor) {
  expect_refused(in_order("Sps", sample_message(300, 5, 20)), 20,
                 "field 1 came after a sample's payload");
}

TEST(FrameDecoder, TakesStampsInEveryOrderAndLeftOut) {
  const std::string payload = payload_of(20, 0);
  const std::string tid = std::string("\x09\x05", 2) + std::string(7, '\0');
  const std::string time = std::string("\x11\x06", 2) + std::string(7, '\0');
  const std::string error = std::string("\x19\x07", 2) + std::string(7, '\0');
  const std::pair<std::string, std::string> cases[] = {
      {tid + time + error, "0/5/6/7 "},
      {error + tid + time, "0/5/6/7 "},
      {time, "0/0/6/0 "},
      {"", "0/0/0/0 "},
      {error + tid, "0/5/0/7 "},
      {tid + tid, "0/5/0/0 "},
      {tid + "\x20\x01" + time, "0/5/6/0 "},  // with a field that nobody knows
  };
  for (const auto& [stamps, text] : cases) {
    const std::string message = std::string("\x12") + static_cast<char>(stamps.size()) + stamps +
                                std::string("\x7a\x14", 2) + payload;
    for (const std::size_t at_most : {SIZE_MAX, std::size_t{1}}) {
      const Decoded decoded = decode(framed(message), 20, at_most);
      ASSERT_EQ(decoded.error, "");
      ASSERT_EQ(decoded.log.size(), 1u);
      EXPECT_EQ(decoded.log[0], "sample " + text + payload);
    }
  }
}

TEST(FrameDecoder, TakesVarintsThatAreLongerThanTheyNeedToBe) {
  const std::string payload = payload_of(20, 0);
  // Length in 5 bytes, serial 5 in 3, empty sample, payload's length in 4.
  const std::string message =
      std::string("\x08\x85\x80\x00\x12\x00\x7a\x94\x80\x80\x00", 11) + payload;
  const std::string frame = std::string("\x9f\x80\x80\x80\x00", 5) + message;
  const Decoded decoded = decode(frame, 20);
  ASSERT_EQ(decoded.error, "");
  ASSERT_EQ(decoded.log.size(), 1u);
  EXPECT_EQ(decoded.log[0], "sample 5/0/0/0 " + payload);
}

TEST(FrameDecoder, CopiesSmallPayloadsOnceAndLargeOnesHardly) {
  std::string small, large;
  for (std::int64_t tid = 0; tid < 20; ++tid) {
    small += sample_frame(0, tid, 1000);
    large += sample_frame(0, tid, 1 << 20, Torn::no);
  }
  const Decoded copied = decode(small, 1000);
  EXPECT_EQ(copied.counters.copied_payload_bytes, 20'000u);
  EXPECT_EQ(copied.counters.direct_payload_bytes, 0u);
  const Decoded direct = decode(large, 1 << 20);
  EXPECT_EQ(direct.counters.copied_payload_bytes + direct.counters.direct_payload_bytes, 20u << 20);
  EXPECT_LT(direct.counters.copied_payload_bytes, (20u << 20) / 1000);
}

TEST(FrameDecoder, DropsPayloadsWithoutAPlace) {
  for (const std::size_t payload_bytes : {20u, 40'000u, 1'000'000u}) {
    const std::string stream = sample_frame(0, 1, payload_bytes, Torn::no) + published(3) +
                               in_order("pS", sample_message(0, 2, payload_bytes));
    for (const std::size_t at_most : {SIZE_MAX, std::size_t{777}}) {
      Recorder recorder;
      recorder.drops_payloads = true;
      FrameDecoder decoder(recorder, kMaxFrame);
      decoder.set_payload_bytes(payload_bytes);
      ASSERT_TRUE(feed(decoder, stream, at_most));
      EXPECT_EQ(recorder.log.size(), 3u);
      EXPECT_EQ(decoder.counters().copied_payload_bytes, 0u);
      EXPECT_EQ(decoder.counters().direct_payload_bytes, 0u);
      EXPECT_EQ(decoder.counters().samples, 2u);
    }
  }
}

TEST(FrameDecoder, LearnsThePayloadSizeInTheMidstOfABatch) {
  net::Frame opened;
  opened.mutable_opened()->set_created(true);
  const std::string stream = encode_frame(opened) + sample_frame(0, 1, 20);
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  recorder.then = [&](const net::Frame& frame) {
    if (frame.has_opened()) decoder.set_payload_bytes(20);
  };
  ASSERT_TRUE(feed(decoder, stream));
  EXPECT_EQ(recorder.log.size(), 2u);
}

TEST(FrameDecoder, ReportsWhetherAPayloadIsUnderWay) {
  const std::string frame = sample_frame(0, 1, 20);
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  decoder.set_payload_bytes(20);
  EXPECT_TRUE(decoder.at_frame_end());
  ASSERT_TRUE(feed(decoder, frame.substr(0, 5)));
  EXPECT_FALSE(decoder.at_frame_end());
  EXPECT_FALSE(decoder.in_payload());
  ASSERT_TRUE(feed(decoder, frame.substr(5, frame.size() - 10)));
  EXPECT_FALSE(decoder.at_frame_end());
  EXPECT_TRUE(decoder.in_payload());
  ASSERT_TRUE(feed(decoder, frame.substr(frame.size() - 5)));
  EXPECT_TRUE(decoder.at_frame_end());
  EXPECT_FALSE(decoder.in_payload());
}

TEST(FrameDecoder, MovesAPayloadThatIsUnderWay) {
  for (const std::size_t payload_bytes : {20u, 100'000u}) {
    const std::string frame = sample_frame(0, 1, payload_bytes, Torn::no);
    const std::size_t header = frame.size() - payload_bytes - kTornTrailerBytes;
    for (const std::size_t come : {std::size_t{0}, std::size_t{7}, payload_bytes}) {
      struct Sink final : Recorder {
        std::string first, second;
        Result<void> on_sample_begin(const IncomingSample& sample, std::byte*& out) override {
          first.assign(sample.info.payload_bytes, '?');
          out = reinterpret_cast<std::byte*>(first.data());
          return {};
        }
      } sink;
      FrameDecoder decoder(sink, kMaxFrame);
      decoder.set_payload_bytes(payload_bytes);
      ASSERT_TRUE(feed(decoder, frame.substr(0, header + come)));
      sink.second.assign(payload_bytes, '?');
      decoder.move_payload(reinterpret_cast<std::byte*>(sink.second.data()));
      sink.first.assign(payload_bytes, '!');
      ASSERT_TRUE(feed(decoder, frame.substr(header + come)));
      EXPECT_EQ(sink.log.size(), 1u);
      EXPECT_EQ(sink.second, payload_of(payload_bytes, 1));
      EXPECT_EQ(sink.first, std::string(payload_bytes, '!'));
    }
  }
}

// --- holding back

TEST(FrameDecoder, GivesTheSameToASinkThatHoldsBackAtRandom) {
  const unsigned seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  const std::string stream = mixed_stream();
  const std::vector<std::string> log = decode(stream, 20).log;
  for (const std::size_t at_most : {SIZE_MAX, std::size_t{50}, std::size_t{1}}) {
    for (int round = 0; round < 50; ++round) {
      Recorder recorder;
      FrameDecoder decoder(recorder, kMaxFrame);
      recorder.decoder = &decoder;
      decoder.set_payload_bytes(20);
      bool held = false;
      recorder.holds = [&] { return held = random() % 2; };
      ASSERT_TRUE(feed(decoder, stream, at_most, [&] { return std::exchange(held, false); }));
      EXPECT_EQ(recorder.log, log);
      EXPECT_TRUE(decoder.at_frame_end());
    }
  }
}

TEST(FrameDecoder, OffersASampleAgainThatWasHeldBack) {
  // The last one is collected over several receives before it can be offered.
  const std::string other_order = in_order("pS", sample_message(0, 2, 20));
  for (const std::string& frame : {sample_frame(0, 2, 20, Torn::no), other_order}) {
    for (const std::size_t at_most : {SIZE_MAX, std::size_t{1}}) {
      Recorder recorder;
      FrameDecoder decoder(recorder, kMaxFrame);
      recorder.decoder = &decoder;
      decoder.set_payload_bytes(20);
      int refusals = 3;
      bool held = false;
      recorder.holds = [&] { return held = refusals-- > 0; };
      ASSERT_TRUE(feed(decoder, frame, at_most, [&] { return std::exchange(held, false); }));
      EXPECT_EQ(recorder.begun, 4);
      EXPECT_EQ(recorder.log.size(), 1u);
    }
  }
}

TEST(FrameDecoder, KeepsItsInputWhileOtherDecodersWork) {
  const std::string stream = sample_frame(0, 1, 20) + published(1) + sample_frame(0, 2, 20);
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  recorder.decoder = &decoder;
  decoder.set_payload_bytes(20);
  recorder.holds = [] { return true; };
  ASSERT_TRUE(feed(decoder, stream));
  EXPECT_EQ(recorder.log.size(), 0u);
  EXPECT_FALSE(decoder.at_frame_end());
  EXPECT_EQ(decode(mixed_stream(), 20).error, "");
  recorder.holds = [] { return false; };
  ASSERT_TRUE(decoder.commit(0));
  EXPECT_EQ(recorder.log, decode(stream, 20).log);
}

// --- the input buffer is the thread's

TEST(FrameDecoder, SharesItsThreadWithOtherDecoders) {
  const std::string stream = mixed_stream();
  const std::vector<std::string> log = decode(stream, 20).log;
  Recorder first_log, second_log;
  FrameDecoder first(first_log, kMaxFrame), second(second_log, kMaxFrame);
  first.set_payload_bytes(20);
  second.set_payload_bytes(20);
  constexpr std::size_t kFirst = 13, kSecond = 29;  // pieces that end at other places each time
  for (std::size_t a = 0, b = 0; a < stream.size() || b < stream.size();
       a += kFirst, b += kSecond) {
    ASSERT_TRUE(feed(first, stream.substr(std::min(a, stream.size()), kFirst)));
    ASSERT_TRUE(feed(second, stream.substr(std::min(b, stream.size()), kSecond)));
  }
  EXPECT_EQ(first_log.log, log);
  EXPECT_EQ(second_log.log, log);
}

TEST(FrameDecoder, LetsASinkDriveAnotherDecoder) {
  const std::string stream = mixed_stream(), other = published(5) + stream;
  const std::vector<std::string> log = decode(stream, 20).log, other_log = decode(other, 20).log;
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  decoder.set_payload_bytes(20);
  recorder.then = [&](const net::Frame&) { EXPECT_EQ(decode(other, 20).log, other_log); };
  ASSERT_TRUE(feed(decoder, stream));
  EXPECT_EQ(recorder.log, log);
}

TEST(FrameDecoder, ContinuesInAnotherThread) {
  const std::string stream = mixed_stream();
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxFrame);
  decoder.set_payload_bytes(20);
  for (std::size_t at = 0; at < stream.size(); at += 33) {
    std::thread([&] { EXPECT_TRUE(feed(decoder, stream.substr(at, 33))); }).join();
  }
  EXPECT_EQ(recorder.log, decode(stream, 20).log);
}

// --- what is refused

TEST(FrameDecoder, RefusesALengthBeyondTheLimitsBeforeTheFrameIsThere) {
  expect_refused("\xa1\x8d\x06", 0, "100001 bytes is longer than the 100000");   // kMaxFrame + 1
  expect_refused("\xa1\x8d\x06", 20, "100001 bytes is longer than the 100000");  // small samples
  // Samples of 200,000 bytes: their frames may have 1 KiB more.
  expect_refused("\xc1\xa2\x0c", 200'000, "201025 bytes is longer than the 201024");
  EXPECT_EQ(decode("\xc0\xa2\x0c", 200'000).error, "");
}

TEST(FrameDecoder, RefusesALengthThatIsNoVarint) {
  expect_refused(std::string(5, '\xff'), 20, "not a varint-delimited frame");
}

TEST(FrameDecoder, RefusesALongFrameThatTurnsOutToBeNoSample) {
  net::Frame frame;
  frame.mutable_property()->set_property(std::string(150'000, 'x'));
  expect_refused(encode_frame(frame), 200'000, "longer than the 100000");
}

TEST(FrameDecoder, RefusesSamplesBeforeItKnowsTheirSize) {
  expect_refused(sample_frame(0, 1, 20), 0, "where none is expected");
  expect_refused(in_order("pS", sample_message(0, 1, 20)), 0, "where none is expected");
}

TEST(FrameDecoder, RefusesSamplesThatAreLongerThanTheStreams) {
  expect_refused(sample_frame(0, 1, 21), 20, "21 bytes came; the stream's samples have at most 20");
  expect_refused(in_order("pS", sample_message(0, 1, 21)), 20, "21 bytes");
  expect_refused(sample_frame(0, 1, 90'000).substr(0, 60), 40'000, "90000 bytes");
}

TEST(FrameDecoder, RefusesStampsThatCannotBe) {
  expect_refused(encode_frame(sample_message(0, -1, 20)), 20, "tid -1");
  net::Frame frame = sample_message(0, 1, 20);
  frame.mutable_sample()->set_clock_error_ns(1ULL << 63);
  expect_refused(encode_frame(frame), 20, "clock error 9223372036854775808");
  expect_refused(in_order("pS", frame), 20, "clock error");
  frame.mutable_sample()->set_clock_error_ns(INT64_MAX);
  EXPECT_EQ(decode(encode_frame(frame), 20).error, "");
}

TEST(FrameDecoder, RefusesAPayloadWithoutASampleAndASampleWithAnotherMessage) {
  expect_refused(in_order("p", sample_message(0, 1, 20)), 20, "without its sample");
  net::Frame frame = sample_message(0, 1, 20);
  frame.mutable_done();
  expect_refused(encode_frame(frame), 20, "another message");
}

TEST(FrameDecoder, RefusesTooMuchBesideAPayload) {
  const std::string sample = sample_message(0, 1, 20).SerializeAsString();
  const auto with_unknown = [&](std::size_t bytes) {  // field 100, of so many bytes in all
    const std::size_t content = bytes - 4;
    return framed(sample + "\xa2\x06" + static_cast<char>(content | 0x80) +
                  static_cast<char>(content >> 7) + std::string(content, 'x'));
  };
  const std::size_t beside = sample.size() - 20;
  EXPECT_EQ(decode(with_unknown(1024 - beside), 20).error, "");
  expect_refused(with_unknown(1025 - beside), 20, "1025 bytes besides the payload");
}

TEST(FrameDecoder, RefusesWhatIsNoMessage) {
  expect_refused(framed("garbage!"), 20, "not a message of this protocol");
  // A payload that would end after its frame.
  expect_refused(framed(std::string("\x12\x00\x7a\x14short", 9)), 20, "not a message");
  // After the payload: three bytes that are not a field.
  std::string sample = sample_message(0, 1, 20).SerializeAsString();
  expect_refused(framed(sample + "\xff\xff\xff"), 20, "not a field");
}

// Two bytes make an empty Stream in a list; protobuf takes some hundred bytes of memory for it.
TEST(FrameDecoder, RefusesMessagesThatWouldGrowAHundredfold) {
  std::string list;
  for (std::size_t i = 0; i < kMaxPropertyBytes / 2; ++i) list += std::string("\x0a\x00", 2);
  net::Frame frame;
  ASSERT_TRUE(frame.mutable_stream_list()->ParseFromString(list));
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxNetworkFrameBytes);
  const Result<void> fed = feed(decoder, encode_frame(frame));
  ASSERT_FALSE(fed);
  EXPECT_NE(fed.error().message.find("more elements than messages of that length have"),
            std::string::npos);
  EXPECT_TRUE(recorder.log.empty());
}

TEST(FrameDecoder, TakesTheLargestProperty) {
  net::Frame frame;
  frame.set_serial(9);
  frame.mutable_set_property()->set_property(std::string(kMaxPropertyBytes, 'x'));
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxNetworkFrameBytes);
  ASSERT_TRUE(feed(decoder, encode_frame(frame), 100'000));
  EXPECT_EQ(recorder.log.size(), 1u);
}

TEST(FrameDecoder, EndsWithWhatTheSinkReturned) {
  struct Refuser final : Recorder {
    std::string refused;
    Result<void> refuse(const char* what) {
      if (refused == what) return Error{Errc::closed, what};
      return {};
    }
    Result<void> on_sample_begin(const IncomingSample& sample, std::byte*& out) override {
      static_cast<void>(Recorder::on_sample_begin(sample, out));
      return refuse("begin");
    }
    Result<void> on_sample_end(const IncomingSample&, bool) override { return refuse("end"); }
    Result<void> on_frame(net::Frame&) override { return refuse("frame"); }
  };
  for (const char* what : {"begin", "end", "frame"}) {
    Refuser sink;
    sink.refused = what;
    FrameDecoder decoder(sink, kMaxFrame);
    decoder.set_payload_bytes(20);
    const Result<void> fed = feed(decoder, sample_frame(0, 1, 20) + published(1));
    ASSERT_FALSE(fed);
    EXPECT_EQ(fed.error().message, what);
  }
}

}  // namespace
}  // namespace dssm::wire
