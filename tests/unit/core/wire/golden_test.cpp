// SPDX-License-Identifier: Apache-2.0
//
// The bytes in tests/golden/network, which were written by hand: our code writes the same ones and
// understands them. A change that breaks this breaks every peer out there.
#include <gtest/gtest.h>

#include <cstdlib>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <set>

#include "core/wire/frame.hpp"
#include "core/wire/network_protocol.hpp"
#include "tests/support/frames.hpp"
#include "tests/unit/core/wire/recorder.hpp"

namespace dssm::wire {
namespace {

constexpr std::int64_t kTimeNs = 1'700'000'000'123'456'789;
constexpr std::uint64_t kIncarnation = 7'777'777;
const std::string kPayload = "0123456789:;<=>?@ABCDEFG";

std::filesystem::path source_root() {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");
  EXPECT_TRUE(root) << "$DSSM_SOURCE_ROOT is not set; run me through `meson test`";
  return root ? root : "";
}

std::filesystem::path folder() { return source_root() / "tests/golden/network"; }

std::string text_of(const std::filesystem::path& file) {
  std::ifstream in(file);
  EXPECT_TRUE(in) << file;
  return {std::istreambuf_iterator<char>(in), {}};
}

// The bytes of a golden file.
std::string golden(const std::string& name) {
  return test::golden_bytes(folder() / (name + ".hex"));
}

void set_id(proto::StreamId& id, const char* host, int number = 0) {
  id.set_name("lidar");
  id.set_id(number);
  id.set_host(host);
}

void set_type(proto::Type& type) {
  to_message(TypeInfo{"Scan",
                      24,
                      8,
                      {{"angle", Scalar::float64, 0, 1, 0}, {"ranges", Scalar::float32, 8, 4, 4}}},
             type);
}

using Fill = std::function<void(net::Frame&)>;

// What each file but those of samples means.
const std::map<std::string, Fill>& messages() {
  static const std::map<std::string, Fill> kMessages = {
      {"hello",
       [](net::Frame& frame) {
         Greeting greeting;
         greeting.host = "pc2";
         for (std::uint8_t i = 0; i < 16; ++i) greeting.host_id[i] = i;
         greeting.instance_id = 0x1122334455667788;
         greeting.program = "dssmd";
         greeting.version = "0.1.0";
         greeting.features = {std::string(kFeatureTorn)};
         to_message(greeting, *frame.mutable_hello());
         frame.mutable_hello()->mutable_clock()->set_bound_ns(250'000);
       }},
      {"failure",
       [](net::Frame& frame) {
         frame.set_serial(7);
         to_message(Error{Errc::not_found, "no stream 'lidar:0' on host 'pc2'"},
                    *frame.mutable_failure());
       }},
      {"final_failure",
       [](net::Frame& frame) {
         to_message(Error{Errc::limit_exceeded, "too many connections"}, *frame.mutable_failure());
       }},
      {"done",
       [](net::Frame& frame) {
         frame.set_serial(300);
         frame.mutable_done();
       }},
      {"open",
       [](net::Frame& frame) {
         frame.set_serial(1);
         set_id(*frame.mutable_open()->mutable_id(), "");
       }},
      {"create",
       [](net::Frame& frame) {
         frame.set_serial(1);
         set_id(*frame.mutable_create()->mutable_id(), "", 1);
         set_type(*frame.mutable_create()->mutable_type());
         frame.mutable_create()->set_depth(1000);
         frame.mutable_create()->set_cycle_ns(25'000'000);
       }},
      {"opened",
       [](net::Frame& frame) {
         frame.set_serial(1);
         proto::Stream& stream = *frame.mutable_opened()->mutable_stream();
         set_id(*stream.mutable_id(), "pc2");
         set_type(*stream.mutable_type());
         stream.set_depth(1000);
         stream.set_cycle_ns(25'000'000);
         stream.set_memory_bytes(135168);
         stream.set_incarnation(kIncarnation);
         stream.set_creator_pid(4711);
         stream.set_oldest(1002);
         stream.set_newest(2000);
         stream.set_newest_time_ns(kTimeNs);
         stream.set_rate_hz(40);
         stream.set_writers(1);
         stream.set_readers(2);
         stream.set_channels(1);
       }},
      {"subscribe_from_tid",
       [](net::Frame& frame) {
         frame.set_serial(2);
         frame.mutable_subscribe()->set_from_tid(1500);
         frame.mutable_subscribe()->set_incarnation(kIncarnation);
       }},
      {"subscribe_from_time",
       [](net::Frame& frame) {
         frame.set_serial(2);
         frame.mutable_subscribe()->set_from_time_ns(kTimeNs);
       }},
      {"subscribe_from_oldest",
       [](net::Frame& frame) {
         frame.set_serial(2);
         frame.mutable_subscribe()->set_from_oldest(true);
       }},
      {"subscribe_from_now",
       [](net::Frame& frame) {
         frame.set_serial(2);
         frame.mutable_subscribe()->set_from_now(true);
         frame.mutable_subscribe()->set_max_rate_hz(10);
       }},
      {"subscribe_newest_first",
       [](net::Frame& frame) {
         frame.set_serial(2);
         net::Subscribe& subscribe = *frame.mutable_subscribe();
         subscribe.set_from_tid(1500);
         subscribe.set_incarnation(kIncarnation);
         subscribe.set_newest_first(true);
         subscribe.set_held_from(1600);
         subscribe.set_held_to(2001);
         subscribe.set_backlog_from(1550);
       }},
      {"subscribed_newest_first",
       [](net::Frame& frame) {
         frame.set_serial(2);
         net::Subscribed& subscribed = *frame.mutable_subscribed();
         subscribed.set_incarnation(kIncarnation);
         subscribed.set_first_tid(1500);
         subscribed.set_newest(2000);
         subscribed.set_newest_first(true);
       }},
      {"subscribed",
       [](net::Frame& frame) {
         frame.set_serial(2);
         frame.mutable_subscribed()->set_incarnation(kIncarnation);
         frame.mutable_subscribed()->set_first_tid(1500);
         frame.mutable_subscribed()->set_newest(2000);
       }},
      {"read_tid",
       [](net::Frame& frame) {
         frame.set_serial(3);
         frame.mutable_read()->set_tid(1999);
       }},
      {"read_tid_0",
       [](net::Frame& frame) {
         frame.set_serial(3);
         frame.mutable_read()->set_tid(0);
       }},
      {"read_time",
       [](net::Frame& frame) {
         frame.set_serial(3);
         frame.mutable_read()->set_time_ns(kTimeNs);
       }},
      {"read_newest",
       [](net::Frame& frame) {
         frame.set_serial(3);
         frame.mutable_read()->set_newest(true);
       }},
      {"read_newer_than",
       [](net::Frame& frame) {
         frame.set_serial(3);
         frame.mutable_read()->set_newer_than(-1);
       }},
      {"no_sample",
       [](net::Frame& frame) {
         frame.set_serial(3);
         frame.mutable_no_sample()->set_status(static_cast<std::uint32_t>(ReadStatus::too_old));
       }},
      {"get_range",
       [](net::Frame& frame) {
         frame.set_serial(4);
         frame.mutable_get_range();
       }},
      {"get_range_at",
       [](net::Frame& frame) {
         frame.set_serial(4);
         frame.mutable_get_range()->set_time_ns(0);
       }},
      {"range",
       [](net::Frame& frame) {
         frame.set_serial(4);
         frame.mutable_range()->set_oldest(1002);
         frame.mutable_range()->set_newest(2000);
         frame.mutable_range()->set_at_tid(kNoTid);
       }},
      {"start_publishing",
       [](net::Frame& frame) {
         frame.set_serial(5);
         frame.mutable_start_publishing()->set_publisher(0x0102030405060708);
       }},
      {"publishing",
       [](net::Frame& frame) {
         frame.set_serial(5);
         frame.mutable_publishing()->set_last(-1);
         frame.mutable_publishing()->set_last_tid(kNoTid);
         frame.mutable_publishing()->set_incarnation(kIncarnation);
       }},
      {"published",
       [](net::Frame& frame) {
         frame.mutable_published()->set_last(41);
         frame.mutable_published()->set_last_tid(2042);
       }},
      {"caught_up", [](net::Frame& frame) { frame.mutable_caught_up(); }},
      {"gap",
       [](net::Frame& frame) {
         frame.mutable_gap()->set_first_tid(1500);
         frame.mutable_gap()->set_count(4);
       }},
      {"ended", [](net::Frame& frame) { frame.mutable_ended()->set_removed(true); }},
      {"set_property",
       [](net::Frame& frame) {
         frame.set_serial(6);
         set_id(*frame.mutable_set_property()->mutable_id(), "");
         frame.mutable_set_property()->set_property("\x01\x02\x03\x04");
       }},
      {"describe",
       [](net::Frame& frame) {
         frame.set_serial(6);
         set_id(*frame.mutable_describe()->mutable_id(), "");
         const TypeInfo type{"Scan", 4, 4, {{"m", Scalar::uint32, 0, 1, 4, 3, 5}}};
         to_message(type, *frame.mutable_describe()->mutable_type());
         frame.mutable_describe()->set_replace(true);
       }},
      {"get_property",
       [](net::Frame& frame) {
         frame.set_serial(6);
         frame.mutable_get_property();
       }},
      {"property",
       [](net::Frame& frame) {
         frame.set_serial(6);
         frame.mutable_property()->set_property("\x01\x02\x03\x04");
       }},
      {"list",
       [](net::Frame& frame) {
         frame.set_serial(8);
         frame.mutable_list();
       }},
      {"watch",
       [](net::Frame& frame) {
         frame.set_serial(8);
         frame.mutable_watch();
       }},
      {"info",
       [](net::Frame& frame) {
         frame.set_serial(8);
         set_id(*frame.mutable_info()->mutable_id(), "");
       }},
      {"remove",
       [](net::Frame& frame) {
         frame.set_serial(8);
         set_id(*frame.mutable_remove()->mutable_id(), "");
       }},
      {"ping",
       [](net::Frame& frame) {
         frame.set_serial(9);
         frame.mutable_ping()->mutable_clock()->set_bound_ns(to_ns(kUnknownClockError));
         frame.mutable_ping()->set_raw_ns(4000);
         frame.mutable_ping()->set_answered_ns(3000);
       }},
      {"pong",
       [](net::Frame& frame) {
         frame.set_serial(9);
         frame.mutable_pong()->mutable_clock()->set_bound_ns(250'000);
       }},
      {"list_clock_pairs",
       [](net::Frame& frame) {
         frame.set_serial(10);
         frame.mutable_list_clock_pairs();
       }},
      {"clock_pair_list",
       [](net::Frame& frame) {
         frame.set_serial(10);
         ClockPair pair;
         pair.owner = "pc3";
         pair.bound = Duration(250'000);
         pair.basis = DistanceBasis::measured;
         pair.chain = Duration(1'000'000);
         pair.measured = Duration(250'000);
         pair.round_trip = Duration(70'000);
         pair.limit = Duration(1'500'000);
         to_message(pair, *frame.mutable_clock_pair_list()->add_pairs());
       }},
      {"list_nodes",
       [](net::Frame& frame) {
         frame.set_serial(11);
         frame.mutable_list_nodes();
       }},
      {"follow_playback",
       [](net::Frame& frame) {
         frame.set_serial(12);
         proto::FollowPlayback& follow = *frame.mutable_follow_playback();
         follow.set_driver(17);
         follow.set_driver_name("play@pc1");
         proto::Playback& playback = *follow.mutable_playback();
         playback.mutable_run()->set_offset_s(100.5);
         playback.mutable_run()->set_speed(2);
         playback.set_change_s(1'700'000'000.25);
         playback.mutable_before()->set_speed(1);
         playback.mutable_before()->set_paused(true);
         playback.mutable_before()->set_paused_at_s(7.25);
       }},
      {"node_list",
       [](net::Frame& frame) {
         frame.set_serial(11);
         proto::Node& node = *frame.mutable_node_list()->add_nodes();
         node.set_host("pc2");
         node.set_pid(4711);
         node.set_uid(0);
         node.set_program("mapper");
         proto::NodeStream& use = *node.add_streams();
         set_id(*use.mutable_id(), "pc1");
         use.set_via(proto::MIRROR);
         proto::Node& other = *frame.mutable_node_list()->add_nodes();
         other.set_host("pc9");
         other.set_program("viewer");
         proto::NodeStream& written = *other.add_streams();
         set_id(*written.mutable_id(), "pc2");
         written.set_writer(true);
         written.set_via(proto::CONNECTION);
       }},
      {"set_users",
       [](net::Frame& frame) {
         frame.set_serial(3);
         StreamUser user{4711, 1000, "mapper"};
         user.via = StreamVia::mirror;
         to_message(user, *frame.mutable_set_users()->add_users());
         frame.mutable_set_users()->set_readers(2);
       }},
      {"stream_list",
       [](net::Frame& frame) {
         frame.set_serial(8);
         proto::Stream& stream = *frame.mutable_stream_list()->add_streams();
         set_id(*stream.mutable_id(), "pc2");
         stream.mutable_type()->set_payload_bytes(24);
         stream.mutable_type()->set_alignment_bytes(1);
         stream.set_depth(1000);
         stream.set_oldest(kNoTid);
         stream.set_newest(kNoTid);
         proto::User& user = *stream.add_users();
         user.set_pid(4711);
         user.set_uid(1000);
         user.set_program("urg");
         user.set_writer(true);
       }},
      {"stream_list_stalled",
       [](net::Frame& frame) {
         frame.set_serial(8);
         StreamInfo info;
         info.id = {"lidar", 0, "pc2"};
         info.state = StreamState::stalled;
         info.age = std::chrono::seconds(98);
         proto::Stream written;
         to_message(info, written);
         proto::Stream& stream = *frame.mutable_stream_list()->add_streams();
         set_id(*stream.mutable_id(), "pc2");
         stream.set_state(written.state());
         stream.set_age_ns(written.age_ns());
       }},
      {"stream_removed",
       [](net::Frame& frame) {
         frame.mutable_stream_event()->set_removed(true);
         proto::Stream& stream = *frame.mutable_stream_event()->mutable_stream();
         set_id(*stream.mutable_id(), "pc2");
         stream.set_incarnation(kIncarnation);
       }},
  };
  return kMessages;
}

struct SampleMeaning {
  std::uint64_t serial;
  SampleInfo info;
  Trailer trailer;
  bool torn;
};

const std::map<std::string, SampleMeaning>& samples() {
  const Time time = time_from_ns(kTimeNs);
  static const std::map<std::string, SampleMeaning> kSamples = {
      {"sample", {0, {1999, time, Duration(5000)}, Trailer::none, false}},
      {"sample_in_place", {0, {0, Time(), kUnknownClockError}, Trailer::torn, false}},
      {"sample_torn", {0, {2000, time, Duration(5000)}, Trailer::torn, true}},
      {"sample_read", {3, {1999, time, Duration(5000)}, Trailer::none, false}},
  };
  return kSamples;
}

// What the decoder makes of `bytes`.
std::vector<std::string> decoded(const std::string& bytes) {
  Recorder recorder;
  FrameDecoder decoder(recorder, kMaxNetworkFrameBytes);
  decoder.set_payload_bytes(kPayload.size());
  const Result<void> fed = feed(decoder, bytes);
  EXPECT_TRUE(fed) << fed.error().message;
  EXPECT_TRUE(decoder.at_frame_end());
  return recorder.log;
}

TEST(Golden, MessagesAreWrittenAsEver) {
  for (const auto& [name, fill] : messages()) {
    net::Frame frame;
    fill(frame);
    EXPECT_EQ(encode_frame(frame), golden(name)) << name;
  }
}

TEST(Golden, MessagesAreReadAsEver) {
  for (const auto& [name, fill] : messages()) {
    net::Frame frame;
    fill(frame);
    EXPECT_EQ(decoded(golden(name)), std::vector{"frame " + frame.SerializeAsString()}) << name;
  }
}

TEST(Golden, SamplesAreWrittenAsEver) {
  for (const auto& [name, meaning] : samples()) {
    std::array<std::byte, kMaxSampleHeaderBytes> header;
    SampleInfo info = meaning.info;
    info.payload_bytes = kPayload.size();
    const std::size_t bytes = encode_sample_header(header, meaning.serial, info, meaning.trailer);
    std::string frame(reinterpret_cast<const char*>(header.data()), bytes);
    frame += kPayload;
    if (meaning.trailer == Trailer::torn) {
      const auto field = torn_trailer(meaning.torn);
      frame.append(reinterpret_cast<const char*>(field.data()), field.size());
    }
    EXPECT_EQ(frame, golden(name)) << name;
  }
}

TEST(Golden, SamplesAreReadAsEver) {
  const std::pair<const char*, const char*> texts[] = {
      {"sample", "sample 0/1999/1700000000123456789/5000 "},
      {"sample_in_place", "sample 0/0/0/9223372036854775807 "},
      {"sample_torn", "sample 0/2000/1700000000123456789/5000 torn "},
      {"sample_read", "sample 3/1999/1700000000123456789/5000 "},
      {"other_order", "sample 3/0/1700000000123456789/0 "},
  };
  for (const auto& [name, text] : texts) {
    EXPECT_EQ(decoded(golden(name)), std::vector{text + kPayload}) << name;
  }
}

TEST(Golden, GreetingIsUnderstood) {
  net::Frame frame;
  const std::string bytes = golden("hello");
  ASSERT_TRUE(frame.ParseFromString(bytes.substr(1)));
  const auto greeting = greeting_untrusted(frame.hello(), "x");
  ASSERT_TRUE(greeting) << greeting.error().message;
  EXPECT_EQ(greeting->str(), "dssmd of host 'pc2'");
  EXPECT_TRUE(greeting->has_feature(kFeatureTorn));
}

TEST(Golden, ExamplesInTheDocumentationAreTheFiles) {
  std::set<std::string> files;
  for (const auto& entry : std::filesystem::directory_iterator(folder())) {
    if (entry.path().extension() == ".hex") files.insert(text_of(entry.path()));
  }
  const std::string text = text_of(source_root() / "docs/wire.md"), fence = "```\n";
  int examples = 0;
  for (std::size_t at = 0; (at = text.find(fence, at)) != text.npos; ++examples) {
    const std::size_t begin = at + fence.size(), end = text.find(fence, begin);
    ASSERT_NE(end, text.npos);
    EXPECT_TRUE(files.count(text.substr(begin, end - begin))) << text.substr(begin, end - begin);
    at = end + fence.size();
  }
  EXPECT_GE(examples, 10);
}

// Every file has a meaning above and in the README; every message that a frame can carry has a
// file.
TEST(Golden, FilesAndMeaningsAreComplete) {
  const std::string readme = text_of(folder() / "README.md");
  std::set<std::string> files;
  for (const auto& entry : std::filesystem::directory_iterator(folder())) {
    if (entry.path().extension() != ".hex") continue;
    const std::string name = entry.path().stem();
    files.insert(name);
    EXPECT_NE(readme.find("| `" + name + ".hex` |"), std::string::npos) << name;
  }
  std::set<std::string> meanings = {"other_order"};
  std::set<int> bodies;
  for (const auto& [name, meaning] : samples()) meanings.insert(name);
  for (const auto& [name, fill] : messages()) {
    meanings.insert(name);
    net::Frame frame;
    fill(frame);
    bodies.insert(frame.body_case());
  }
  EXPECT_EQ(files, meanings);
  for (int field = net::Frame::kHelloFieldNumber; field <= net::Frame::kPongFieldNumber; ++field) {
    EXPECT_TRUE(bodies.count(field) || field == net::Frame::kPayloadFieldNumber) << field;
  }
}

}  // namespace
}  // namespace dssm::wire
