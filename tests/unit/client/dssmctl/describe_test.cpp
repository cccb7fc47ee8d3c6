// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/describe.hpp"

#include <gtest/gtest.h>

namespace dssm::ctl {
namespace {

HostInfo closed_host() {
  HostInfo host;
  host.name = "pc2";
  host.state = HostState::closed;
  host.id = "00ff";
  host.found_by = {"peer", "mdns"};
  return host;
}

TEST(HostRow, HasACellForEachColumnAndShowsHowTheHostWasFound) {
  const std::vector<std::string> row = host_row(closed_host());
  ASSERT_EQ(row.size(), host_columns().size());
  EXPECT_EQ(host_columns()[3].title, "FOUND BY");
  EXPECT_EQ(std::vector<std::string>(row.begin(), row.begin() + 4),
            (std::vector<std::string>{"pc2", "closed", "-", "peer, mdns"}));
}

TEST(HostRow, EscapesWhatOthersSay) {
  HostInfo host = closed_host();
  host.found_by = {"m\x1b[dns"};
  host.error = "a\nb";
  for (const std::string& cell : host_row(host)) {
    EXPECT_EQ(cell.find_first_of("\x1b\n"), std::string::npos) << cell;
  }
}

TEST(HostRow, DoesNotKnowHowManyStreamsAHostHasThatIsDown) {
  EXPECT_EQ(host_columns()[6].title, "STREAMS");
  EXPECT_EQ(host_row(closed_host())[6], "-");
  EXPECT_TRUE(host_json(closed_host())["streams"].is_null());
}

// As the catalog has it: the owner does not answer now.
TEST(StreamJson, HasNullForWhatIsNotKnown) {
  StreamInfo stream;
  stream.id = {"odom", 0, "pc2"};
  const Json json = stream_json(stream);
  for (const char* key : {"state", "rate_hz", "age_ns", "newest_tid", "writers", "readers",
                          "channels", "creator_pid"}) {
    EXPECT_TRUE(json.contains(key) && json[key].is_null()) << key;
  }
  EXPECT_EQ(count_text(stream, stream.writers), "-");
  stream.state = StreamState::empty;
  EXPECT_EQ(stream_json(stream)["writers"], 0);
}

TEST(StreamJson, SaysThatAMirrorIsBehind) {
  StreamInfo stream;
  stream.newest = 100;
  stream.newest_time = time_from_ns(10'000'000'000);
  stream.cycle = std::chrono::milliseconds(10);
  stream.rate_hz = 100;
  MirrorInfo& mirror = stream.mirror.emplace();
  mirror.state = MirrorState::live;
  mirror.newest = 99;
  mirror.newest_time = time_from_ns(9'990'000'000);
  EXPECT_EQ(mirror_json(stream)["state"], "live");
  EXPECT_EQ(mirror_json(stream)["behind_ns"], 0);
  mirror.newest_time = time_from_ns(8'500'000'000);
  EXPECT_EQ(mirror_json(stream)["state"], "behind");
  EXPECT_EQ(mirror_json(stream)["behind_ns"], 1'500'000'000);
  mirror.state = MirrorState::owner_unavailable;
  EXPECT_EQ(mirror_json(stream)["state"], "owner unavailable");
}

TEST(CarriedText, SaysNothingWhileTheOwnerIsDown) {
  StreamInfo stream;
  stream.rate_hz = 30;
  MirrorInfo& mirror = stream.mirror.emplace();
  mirror.state = MirrorState::live;
  mirror.recent_samples = 90;
  mirror.recent_lost_samples = 57;
  EXPECT_EQ(carried_text(stream), "carries 11 of 30 samples a second");
  mirror.state = MirrorState::filling;
  EXPECT_EQ(carried_text(stream), "carries 11 of 30 samples a second");
  EXPECT_EQ(mirror_json(stream)["carried_bytes_per_s"], 0) << "nothing has come yet";
  mirror.state = MirrorState::owner_unavailable;
  EXPECT_EQ(carried_text(stream), "");
  EXPECT_TRUE(mirror_json(stream)["carried_bytes_per_s"].is_null());
}

TEST(CarriedText, SaysHowManyBytesThoseSamplesHave) {
  StreamInfo stream;
  stream.rate_hz = 30;
  MirrorInfo& mirror = stream.mirror.emplace();
  mirror.state = MirrorState::live;
  EXPECT_TRUE(mirror_json(stream)["carried_bytes_per_s"].is_null()) << "it carries all";
  mirror.recent_samples = 90;
  mirror.recent_lost_samples = 57;
  mirror.received_samples = 200;
  mirror.received_bytes = 200 * 921'600ULL;
  EXPECT_EQ(carried_text(stream), "carries 11 of 30 samples a second (9.67 MiB/s)");
  EXPECT_EQ(mirror_json(stream)["carried_bytes_per_s"], 10'137'600);
  mirror.max_rate_hz = 20;
  EXPECT_EQ(carried_text(stream),
            "carries 11 of the 20 samples a second that are asked for (9.67 MiB/s)");
}

TEST(HostJson, PrintsTheSameAsJson) {
  const Json json = host_json(closed_host());
  EXPECT_EQ(json["host"], "pc2");
  EXPECT_EQ(json["id"], "00ff");
  EXPECT_EQ(json["state"], "closed");
  EXPECT_EQ(json["found_by"], Json({"peer", "mdns"}));
  EXPECT_TRUE(json["version"].is_null());
}

}  // namespace
}  // namespace dssm::ctl
