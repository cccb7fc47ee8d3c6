// SPDX-License-Identifier: Apache-2.0
//
// dssmctl convert, info and play with logs of SSM.
#include <cstring>
#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <iterator>
#include <random>

#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

namespace fs = std::filesystem;
using namespace std::chrono_literals;

class Convert : public CtlTest {
 protected:
  ~Convert() override { remove_tree(folder_); }

  std::string file(const std::string& name) const { return folder_ + "/" + name; }
  std::string save(const std::string& name, const std::string& content) const {
    std::ofstream(file(name), std::ios::binary) << content;
    return file(name);
  }
  static std::string content_of(const std::string& path) {
    std::ifstream in(path, std::ios::binary);
    return {std::istreambuf_iterator<char>(in), {}};
  }
  // What dssmctl says when it refuses.
  std::string refusal(std::vector<std::string> words) {
    const Finished finished = ctl(std::move(words));
    EXPECT_NE(finished.exit_status, 0);
    return finished.err;
  }
  // Records of `bytes` random bytes, with the times of a robot that runs now.
  static std::string records(int count, std::size_t bytes, unsigned seed) {
    std::mt19937 random(seed);
    std::string content;
    double time = 1795250129.792010;
    for (int i = 0; i < count; ++i) {
      time += static_cast<double>(random() % 2'000'000) / 1e7 - 0.02;  // it may also fall
      std::string record(sizeof time + bytes, '\0');
      for (char& c : record) c = static_cast<char>(random());
      std::memcpy(record.data(), &time, sizeof time);
      content += record;
    }
    return content;
  }

  const std::string folder_ = make_temp_dir();
};

TEST_F(Convert, OfLogsAndBackGivesTheSameBytes) {
  const std::string odometry = save("odometry.log",
                                    "spur_odometry 3 40 49 0.050000 1795250129.792010 "
                                    "24\n" +
                                        std::string(24, 'p') + records(3000, 40, 1));
  // As another program may have written it.
  const std::string scan =
      save("x.log", "scan  0 5704 121\t0.05 1795250100.5  0\n" + records(50, 5704, 2));
  const std::string tick = save("tick.log", "tick 1 0 2 0.000000 0.000000 0\n" + records(5, 0, 3));
  const std::string text = output({"convert", odometry, scan, tick, file("all.mcap")});
  EXPECT_EQ(text, file("all.mcap") + ": 3055 samples\n");

  output({"convert", file("all.mcap"), file("back/")});
  EXPECT_EQ(content_of(file("back/spur_odometry-3.log")), content_of(odometry));
  EXPECT_EQ(content_of(file("back/scan-0.log")), content_of(scan));
  EXPECT_EQ(content_of(file("back/tick-1.log")), content_of(tick));
  EXPECT_EQ(std::distance(fs::directory_iterator(file("back")), fs::directory_iterator()), 3);

  output({"convert", "--stream", "scan", file("all.mcap"), file("scan.log")});
  EXPECT_EQ(content_of(file("scan.log")), content_of(scan));
}

TEST_F(Convert, OfARecordingGivesLogsThatSsmReads) {
  RecordingWriter writer = RecordingWriter::create(file("a.mcap")).value();
  RecordedStream stream;
  stream.id = {"pose", 0, "pc1"};
  stream.type = {"Pose", 8, 8, {{"x", Scalar::float64, 0, 1, 8}}};
  stream.depth = 16;
  stream.cycle = 20ms;
  stream.incarnation = 1;
  stream.property = {std::byte{'a'}, std::byte{'b'}};
  const auto pose = writer.add_stream(stream).value();
  stream.id.host = "pc2";
  const auto other = writer.add_stream(stream).value();
  stream.incarnation = 2;
  const auto restarted = writer.add_stream(stream).value();
  for (const auto number : {pose, other, restarted}) {
    const double x = 1.5;
    const SampleInfo info{7, time_from_ns(1795250129'500'000'000 + number), 5ns, 8};
    ASSERT_TRUE(writer.write(number, info, 5ns, std::as_bytes(std::span(&x, 1))));
  }
  ASSERT_TRUE(writer.finish());
  const Json done = json({"convert", file("a.mcap"), file("logs")});
  EXPECT_EQ(done["samples"], 3);
  EXPECT_EQ(done["files"], (Json{file("logs/pose-0@pc1.log"), file("logs/pose-0@pc2.log"),
                                 file("logs/pose-0@pc2_1.log")}));
  const double time = 1795250129.5, x = 1.5;
  std::string record(16, '\0');
  std::memcpy(record.data(), &time, 8);
  std::memcpy(record.data() + 8, &x, 8);
  EXPECT_EQ(content_of(file("logs/pose-0@pc1.log")),
            "pose 0 8 16 0.020000 1795250129.500000 2\nab" + record);
}

// No --stream chooses one of these.
TEST_F(Convert, OfAStreamThatWasCreatedAgainTakesAFolder) {
  RecordingWriter writer = RecordingWriter::create(file("a.mcap")).value();
  RecordedStream stream;
  stream.id = {"pose", 0, "pc1"};
  stream.type.payload_bytes = 8;
  for (stream.incarnation = 1; stream.incarnation <= 2; ++stream.incarnation) {
    ASSERT_TRUE(writer.add_stream(stream));
  }
  ASSERT_TRUE(writer.finish());
  const std::string why = refusal({"convert", file("a.mcap"), file("a.log"), "--stream", "pose"});
  EXPECT_TRUE(contains(why, "'pose:0@pc1' was created again during the recording")) << why;
  EXPECT_TRUE(contains(why, "give a folder, in which each of the 2 gets a log")) << why;
  EXPECT_FALSE(contains(why, "choose")) << why;
  EXPECT_EQ(json({"convert", file("a.mcap"), file("logs")})["files"],
            (Json{file("logs/pose-0.log"), file("logs/pose-0_1.log")}));
}

// That of a log has none.
TEST_F(Convert, OfAStreamWithoutAHostBesideOneWithAHostNamesItsLogWithoutOne) {
  RecordingWriter writer = RecordingWriter::create(file("a.mcap")).value();
  RecordedStream stream;
  stream.id = {"pose", 0, ""};
  stream.type.payload_bytes = 8;
  ASSERT_TRUE(writer.add_stream(stream));
  stream.id.host = "pc1";
  ASSERT_TRUE(writer.add_stream(stream));
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(json({"convert", file("a.mcap"), file("logs")})["files"],
            (Json{file("logs/pose-0.log"), file("logs/pose-0@pc1.log")}));
}

// A ring has at least one byte per sample, so a recording says one where a log says none.
TEST_F(Convert, OfARecordingOfAStreamOfSizeZeroGivesItsLog) {
  RecordingWriter writer = RecordingWriter::create(file("a.mcap")).value();
  RecordedStream stream;
  stream.id = {"tick", 0, "pc1"};
  stream.type = {"ssm.empty", 1, 1, {}};
  stream.depth = 16;
  stream.cycle = 20ms;
  const auto tick = writer.add_stream(stream).value();
  const std::vector<std::byte> one(1);
  ASSERT_TRUE(writer.write(tick, {0, time_from_ns(1000'500'000'000), 5ns, 1}, 5ns, one));
  ASSERT_TRUE(writer.finish());
  output({"convert", file("a.mcap"), file("a.log")});
  const double time = 1000.5;
  std::string record(8, '\0');
  std::memcpy(record.data(), &time, 8);
  EXPECT_EQ(content_of(file("a.log")), "tick 0 0 16 0.020000 1000.500000 0\n" + record);
  output({"convert", file("a.log"), file("b.mcap")});
  EXPECT_EQ(Recording::open(file("b.mcap")).value().streams()[0].type, stream.type);
}

TEST_F(Convert, RefusesWhatWouldLoseSomething) {
  const std::string a = save("a.log", "a 0 8 10 0.1 1000 0\n" + records(3, 8, 1));
  const std::string b = save("b.log", "b 0 8 10 0.1 1000 0\n" + records(3, 8, 2));
  EXPECT_TRUE(contains(refusal({"convert", a, b}), "exists")) << "b is the output";
  EXPECT_TRUE(contains(refusal({"convert", a, b, file("c.log")}), "choose one with --stream"));
  EXPECT_TRUE(contains(refusal({"convert", a}), "OUT"));
  EXPECT_TRUE(contains(refusal({"convert", a, file("c.txt")}), "neither a file *.mcap"));
  EXPECT_TRUE(contains(refusal({"convert", a, "--stream", "z", file("c.mcap")}), "no stream"));
  save("c.mcap", "mine");
  EXPECT_TRUE(contains(refusal({"convert", a, b, file("c.mcap")}), "exists"));
  EXPECT_EQ(content_of(file("c.mcap")), "mine");
  fs::create_directory(file("both"));
  save("both/b-0.log", "mine");
  EXPECT_TRUE(contains(refusal({"convert", a, b, file("both")}), "b-0.log': the file exists"));
  EXPECT_FALSE(fs::exists(file("both/a-0.log"))) << "the next try would find it";
  EXPECT_EQ(content_of(file("both/b-0.log")), "mine");
  const std::string cut = save("cut.log", content_of(a) + "rest");
  const Finished warned = ctl({"convert", cut, file("cut.mcap")});
  EXPECT_EQ(warned.exit_status, 0);
  EXPECT_TRUE(contains(warned.err, "its last 4 bytes are left out")) << warned.err;

  RecordingWriter writer = RecordingWriter::create(file("blank.mcap")).value();
  RecordedStream stream;
  stream.id = {"two words", 0, "pc1"};
  stream.type.payload_bytes = 1;
  ASSERT_TRUE(writer.add_stream(stream));
  ASSERT_TRUE(writer.finish());
  EXPECT_TRUE(
      contains(refusal({"convert", file("blank.mcap"), file("blank")}), "'two words:0@pc1'"));
  EXPECT_FALSE(fs::exists(file("blank")));
}

TEST_F(Convert, RecompressesRecordings) {
  const std::string a = save("a.log", "a 0 1000 10 0.1 1000 0\n" + records(3, 1000, 1));
  output({"convert", a, file("a.mcap"), "--compression", "none"});
  output({"convert", file("a.mcap"), file("b.mcap"), "--compression", "zstd"});
  output({"convert", file("b.mcap"), file("b.log")});
  EXPECT_EQ(content_of(file("b.log")), content_of(a));
}

TEST_F(Convert, KeepsAllPropertiesWithTheirTimes) {
  RecordingWriter writer = RecordingWriter::create(file("a.mcap")).value();
  RecordedStream stream;
  stream.id = {"pose", 0, "pc1"};
  stream.type.payload_bytes = 8;
  stream.incarnation = 1;
  stream.property = {std::byte{1}};
  const auto pose = writer.add_stream(stream).value();
  stream.id.host = "pc2";
  stream.property.clear();
  const auto other = writer.add_stream(stream).value();
  const double x = 1.5;
  for (Tid tid = 0; tid < 10; ++tid) {
    if (tid == 5) {
      ASSERT_TRUE(writer.set_property(pose, {}));
    }
    for (const auto number : {pose, other}) {
      ASSERT_TRUE(writer.write(number, {tid, at_ns(1000 + tid), 5ns, 8}, 5ns,
                               std::as_bytes(std::span(&x, 1))));
    }
  }
  ASSERT_TRUE(writer.set_property(other, std::vector{std::byte{2}}));
  ASSERT_TRUE(writer.finish());
  output({"convert", file("a.mcap"), file("b.mcap")});
  const Recording recording = Recording::open(file("b.mcap")).value();
  ASSERT_EQ(recording.streams().size(), 2U);
  EXPECT_EQ(recording.streams()[0].property_times, (std::vector{Time::min(), at_ns(1005)}));
  EXPECT_EQ(recording.property(0, 0).value(), std::vector{std::byte{1}});
  EXPECT_EQ(recording.property(0, 1).value(), std::vector<std::byte>());
  EXPECT_EQ(recording.streams()[1].property_times, std::vector{at_ns(1010)});
  EXPECT_EQ(recording.property(1, 0).value(), std::vector{std::byte{2}});
}

// As a black box's two incidents are: what came between them was not to be kept.
TEST_F(Convert, KeepsWhatWasLost) {
  fs::create_directory(file("incidents"));
  RecordedStream stream;
  stream.id = {"pose", 0, "pc1"};
  stream.type.payload_bytes = 8;
  stream.incarnation = 1;
  const std::byte payload[8] = {};
  const auto write_incident = [&](const std::string& name, Tid first) {
    RecordingWriter writer = RecordingWriter::create(file("incidents/" + name)).value();
    const std::uint32_t number = writer.add_stream(stream).value();
    ASSERT_TRUE(writer.add_gap(number, first, 2));
    for (const Tid tid : {first + 2, first + 6}) {
      if (tid == first + 6) {
        ASSERT_TRUE(writer.add_gap(number, first + 3, 3));
      }
      ASSERT_TRUE(writer.write(number, {tid, time_from_ns(tid), 0ns, 8}, 0ns, payload));
    }
    ASSERT_TRUE(writer.add_gap(number, first + 7, 1));
    ASSERT_TRUE(writer.finish());
  };
  write_incident("a.mcap", 10);
  write_incident("b.mcap", 1000);
  output({"convert", file("incidents"), file("all.mcap")});
  const Recording recording = Recording::open(file("all.mcap")).value();
  EXPECT_EQ(recording.streams()[0].samples, 4U);
  EXPECT_EQ(recording.streams()[0].lost_samples, 12U);
  EXPECT_EQ(recording.streams()[0].gaps,
            (std::vector<RecordedGap>{{10, 2}, {13, 3}, {17, 1}, {1000, 2}, {1003, 3}, {1007, 1}}));
}

TEST_F(Convert, KeepsWhatTriggeredTheRecording) {
  RecordingWriter writer = RecordingWriter::create(file("a.mcap")).value();
  RecordedStream stream;
  stream.id = {"pose", 0, "pc1"};
  stream.type.payload_bytes = 8;
  ASSERT_TRUE(writer.add_stream(stream));
  ASSERT_TRUE(writer.add_trigger({"tilt", "too far", "pc1", at_ns(7)}));
  ASSERT_TRUE(writer.add_trigger({"stop", "", "pc2", at_ns(9)}));
  ASSERT_TRUE(writer.finish());
  output({"convert", file("a.mcap"), file("b.mcap")});
  const Recording recording = Recording::open(file("b.mcap")).value();
  ASSERT_EQ(recording.triggers().size(), 2U);
  EXPECT_EQ(recording.triggers()[0].name, "tilt");
  EXPECT_EQ(recording.triggers()[0].reason, "too far");
  EXPECT_EQ(recording.triggers()[1].host, "pc2");
  EXPECT_EQ(recording.triggers()[1].time, at_ns(9));
}

TEST_F(Convert, InfoAndPlayTakeLogs) {
  const auto record = [](double time, double x) {
    std::string bytes(16, '\0');
    std::memcpy(bytes.data(), &time, 8);
    std::memcpy(bytes.data() + 8, &x, 8);
    return bytes;
  };
  const std::string a = save("a.log", "left 0 8 10 0.1 1000 1\np" + record(1000.5, 1) +
                                          record(1000.75, 2) + record(1000.8125, 3));
  const std::string b = save("b.log", "right 2 8 10 0.1 1000 0\n" + record(1000.625, 4));
  const Json info = json({"info", a});
  EXPECT_EQ(info["streams"][0]["stream"], "left:0");
  EXPECT_EQ(info["streams"][0]["samples"], 3);
  EXPECT_EQ(info["streams"][0]["property_bytes"], 1);
  EXPECT_TRUE(contains(output({"info", b}), "right:2"));

  EXPECT_TRUE(contains(output({"play", a, b}), "4 samples of 2 streams played"));
  RawReader left = session_.open_raw_reader({"left", 0, ""}).value();
  RawReader right = session_.open_raw_reader({"right", 2, ""}).value();
  EXPECT_EQ(left.newest_tid(), 2) << "also the first record";
  EXPECT_EQ(left.depth(), 10U);
  SampleInfo sample;
  double x = 0;
  ASSERT_EQ(right.read_newest(std::as_writable_bytes(std::span(&x, 1)), sample), ReadStatus::ok);
  EXPECT_EQ(x, 4);
  EXPECT_EQ(to_ns(sample.time), 1000'625'000'000);
  EXPECT_EQ(session_.property({"left", 0, ""}).value().size(), 1U);
}

}  // namespace
}  // namespace dssm::test
