// SPDX-License-Identifier: Apache-2.0
//
// dssm-view as other tools meet it: Foxglove's own client (foxglove/client.cjs), and a real
// Prometheus.
#include <sys/socket.h>

#include <filesystem>
#include <fstream>
#include <regex>

#include "docs/examples/vehicle/samples.hpp"
#include "tests/process/view/view_fixture.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using ViewTools = ViewTest;

// --- Foxglove

// Where a struct has padding, nested structs and arrays of them.
struct Box {
  std::uint8_t kind;
  double width;
  std::uint8_t last;
};
DSSM_DESCRIBE(Box, kind, width, last)
struct Seen {
  bool isNew;
  Box boxes[2];
  float range[3];
  std::int64_t frame;
  std::uint16_t last;
};
DSSM_DESCRIBE(Seen, isNew, boxes, range, frame, last)

// The folder with Foxglove's client; nullopt: it cannot run here.
std::optional<std::string> foxglove_client() {
  const std::string folder = source("tests/process/view/foxglove");
  if (!std::filesystem::exists(folder + "/node_modules") ||
      run({"/bin/sh", "-c", "command -v node"}).exit_status != 0) {
    return std::nullopt;
  }
  return folder;
}
const char* const kNoFoxglove =
    "no node, or `npm ci --prefix tests/process/view/foxglove` was not run";

TEST_F(ViewTools, ServeFoxglove) {
  const std::optional<std::string> folder = foxglove_client();
  if (!folder) GTEST_SKIP() << kNoFoxglove;
  auto seen = session_.create<Seen>("seen", depth_of(8)).value();
  auto motion = on_pc2_.create<Motion>("motion:5", depth_of(8)).value();
  auto plain = session_.create_raw({"plain", 0, ""}, TypeInfo{"", 3, 1, {}}, depth_of(8)).value();
  seen.write({true, {{1, 2.5, 3}, {4, 5.5, 6}}, {7, 8, 9}, -10, 11}, at_ns(1'234'567'890'123));
  motion.write({0.5, {1, 2, 3}, -4}, at_ns(42));
  const std::vector<std::byte> bytes = {std::byte{7}, std::byte{0}, std::byte{255}};
  plain.write(bytes, at_ns(43));
  await_streams(1);
  for (const char* subprotocol : {"foxglove.sdk.v1", "foxglove.websocket.v1"}) {
    const Finished client = run({"node", *folder + "/client.cjs", "ws" + url_.substr(4),
                                 subprotocol, "seen@pc1", "motion:5@pc2", "plain@pc1"});
    EXPECT_EQ(client.exit_status, 0) << client.err;
    EXPECT_TRUE(contains(client.out, "server dssm-view on pc1 time connectionGraph\n"))
        << client.out;
    EXPECT_TRUE(contains(client.out, "motion:5@pc2 42 {\"x\":0.5,\"speed\":[1,2,3],\"wheel\":-4"))
        << client.out;
    EXPECT_TRUE(contains(client.out, "plain@pc1 43 {\"data\":[7,0,255]}\n")) << client.out;
    EXPECT_TRUE(contains(client.out, "\"boxes\":[{\"kind\":1,")) << client.out;
    EXPECT_TRUE(contains(client.out, "\"width\":5.5,\"last\":6")) << client.out;
    EXPECT_TRUE(contains(client.out, "\"range\":[7,8,9],")) << client.out;
    EXPECT_TRUE(contains(client.out, "\"frame\":-10,\"last\":11")) << client.out;
    EXPECT_TRUE(contains(client.out, "seen@pc1 1234567890123 {\"isnew\":true,")) << client.out;
    EXPECT_TRUE(contains(client.out, "writers plain@pc1 the test@pc1 (")) << client.out;
  }
}

TEST_F(ViewTools, ServeTheStreamsOfTheVehicleExampleToFoxglove) {
  const std::optional<std::string> folder = foxglove_client();
  if (!folder) GTEST_SKIP() << kNoFoxglove;
  auto lidar = session_.create<vehicle::Scan>(vehicle::kScanStream, depth_of(8)).value();
  auto pose = on_pc2_.create<vehicle::Pose>(vehicle::kPoseStream, depth_of(8)).value();
  auto scan = std::make_unique<vehicle::Scan>();
  scan->beams = 3;
  scan->first_rad = -0.5F;
  scan->step_rad = 0.25F;
  for (std::size_t i = 0; i < vehicle::kMaxBeams; ++i)
    scan->range_m[i] = 0.5F * static_cast<float>(i);
  lidar.write(*scan, at_ns(50));
  pose.write({1.5, -2.5, 0.25, 7}, at_ns(50));
  await_streams(1);
  const Finished client = run({"node", *folder + "/client.cjs", "ws" + url_.substr(4),
                               "foxglove.sdk.v1", "lidar@pc1", "pose@pc2"});
  EXPECT_EQ(client.exit_status, 0) << client.err;
  EXPECT_TRUE(contains(client.out,
                       "pose@pc2 50 {\"x_m\":1.5,\"y_m\":-2.5,\"theta_rad\":0.25,"
                       "\"scan_tid\":7}\n"))
      << client.out;
  EXPECT_TRUE(contains(client.out,
                       "lidar@pc1 50 {\"beams\":3,\"first_rad\":-0.5,\"step_rad\":0.25,"
                       "\"range_m\":[0,0.5,1,"))
      << client.out;
  const std::string last = std::to_string((vehicle::kMaxBeams - 1) / 2);
  EXPECT_TRUE(contains(client.out, "," + last + ((vehicle::kMaxBeams - 1) % 2 ? ".5]" : "]")))
      << client.out;
}

// --- Prometheus

// Its own alert rule must fire for a host that is down, as docs/metrics.md has it.
TEST_F(ViewTools, LetPrometheusRaiseAnAlert) {
  if (run({"/bin/sh", "-c", "command -v prometheus"}).exit_status != 0) {
    GTEST_SKIP() << "Debian's package prometheus is not installed";
  }
  const TestFolder folder;
  const std::string address = url_.substr(7, url_.size() - 8);
  std::ofstream(folder.file("prometheus.yml")) << "global:\n"
                                                  "  scrape_interval: 2s\n"  // and its timeout
                                                  "  evaluation_interval: 200ms\n"
                                                  "rule_files: [rules.yml]\n"
                                                  "scrape_configs:\n"
                                                  "  - job_name: dssm\n"
                                                  "    static_configs:\n"
                                                  "      - targets: ['"
                                               << address << "']\n";
  std::ofstream rules(folder.file("rules.yml"));
  for (const std::string& line :
       lines_of(text_of(source("docs/examples/metrics/dssm.rules.yml")))) {
    if (!contains(line, " for: ")) rules << line << "\n";  // at once
  }
  rules.close();
  const std::uint16_t port = free_port(SOCK_STREAM);
  const std::string at = "127.0.0.1:" + std::to_string(port);
  Running prometheus({"prometheus", "--config.file=" + folder.file("prometheus.yml"),
                      "--storage.tsdb.path=" + folder.file("data"), "--web.listen-address=" + at},
                     {});
  const auto api = [&](const std::string& path) {
    const Finished got = run({"/usr/bin/python3", "-c",
                              "import sys, urllib.request\n"
                              "print(urllib.request.urlopen(sys.argv[1]).read().decode())\n",
                              "http://" + at + path});
    return got.exit_status == 0 ? Json::parse(got.out) : Json();
  };
  const auto value = [&](const std::string& query) {
    const Json answer = api("/api/v1/query?query=" + query);
    const Json result = answer.is_null() ? Json::array() : answer["data"]["result"];
    return result.empty() ? std::string() : result[0]["value"][1].get<std::string>();
  };
  await([&] { return value("dssm_host_up%7Bhost%3D%22pc3%22%7D") == "1"; });
  pc3_.kill_hard();
  await([&] {
    const Json answer = api("/api/v1/alerts");
    if (answer.is_null()) return false;
    const Json& alerts = answer["data"]["alerts"];
    return std::any_of(alerts.begin(), alerts.end(), [](const Json& alert) {
      return alert["labels"]["alertname"] == "DssmHostDown" && alert["labels"]["host"] == "pc3";
    });
  });
  prometheus.signal(SIGTERM);
  EXPECT_EQ(prometheus.status(), 0);
}

// Rules and dashboard know only metrics that there are.
TEST(MetricsExamples, UseMetricsOfTheManual) {
  const std::string manual = text_of(source("docs/metrics.md"));
  for (const char* file : {"dssm.rules.yml", "dssm-dashboard.json"}) {
    const std::string text = text_of(source(std::string("docs/examples/metrics/") + file));
    const std::regex name("\\bdssm_[a-z_]+");
    int names = 0;
    for (std::sregex_iterator at(text.begin(), text.end(), name), end; at != end; ++at, ++names) {
      EXPECT_TRUE(contains(manual, "`" + at->str() + "`")) << file << ": " << at->str();
    }
    EXPECT_GT(names, 5) << file;
  }
  EXPECT_FALSE(
      Json::parse(text_of(source("docs/examples/metrics/dssm-dashboard.json")))["panels"].empty());
}

}  // namespace
}  // namespace dssm::test
