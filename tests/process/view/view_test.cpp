// SPDX-License-Identifier: Apache-2.0
//
// dssm-view as a browser, Foxglove and Prometheus meet it. The clients are other authors': Python's
// http.client and websockets (client.py), and Foxglove's own library (foxglove/client.cjs).
#include <signal.h>

#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>

#include "client/dssmctl/black_box_streams.hpp"
#include "tests/process/view/view_fixture.hpp"
#include "tests/support/folder.hpp"
#include "tests/support/samples.hpp"
#include "tests/support/stream_owner.hpp"

namespace dssm::test {
namespace {

class View : public ViewTest {
 protected:
  std::string websocket_url() const { return "ws" + url_.substr(4); }

  std::vector<std::string> client(const std::string& what, const std::vector<std::string>& lines) {
    return run_client(url_, what, lines);
  }
  Json ask(const Json& request) {
    const std::vector<std::string> answers = client("ask", {request.dump()});
    return answers.size() == 1 ? Json::parse(answers[0]) : Json();
  }

  // Status and body of a GET.
  std::pair<int, std::string> get(const std::string& path, const std::string& header = "",
                                  const std::string& value = "") {
    const Finished finished =
        run({"/usr/bin/python3", "-c",
             "import sys, http.client, urllib.parse\n"
             "url, path, name, value = sys.argv[1:]\n"
             "client = http.client.HTTPConnection(urllib.parse.urlsplit(url).netloc)\n"
             "client.request('GET', path, headers={name: value} if name else {})\n"
             "answer = client.getresponse()\n"
             "print(answer.status)\n"
             "print(answer.getheader('content-type'))\n"
             "print(answer.read().decode(errors='replace'))\n",
             url_, path, header, value});
    EXPECT_EQ(finished.exit_status, 0) << finished.err;
    return {std::atoi(finished.out.c_str()), finished.out};
  }
};

// --- the server

TEST_F(View, ServesItsPageAndTheMetrics) {
  const auto page = get("/");
  EXPECT_EQ(page.first, 200);
  EXPECT_TRUE(contains(page.second, "text/html")) << page.second;
  EXPECT_EQ(get("/main.js").first, 200);
  const auto metrics = get("/metrics");
  EXPECT_EQ(metrics.first, 200);
  EXPECT_TRUE(contains(metrics.second, "application/openmetrics-text")) << metrics.second;
  EXPECT_TRUE(contains(metrics.second, "dssm_host_up{host=\"pc2\"} 1\n")) << metrics.second;
  EXPECT_TRUE(contains(metrics.second, "# EOF\n")) << metrics.second;
  const auto nothing = get("/nothing");
  EXPECT_EQ(nothing.first, 404);
  EXPECT_TRUE(contains(nothing.second, "text/plain")) << nothing.second;
  EXPECT_TRUE(
      contains(nothing.second, "there is nothing at /nothing; the page is at /, and /metrics\n"))
      << nothing.second;
  EXPECT_EQ(get("/../../../../etc/passwd").first, 404);
  EXPECT_EQ(get("/%2e%2e/%2e%2e/%2e%2e/%2e%2e/etc/passwd").first, 404);
}

TEST_F(View, ListensOnlyWhereItIsTold) {
  const auto port = static_cast<std::uint16_t>(std::stoi(url_.substr(url_.rfind(':') + 1)));
  const auto connects = [&](const std::string& address) {
    return run({"/usr/bin/python3", "-c",
                "import socket, sys\n"
                "socket.create_connection((sys.argv[1], int(sys.argv[2]))).close()\n",
                address, std::to_string(port)})
               .exit_status == 0;
  };
  EXPECT_TRUE(connects("127.0.0.1"));
  EXPECT_FALSE(connects("127.0.0.2"));
  EXPECT_FALSE(connects("::1"));
  if (!text_of("/proc/net/if_inet6").empty()) {  // this machine has IPv6
    Running v6(view_argv({"--listen", "[::1]:0"}), environment());
    EXPECT_TRUE(contains(v6.line(), "http://[::1]:"));
  }
  Running any(view_argv({"--listen", "0.0.0.0:0", "--insecure"}), environment());
  EXPECT_TRUE(contains(any.line(), "http://0.0.0.0:"));
}

// Any page that is open in a browser may send requests to this PC.
TEST_F(View, RefusesPagesOfOthers) {
  EXPECT_EQ(get("/", "Host", "evil.example").first, 403);
  EXPECT_EQ(get("/metrics", "Host", "evil.example:8765").first, 403);
  EXPECT_EQ(get("/", "Host", "localhost:1").first, 200);
  EXPECT_EQ(get("/", "Host", "[::1]:1").first, 200);
  const auto refused = [&](const std::string& origin) {
    const Finished finished =
        run({"/usr/bin/python3", "-c",
             "import asyncio, sys, websockets\n"
             "async def main():\n"
             "  async with websockets.connect(sys.argv[1], origin=sys.argv[2],\n"
             "      subprotocols=[sys.argv[3]]): pass\n"
             "asyncio.run(main())\n",
             websocket_url(), origin, "dssm.view.v1"});
    return finished.exit_status != 0;
  };
  EXPECT_TRUE(refused("http://evil.example"));
  EXPECT_TRUE(refused("null"));
  EXPECT_FALSE(refused(url_.substr(0, url_.size() - 1)));
  std::string line;
  do line = view_.line();
  while (!line.empty() && !contains(line, "'http://evil.example' may not connect; --origin"));
  EXPECT_FALSE(line.empty());
}

TEST_F(View, RefusesWhatIsNotARequestAndGoesOn) {
  const auto closed = [&](const std::string& line) { return client("send", {line}).back(); };
  EXPECT_TRUE(closed("no json").starts_with("1008 a request is to be a JSON object"));
  EXPECT_TRUE(closed("[1]").starts_with("1008 "));
  EXPECT_TRUE(closed(R"({"op":"overview"})").starts_with("1008 "));
  EXPECT_TRUE(closed(R"({"op":"overview","id":-1})").starts_with("1008 "));
  // The reason (1008) may be lost behind what was not read any more (1006).
  EXPECT_TRUE(closed(std::string(70'000, ' ')).starts_with("100"));
  EXPECT_TRUE(client("send", std::vector<std::string>(40, R"({"op":"overview","id":1})"))
                  .back()
                  .starts_with("100"));

  const auto error = [&](const Json& request) { return ask(request).value("error", ""); };
  EXPECT_EQ(error({{"op", "sing"}}), "there is no operation 'sing'");
  EXPECT_TRUE(contains(error({{"op", "at"}}), "'streams' is to be a list"));
  EXPECT_TRUE(contains(error({{"op", "at"}, {"streams", {1}}}), "strings only"));
  EXPECT_TRUE(contains(error({{"op", "at"}, {"streams", Json::array()}, {"t_ns", 5}}), "'t_ns'"));
  EXPECT_TRUE(
      contains(error({{"op", "at"}, {"streams", Json::array()}, {"t_ns", "5x"}}), "'t_ns'"));
  EXPECT_TRUE(contains(error({{"op", "signals"}, {"fields", Json::array()}}), "'span_ns'"));
  const Json signals = {{"op", "signals"}, {"fields", {"x"}}, {"stream", "motion:0@pc1"},
                        {"from_ns", "10"}, {"to_ns", "10"},   {"points", 10}};
  EXPECT_TRUE(contains(error(signals), "before 'to_ns'"));
  EXPECT_TRUE(contains(
      error({{"op", "signals"}, {"fields", {"x"}}, {"span_ns", "10"}, {"points", 1}}), "'points'"));
  const Json missing = ask({{"op", "at"}, {"streams", {"nothing", ""}}});
  EXPECT_EQ(missing["samples"][0]["status"], "unavailable") << missing;
  EXPECT_TRUE(contains(missing["samples"][0].value("error", ""), "nothing")) << missing;
  EXPECT_EQ(missing["samples"][1]["status"], "unavailable") << missing;
}

// --- the page's protocol

TEST_F(View, ShowsHostsStreamsAndPrograms) {
  auto motion = session_.create<Motion>("motion", depth_of(8)).value();
  motion.write({});
  auto lidar = on_pc2_.create<double>("lidar:3", depth_of(8)).value();
  Json overview;
  await([&] {
    overview = ask({{"op", "overview"}});
    return overview["streams"].size() == 2 && overview.value("nodes", Json()).size() == 2;
  });
  EXPECT_EQ(overview["host"], "pc1");
  EXPECT_EQ(overview["error"], "");
  EXPECT_EQ(overview["hosts"].size(), 3U);
  EXPECT_EQ(overview["streams"][0]["stream"], "motion:0@pc1");
  EXPECT_EQ(overview["streams"][0]["writers"], 1);
  EXPECT_EQ(overview["streams"][1]["stream"], "lidar:3@pc2");
  EXPECT_EQ(overview["nodes"][0]["program"], "the test");
  EXPECT_FALSE(overview["findings"].empty());
  EXPECT_EQ(overview["range"]["newest_ns"], overview["streams"][0]["newest_ns"]);
  // A device that counts from its start.
  auto device = session_.create<double>("device", depth_of(8)).value();
  device.write(0, at_ns(10 * kSecond));
  await([&] {
    overview = ask({{"op", "overview"}});
    return overview["streams"].size() == 3 && !overview["streams"][1]["newest_ns"].is_null();
  });
  EXPECT_EQ(overview["range"]["oldest_ns"], overview["range"]["newest_ns"]);

  pc3_.kill_hard();
  await([&] {
    overview = ask({{"op", "overview"}});
    const Json& events = overview["events"];
    return std::any_of(events.begin(), events.end(), [](const Json& event) {
      return event["severity"] == "warn" &&
             contains(event["text"].get<std::string>(), "host pc3 is down");
    });
  });
  const auto pc3 = std::find_if(overview["hosts"].begin(), overview["hosts"].end(),
                                [](const Json& host) { return host["host"] == "pc3"; });
  ASSERT_NE(pc3, overview["hosts"].end());
  EXPECT_EQ((*pc3)["state"], "down") << overview["hosts"];
}

// Not by its rate: 1 Hz at first, then 1 kHz.
std::int64_t irregular_ns(std::int64_t i) {
  return 1000 * kSecond + std::min<std::int64_t>(i, 900) * kSecond +
         std::max<std::int64_t>(i - 900, 0) * 1'000'000;
}

TEST_F(View, StatesWhenTheOldestSamplesAreFrom) {
  auto motion = session_.create<Motion>("motion", depth_of(1201)).value();
  auto lidar = on_pc2_.create<std::int64_t>("lidar", depth_of(1201)).value();
  for (std::int64_t i = 0; i < 1200; ++i) {
    motion.write({}, at_ns(irregular_ns(i)));
    lidar.write(i, at_ns(irregular_ns(i)));
  }
  Json overview;
  const auto await_streams_in_overview = [&](const auto& is_so) {
    await([&] {
      overview = ask({{"op", "overview"}});
      return overview["streams"].size() == 2 && is_so(overview["streams"]);
    });
  };
  const std::string first = std::to_string(irregular_ns(0));
  await_streams_in_overview([&](const Json& streams) { return streams[0]["oldest_ns"] == first; });
  EXPECT_EQ(overview["range"]["oldest_ns"], first);
  EXPECT_EQ(session_.stream_info(motion.id()).value().readers, 0U);
  // That of another host is not fetched for this.
  const auto ask_lidar = [&](const Json& t) {
    return ask({{"op", "at"}, {"streams", {"lidar:0@pc2"}}, {"t_ns", t}})["samples"][0];
  };
  await([&] { return ask_lidar(nullptr)["status"] == "ok"; });
  await_streams_in_overview([&](const Json& streams) { return !streams[1]["mirror"].is_null(); });
  const auto second_of = [](const Json& state) {
    return std::stoll(state["now_ns"].get<std::string>()) / kSecond;
  };
  const auto begin = second_of(overview);
  await_streams_in_overview([&](const Json&) { return second_of(overview) > begin + 2; });
  const Json& mirror = overview["streams"][1]["mirror"];
  EXPECT_EQ(mirror["history_wanted"], false) << mirror;
  EXPECT_NE(overview["streams"][1]["oldest_ns"], first);
  // As soon as it is here, it counts.
  await([&] { return ask_lidar(first)["status"] == "ok"; });
  await_streams_in_overview([&](const Json& streams) { return streams[1]["oldest_ns"] == first; });
  // A ring that is written goes on.
  for (std::int64_t i = 1200; i < 1300; ++i) motion.write({}, at_ns(irregular_ns(i)));
  const std::string later = std::to_string(irregular_ns(100));
  await_streams_in_overview([&](const Json& streams) { return streams[0]["oldest_ns"] == later; });
}

TEST_F(View, TellsOfAStreamThatStalls) {
  auto motion = session_.create<Motion>("motion", depth_of(64)).value();
  const auto overview = [&] { return ask({{"op", "overview"}}); };
  await([&] {
    motion.write({});
    const Json streams = overview()["streams"];
    return streams.size() == 1 && streams[0]["state"] == "live";
  });
  await([&] { return contains(overview()["events"].dump(), "\"stream motion:0@pc1: stalled\""); });
  await([&] {
    motion.write({});
    return contains(overview()["events"].dump(), "\"stream motion:0@pc1 is live again\"");
  });
}

// As a black box announces it.
TEST_F(View, TellsOfRecordedIncidents) {
  ctl::RecordedIncident incident{};
  ctl::set_text(incident.trigger, "bumper");
  ctl::set_text(incident.host, "pc3");
  ctl::set_text(incident.reason, "it hit <b>something</b>");
  ctl::set_text(incident.file, "/var/lib/dssm-record/a.mcap");
  on_pc2_.create<ctl::RecordedIncident>("dssm_incident", depth_of(8)).value().write(incident);
  await([&] {
    const std::string events = ask({{"op", "overview"}})["events"].dump();
    return contains(events,
                    "incident recorded on pc2: bumper of pc3: it hit <b>something</b>; "
                    "/var/lib/dssm-record/a.mcap") &&
           !contains(events, "stream dssm_incident");
  });
}

TEST_F(View, SaysSoWhileDssmdIsGone) {
  ASSERT_EQ(ask({{"op", "overview"}})["error"], "");
  daemon_.kill_hard();
  await([&] { return ask({{"op", "overview"}})["error"] != ""; });
  EXPECT_EQ(get("/").first, 200);
  EXPECT_EQ(get("/metrics").first, 503);
  daemon_.start();
  await([&] { return ask({{"op", "overview"}})["error"] == ""; });
}

TEST_F(View, GivesTheTypeAndTheFields) {
  auto motion = session_.create<Motion>("motion", depth_of(8)).value();
  auto plain = session_.create_raw({"plain", 0, ""}, TypeInfo{"", 5, 1, {}}, depth_of(8)).value();
  const Json type = ask({{"op", "type"}, {"stream", "motion:0@pc1"}});
  EXPECT_EQ(type["status"], "ok");
  EXPECT_EQ(type["name"], "Motion");
  EXPECT_EQ(type["payload_bytes"], sizeof(Motion));
  EXPECT_EQ(type["fields"].size(), 3U);
  EXPECT_EQ(type["fields"][1]["name"], "speed");
  EXPECT_EQ(type["fields"][1]["count"], 3);
  EXPECT_EQ(type["fields"][1]["offset_bytes"], offsetof(Motion, speed));
  EXPECT_TRUE(ask({{"op", "type"}, {"stream", "plain:0@pc1"}})["fields"].empty());
}

TEST_F(View, ShowsAllStreamsAtOneTime) {
  auto motion = session_.create<Motion>("motion", depth_of(64)).value();
  auto lidar = on_pc2_.create<std::int64_t>("lidar", depth_of(64)).value();
  auto late = session_.create<std::int64_t>("late", depth_of(64)).value();
  for (int i = 0; i < 40; ++i) {
    motion.write({0.5 * i, {1, 2, 3}, i}, at_ns(kSecond + i * 10'000'000));
    if (i % 4 == 0) lidar.write(i, at_ns(kSecond + i * 10'000'000 + 1));
  }
  late.write(7, at_ns(9 * kSecond));
  await_streams(1);
  const std::string t = std::to_string(kSecond + 205'000'000);
  const Json at =
      ask({{"op", "at"}, {"streams", {"motion:0@pc1", "lidar:0@pc2", "late:0@pc1"}}, {"t_ns", t}});
  EXPECT_EQ(at["t_ns"], t);
  const Json& samples = at["samples"];
  ASSERT_EQ(samples.size(), 3U) << at;
  EXPECT_EQ(samples[0]["tid"], 20) << at;
  EXPECT_EQ(samples[0]["time_ns"], std::to_string(kSecond + 200'000'000));
  EXPECT_EQ(samples[0]["payload_bytes"], sizeof(Motion));
  // As a person sees the same sample in a terminal.
  const Json echoed = json({"echo", "motion", "--at", "1.205"});
  EXPECT_EQ(echoed["tid"], samples[0]["tid"]);
  EXPECT_EQ(samples[1]["tid"], 5) << at;
  EXPECT_EQ(samples[2]["status"], "too_old") << at;
  EXPECT_FALSE(samples[2].contains("payload"));

  const Json now = ask({{"op", "at"}, {"streams", {"motion:0@pc1", "late:0@pc1"}}});
  EXPECT_EQ(now["samples"][0]["tid"], 39);
  EXPECT_EQ(now["samples"][1]["payload"], "0700000000000000");
}

TEST_F(View, SendsWhatIsShortThoughItsStreamsMayHaveMore) {
  constexpr std::uint64_t kLongest = 17U << 20;
  std::vector<RawWriter> writers;
  for (const char* name : {"front", "rear"}) {
    writers.push_back(
        session_.create_raw({name, 0, ""}, {"", kLongest, 1, {}}, depth_of(kMinDepth)).value());
  }
  for (RawWriter& writer : writers) writer.write(std::vector<std::byte>(3, std::byte{7}));
  const Json request = {{"op", "at"}, {"streams", {"front:0@pc1", "rear:0@pc1"}}};
  const Json samples = ask(request).value("samples", Json::array());
  ASSERT_EQ(samples.size(), 2U);
  for (const Json& sample : samples) EXPECT_EQ(sample["payload"], "070707") << sample;
  for (RawWriter& writer : writers) writer.write(std::vector<std::byte>(kLongest));
  EXPECT_TRUE(contains(ask(request)["error"].dump(), "sent at once"));
}

TEST_F(View, LosesNoPeakOfASignal) {
  constexpr int kSamples = 20'000, kPeak = 12'345;
  auto motion = session_.create<Motion>("motion", depth_of(kSamples + 1)).value();
  for (std::int64_t i = 0; i < kSamples; ++i) {
    motion.write({i == kPeak ? 99.0 : static_cast<double>(i % 2), {0, static_cast<float>(i), 0}, 1},
                 at_ns(kSecond + i * 1'000'000));
  }
  const Json signals = ask({{"op", "signals"},
                            {"stream", "motion:0@pc1"},
                            {"fields", {"x", "speed[1]"}},
                            {"span_ns", "20000000000"},
                            {"points", 200}});
  EXPECT_EQ(signals["samples"], kSamples);
  EXPECT_EQ(signals["lost"], 0);
  ASSERT_EQ(signals["curves"].size(), 2U) << signals;
  const Json& x = signals["curves"][0];
  EXPECT_LE(x["points"], 202);
  EXPECT_GE(x["points"], 180);
  const auto values = x["values"].get<std::vector<double>>();
  const auto peak = std::ranges::find(values, 99.0);
  ASSERT_NE(peak, values.end());
  EXPECT_EQ(x["tids"][static_cast<std::size_t>(peak - values.begin())], kPeak);
  const auto times = x["times"].get<std::vector<double>>();
  EXPECT_TRUE(std::ranges::is_sorted(times));
  EXPECT_EQ(signals["curves"][1]["values"].back(), kSamples - 1);

  // Of a part with fewer samples than points, all; and one before and after it.
  const Json part = ask({{"op", "signals"},
                         {"stream", "motion:0@pc1"},
                         {"fields", {"wheel"}},
                         {"from_ns", std::to_string(kSecond + 100'500'000)},
                         {"to_ns", std::to_string(kSecond + 110'500'000)},
                         {"points", 200}});
  EXPECT_EQ(part["curves"][0]["tids"].front(), 100) << part;
  EXPECT_EQ(part["curves"][0]["tids"].back(), 111) << part;
  EXPECT_EQ(part["curves"][0]["points"], 12) << part;
  // From before the ring's first sample on; and nothing of what is wholly before it.
  const auto from_zero_to = [&](std::int64_t to_ns) {
    return ask({{"op", "signals"},
                {"stream", "motion:0@pc1"},
                {"fields", {"wheel"}},
                {"from_ns", "0"},
                {"to_ns", std::to_string(to_ns)},
                {"points", 200}});
  };
  EXPECT_EQ(from_zero_to(kSecond + 500)["status"], "ok");
  EXPECT_EQ(from_zero_to(kSecond + 500)["curves"][0]["tids"].front(), 0);
  EXPECT_EQ(from_zero_to(kSecond - 500)["status"], "too_old");
  EXPECT_TRUE(from_zero_to(kSecond - 500)["curves"].empty());
}

TEST_F(View, FollowsAStreamThatIsCreatedAgain) {
  auto motion = std::optional(session_.create<Motion>("motion", depth_of(8)).value());
  motion->write({1, {}, 0});
  const Json request = {{"op", "at"}, {"streams", {"motion:0@pc1"}}};
  EXPECT_EQ(ask(request)["samples"][0]["tid"], 0);
  motion->write({2, {}, 0});
  ASSERT_TRUE(session_.remove(motion->id()));
  motion = session_.create<Motion>("motion", depth_of(8)).value();
  motion->write({3, {}, 0});
  await([&] {
    const Json sample = ask(request)["samples"][0];
    return sample["status"] == "ok" && sample["tid"] == 0;
  });
}

// --- what is saved

// A file of the server, at `path` here.
void download(const std::string& url, const std::string& path) {
  const Finished finished =
      run({"/usr/bin/python3", "-c",
           "import sys, urllib.request as r; r.urlretrieve(*sys.argv[1:])", url, path});
  EXPECT_EQ(finished.exit_status, 0) << finished.err;
}

TEST_F(View, SavesARangeAsARecording) {
  auto motion = session_.create<Motion>("motion", depth_of(101)).value();
  auto lidar = on_pc2_.create<std::int64_t>("lidar", depth_of(101)).value();
  const std::vector<std::byte> property = {std::byte{1}, std::byte{2}};
  ASSERT_TRUE(motion.set_property(property));
  const Time begin = WallClock::now() - std::chrono::seconds(1);
  const auto time_of = [&](int i) { return begin + std::chrono::milliseconds(10 * i); };
  for (int i = 0; i < 100; ++i) {
    motion.write({0.5 * i, {}, i}, time_of(i));
    lidar.write(i, time_of(i));
  }
  await_streams(1);
  const auto ns = [&](int i) { return std::to_string(to_ns(time_of(i))); };
  const Json saved = ask({{"op", "save"}, {"from_ns", ns(20)}, {"to_ns", ns(60)}});
  EXPECT_EQ(saved["streams"], 2) << saved;
  EXPECT_EQ(saved["samples"], 82) << saved;
  EXPECT_EQ(saved["lost_samples"], 0) << saved;
  EXPECT_TRUE(saved["notices"].empty()) << saved;

  const TestFolder folder;
  const std::string path = saved.value("path", "");
  ASSERT_TRUE(path.ends_with(".mcap")) << saved;
  download(url_ + path.substr(1), folder.file("a.mcap"));
  EXPECT_EQ(std::filesystem::file_size(folder.file("a.mcap")), saved["file_bytes"]);
  const Recording recording = Recording::open(folder.file("a.mcap")).value();
  ASSERT_EQ(recording.streams().size(), 2U);
  for (const RecordedStreamInfo& stream : recording.streams()) {
    EXPECT_EQ(stream.samples, 41U) << stream.id.str();
    EXPECT_EQ(stream.first_time, time_of(20)) << stream.id.str();
    EXPECT_EQ(stream.last_time, time_of(60)) << stream.id.str();
    EXPECT_EQ(stream.property, stream.id.name == "motion" ? property : std::vector<std::byte>());
  }

  // One stream, and all that is there of it.
  const Json one =
      ask({{"op", "save"}, {"streams", {"lidar:0@pc2"}}, {"from_ns", "0"}, {"to_ns", nullptr}});
  EXPECT_EQ(one["streams"], 1) << one;
  EXPECT_EQ(one["samples"], 100) << one;

  pc3_.kill_hard();
  await([&] {
    const std::vector<HostInfo> hosts = session_.list_hosts().value();
    return std::any_of(hosts.begin(), hosts.end(), [](const HostInfo& host) {
      return host.name == "pc3" && host.state == HostState::down;
    });
  });
  const Json without = ask({{"op", "save"}, {"from_ns", "0"}});
  ASSERT_EQ(without["notices"].size(), 1U) << without;
  EXPECT_EQ(without["notices"][0], "host 'pc3' is down: its streams are not in the recording");

  EXPECT_TRUE(contains(ask({{"op", "save"}})["error"].dump(), "'from_ns'"));
  // Names are not patterns.
  const auto samples_of = [&](const std::string& name) {
    return ask({{"op", "save"}, {"streams", {name}}, {"from_ns", "0"}})["samples"];
  };
  EXPECT_EQ(samples_of("*"), 0);
  // With a fifth one the first is gone.
  EXPECT_EQ(get(path).first, 200);
  EXPECT_EQ(samples_of("lidar:0@pc2"), 100);
  EXPECT_EQ(samples_of("lidar:0@pc2"), 100);
  EXPECT_EQ(get(path).first, 404);
  EXPECT_EQ(get(path.substr(0, path.rfind('/'))).first, 404);
  EXPECT_EQ(get("/saved/../../../etc/passwd").first, 404);
  EXPECT_EQ(get("/saved/%2e%2e/%2e%2e/%2e%2e/etc/passwd").first, 404);
  // The files end with it.
  EXPECT_FALSE(std::filesystem::is_empty(temporary_.path()));
  view_.signal(SIGTERM);
  EXPECT_EQ(view_.status(), 0);
  EXPECT_TRUE(std::filesystem::is_empty(temporary_.path()));
}

TEST_F(View, GivesTheProperty) {
  auto motion = session_.create<Motion>("motion", depth_of(8)).value();
  const Json request = {{"op", "property"}, {"stream", "motion:0@pc1"}};
  EXPECT_TRUE(contains(ask(request)["error"].dump(), "no property")) << ask(request);
  ASSERT_TRUE(motion.set_property(std::vector<std::byte>{std::byte{0x5a}, std::byte{3}}));
  EXPECT_EQ(ask(request)["property"], "5a03");
  EXPECT_TRUE(contains(ask({{"op", "property"}, {"stream", "a b:x"}})["error"].dump(), "a b"));
}

// Foxglove plays and seeks in what the rings held when it connected.
TEST_F(View, PlaysWhatTheRingsHoldToFoxglove) {
  auto motion = session_.create<Motion>("motion", depth_of(200)).value();
  auto lidar = on_pc2_.create<std::int64_t>("lidar", depth_of(200)).value();
  const auto ns = [](int i) { return 1000 * kSecond + i * 10'000'000; };
  for (int i = 0; i < 200; ++i) {
    motion.write({0.5 * i, {}, i}, at_ns(ns(i)));
    if (i % 10 == 0) lidar.write(i, at_ns(ns(i)));
  }
  await([&] {
    const Json overview = ask({{"op", "overview"}});
    return overview["streams"].size() == 2 &&
           overview["range"]["newest_ns"] == std::to_string(ns(199));
  });
  const std::string all = joined(
      run_client(url_ + "hold", "play",
                 {"pause 1 " + std::to_string(ns(50)), "play 10 " + std::to_string(ns(100))}));
  EXPECT_TRUE(contains(all, " to 1001.990000000\n")) << all;
  EXPECT_TRUE(contains(all, "motion@pc1 " + std::to_string(ns(50)) + "\n")) << all;
  EXPECT_TRUE(contains(all, "lidar@pc2 " + std::to_string(ns(50)) + "\n")) << all;
  EXPECT_TRUE(contains(all, "state ended " + std::to_string(ns(199)) + "\n")) << all;
  EXPECT_TRUE(contains(all, "played motion@pc1 100 in order\n")) << all;
  EXPECT_TRUE(contains(all, "played lidar@pc2 10 in order\n")) << all;
}

struct ViewOfASlowNetwork : WithStreamOwner, CtlTest {
  ViewOfASlowNetwork() : CtlTest({"--peer", owner.address()}) {}
};

TEST_F(ViewOfASlowNetwork, ShowsThePresentToFoxgloveThoughEarlierSamplesAreStillToCome) {
  if (tests_tls()) GTEST_SKIP() << "the peer is this test, which does not speak TLS";
  Running view(view_argv({"--listen", "127.0.0.1:0"}), environment());
  const std::string line = view.line();
  const std::size_t at = line.find("http://");
  ASSERT_NE(at, std::string::npos) << line;
  Running client({"/usr/bin/python3", source("tests/process/view/client.py"), "follow",
                  "ws" + line.substr(at + 4)},
                 {});
  owner.send_sample(0);
  EXPECT_EQ(client.line(), "0");
  owner.send_sample(5);  // 1 to 4 never come
  EXPECT_EQ(client.line(), "5");
  EXPECT_TRUE(client.line().starts_with("4 samples were left out: "));
}

TEST_F(View, PlaysOnWhenAStreamIsCreatedAgainWithAnotherType) {
  constexpr int kSamples = 2000;
  auto motion = std::optional(session_.create<Motion>("motion", depth_of(kSamples)).value());
  auto number = session_.create<std::int64_t>("number", depth_of(kSamples)).value();
  for (int i = 0; i < kSamples; ++i) {
    motion->write({1.0 * i, {}, i}, at_ns(1000 * kSecond + i * 1'000'000));
    number.write(i, at_ns(1000 * kSecond + i * 1'000'000));
  }
  await([&] { return ask({{"op", "overview"}})["streams"].size() == 2; });
  Running client({"/usr/bin/python3", source("tests/process/view/client.py"), "loop",
                  websocket_url() + "hold"},
                 {});
  ASSERT_EQ(client.line(), "playing") << client.rest();
  ASSERT_TRUE(session_.remove(motion->id()));
  motion.reset();
  auto other = session_.create<double>("motion", depth_of(8)).value();
  other.write(1);
  await([&] {
    Json answer = ask({{"op", "at"}, {"streams", {"motion:0@pc1", "number:0@pc1"}}});
    return answer.contains("samples") && answer["samples"][0]["payload_bytes"] == 8 &&
           answer["samples"][1]["tid"] == kSamples - 1;
  });
  view_.signal(SIGTERM);
  EXPECT_EQ(view_.status(), 0);
}

// --- clients that do not read

TEST_F(View, DelaysNobodyForABrowserThatStands) {
  auto images =
      session_.create_raw({"image", 0, ""}, TypeInfo{"", 1 << 20, 1, {}}, depth_of(8)).value();
  const std::vector<std::byte> image(1 << 20);
  await([&] { return ask({{"op", "overview"}})["streams"].size() == 1; });
  Running client(
      {"/usr/bin/python3", source("tests/process/view/client.py"), "hold", websocket_url()}, {});
  ASSERT_EQ(client.line(), "ready");
  client.stop();
  const auto resident_kib = [&] {
    long kib = 0;
    std::ifstream status("/proc/" + std::to_string(view_.pid()) + "/status");
    for (std::string line; std::getline(status, line);) {
      if (line.starts_with("VmRSS:")) kib = std::atol(line.c_str() + 6);
    }
    return kib;
  };
  await([&] {
    images.write(image);
    return session_.stream_info(images.id()).value().readers == 1;
  });
  const long before = resident_kib();
  const auto write = [&](int count, std::chrono::milliseconds cycle) {
    for (int i = 0; i < count; ++i) {
      images.write(image);
      std::this_thread::sleep_for(cycle);
    }
  };
  // First at a rate at which nothing is left out until no more fits between the two.
  write(50, std::chrono::milliseconds(10));
  // Another one is answered meanwhile.
  const Json other = ask({{"op", "at"}, {"streams", {"image:0@pc1"}}});
  EXPECT_EQ(other["samples"][0]["payload_bytes"], 1 << 20);
  write(100, std::chrono::milliseconds(2));
  EXPECT_LT(resident_kib() - before, 40 << 10);
  // Longer than between two reports: what there is no room for now is not to be forgotten.
  std::this_thread::sleep_for(std::chrono::milliseconds(2200));
  client.signal(SIGCONT);
  const std::string line = client.line();
  EXPECT_TRUE(contains(line, "samples were left out")) << line;
}

// --- TLS

TEST_F(View, ByTlsServesOnlyClientsOfItsAuthority) {
  if (text_of("/etc/machine-id").empty()) GTEST_SKIP() << "this machine has no id";
  const TestFolder folder;
  // A CA, and a certificate of it in the folder of that name.
  const auto pki = [&](std::vector<std::string> words, const std::string& input = "") {
    words.insert(words.begin(), {dssmctl_path(), "pki"});
    const Finished finished = run(words, {}, input);
    EXPECT_EQ(finished.exit_status, 0) << finished.err;
    return finished.out;
  };
  const auto issue = [&](const std::string& ca, const std::string& kind, const std::string& name) {
    const std::string credentials = folder.file(ca + "-" + name);
    const std::string request = pki({"request", "--credentials", credentials, kind, name});
    const std::string issued = pki({"issue", "-", "--ca", folder.file(ca)}, request);
    pki({"install", "-", "--credentials", credentials}, issued);
    return credentials;
  };
  for (const char* ca : {"truck", "other"}) pki({"init", "--ca", folder.file(ca), "--name", ca});
  const std::string own = issue("truck", "--host", "pc1"),
                    laptop = issue("truck", "--program", "laptop"),
                    stranger = issue("other", "--program", "laptop");
  const auto revoke = [&](const std::string& name) {
    std::ofstream(own + "/revoked.crl") << pki({"revoke", name, "--ca", folder.file("truck")});
  };
  const std::string desk = issue("truck", "--program", "desk"),
                    old = issue("truck", "--program", "old");
  revoke("old");
  Running secure(view_argv({"--listen", "127.0.0.1:0", "--certificate", own + "/own.crt", "--key",
                            own + "/own.key", "--authority", own + "/ca.crt", "--revoked",
                            own + "/revoked.crl"}),
                 environment());
  const std::string line = secure.line();
  ASSERT_TRUE(contains(line, "https://127.0.0.1:")) << line;
  const std::string address = line.substr(line.find("127."), line.size() - 1 - line.find("127."));
  // Beginning of a Python program with the arguments address, authority, folder of a certificate.
  const std::string tls =
      "import asyncio, http.client, ssl, sys, time, websockets\n"
      "address, authority, own = sys.argv[1:]\n"
      "context = ssl.create_default_context(cafile=authority)\n"
      "context.check_hostname = False\n"
      "if own: context.load_cert_chain(own + '/own.crt', own + '/own.key')\n";
  // Of a GET with the certificate in that folder; empty: with none.
  const auto get = [&](const std::string& certificate) {
    return run({"/usr/bin/python3", "-c",
                tls + "client = http.client.HTTPSConnection(address, context=context)\n"
                      "client.request('GET', '/metrics')\n"
                      "print(client.getresponse().status, client.sock.version())\n",
                address, own + "/ca.crt", certificate})
        .out;
  };
  EXPECT_EQ(get(laptop), "200 TLSv1.3\n");
  EXPECT_EQ(get(""), "");
  EXPECT_EQ(get(stranger), "");
  EXPECT_EQ(get(old), "");
  EXPECT_EQ(get(laptop), "200 TLSv1.3\n");
  // Asks again and again by one connection, until that is ended.
  Running staying({"/usr/bin/python3", "-c",
                   tls + "client = http.client.HTTPSConnection(address, context=context)\n"
                         "client.connect()\n"
                         "client.auto_open = False\n"
                         "status, count = 200, 0\n"
                         "while status == 200:\n"
                         "  client.request('GET', '/time.js')\n"
                         "  answer = client.getresponse()\n"
                         "  answer.read()\n"
                         "  status, count = answer.status, count + 1\n"
                         "  if count == 2: print('stays', flush=True)\n"
                         "  time.sleep(0.1)\n"
                         "print('ended by', status, flush=True)\n",
                   address, own + "/ca.crt", laptop},
                  {});
  EXPECT_EQ(staying.line(), "stays");
  Running page({"/usr/bin/python3", "-c",
                tls + "async def main():\n"
                      "  async with websockets.connect('wss://' + address, ssl=context,\n"
                      "      subprotocols=['dssm.view.v1']) as server:\n"
                      "    print('open', flush=True)\n"
                      "    await server.wait_closed()\n"
                      "    print('closed,', server.close_reason, flush=True)\n"
                      "asyncio.run(main())\n",
                address, own + "/ca.crt", laptop},
               {});
  EXPECT_EQ(page.line(), "open");

  // Files that change are used without a restart; ones that are wrong are not.
  const auto await_line = [&](const std::string& part) {
    std::string said;
    do said = secure.line();
    while (!said.empty() && !contains(said, part));
    EXPECT_FALSE(said.empty()) << part;
  };
  std::ofstream(own + "/revoked.crl") << "damaged";
  await_line("holds no revocation list");
  EXPECT_EQ(get(laptop), "200 TLSv1.3\n");
  revoke("laptop");
  await_line("read again");
  EXPECT_EQ(get(laptop), "");
  EXPECT_EQ(get(desk), "200 TLSv1.3\n");
  EXPECT_EQ(staying.line(), "ended by 403");
  EXPECT_EQ(page.line(), "closed, the certificates were read again");
}

// --- the command line

TEST(ViewCommand, NamesWhatIsWrong) {
  const auto refused = [](std::vector<std::string> words) {
    const Finished finished = run(view_argv(std::move(words)), {"DSSM_SOCKET=/nothing"});
    return std::pair(finished.exit_status, finished.err);
  };
  EXPECT_EQ(refused({"--sing"}).first, 2);
  EXPECT_TRUE(contains(refused({"--listen", "8765"}).second, "not ADDRESS:PORT"));
  const auto open = refused({"--listen", "0.0.0.0:8765"});
  EXPECT_EQ(open.first, 2);
  EXPECT_TRUE(contains(open.second, "--insecure")) << open.second;
  for (const char* name : {"localhost:8765", "foo:1"}) {
    const auto named = refused({"--listen", name});
    EXPECT_EQ(named.first, 2);
    EXPECT_TRUE(contains(named.second, "is not a numeric address")) << named.second;
    EXPECT_FALSE(contains(named.second, "--insecure")) << named.second;
  }
  for (const char* host : {"a:b", "http://a", "a/b", ""}) {
    const auto named = refused({"--host", host});
    EXPECT_EQ(named.first, 2) << host;
    EXPECT_TRUE(contains(named.second, "as robot.example.org")) << named.second;
  }
  for (const char* origin : {"foxglove", "app.foxglove.dev", "https://app.foxglove.dev/",
                             "https://App.foxglove.dev", "https://a:443", "https://"}) {
    const auto named = refused({"--origin", origin});
    EXPECT_EQ(named.first, 2) << origin;
    EXPECT_TRUE(contains(named.second, "as https://app.foxglove.dev")) << named.second;
  }
  for (const char* origin : {"https://app.foxglove.dev", "http://[::1]:8080", "file://", "null"}) {
    EXPECT_EQ(refused({"--origin", origin, "--host", "PC-1.local"}).first, 1) << origin;
  }
  EXPECT_EQ(refused({"--certificate", "a"}).first, 2);
  EXPECT_EQ(refused({"--authority", "a"}).first, 2);
  EXPECT_EQ(refused({"--certificate", "a", "--key", "b", "--revoked", "c"}).first, 2);
  const TestFolder folder;
  std::ofstream(folder.file("view.conf")) << "listen = \"8765\"\nhost = [\"a\", \"b\"]\n";
  EXPECT_TRUE(contains(refused({"--config", folder.file("view.conf")}).second, "not ADDRESS:PORT"));
  // The command line comes after the file.
  EXPECT_TRUE(
      contains(refused({"--config", folder.file("view.conf"), "--listen", "127.0.0.1:0"}).second,
               "/nothing"));
  std::ofstream(folder.file("typo.conf")) << "lisen = \"127.0.0.1:0\"\n";
  const auto typo = refused({"--config", folder.file("typo.conf")});
  EXPECT_EQ(typo.first, 2);
  EXPECT_TRUE(contains(typo.second, "configuration '" + folder.file("typo.conf"))) << typo.second;
  EXPECT_TRUE(contains(typo.second, "--lisen")) << typo.second;
  const auto no_daemon = refused({"--listen", "127.0.0.1:0"});
  EXPECT_EQ(no_daemon.first, 1);
  EXPECT_TRUE(contains(no_daemon.second, "/nothing")) << no_daemon.second;
}

TEST_F(View, EndsAtASignalWhileClientsAreConnected) {
  auto motion = session_.create<Motion>("motion", depth_of(8)).value();
  motion.write({});
  await([&] { return ask({{"op", "overview"}})["streams"].size() == 1; });
  Running page(
      {"/usr/bin/python3", "-c",
       "import asyncio, sys, websockets\n"
       "async def main():\n"
       "  async with websockets.connect(sys.argv[1], subprotocols=['dssm.view.v1']) as server:\n"
       "    await server.send('{\"op\":\"overview\",\"id\":1}')\n"
       "    await server.recv()\n"
       "    print('ready', flush=True)\n"
       "    await server.wait_closed()\n"
       "asyncio.run(main())\n",
       websocket_url()},
      {});
  Running foxglove(
      {"/usr/bin/python3", source("tests/process/view/client.py"), "hold", websocket_url()}, {});
  ASSERT_EQ(page.line(), "ready");
  ASSERT_EQ(foxglove.line(), "ready");
  view_.signal(SIGTERM);
  EXPECT_EQ(view_.status(), 0) << view_.rest();
  EXPECT_EQ(page.status(), 0);
}

TEST_F(View, SaysThatThePortIsInUse) {
  const std::string port = url_.substr(url_.rfind(':') + 1);
  const Finished second =
      run(view_argv({"--listen", "127.0.0.1:" + port.substr(0, port.size() - 1)}), environment());
  EXPECT_EQ(second.exit_status, 1);
  EXPECT_TRUE(contains(second.err, "is another dssm-view running")) << second.err;
}

}  // namespace
}  // namespace dssm::test
