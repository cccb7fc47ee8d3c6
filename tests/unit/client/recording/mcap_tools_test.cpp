// SPDX-License-Identifier: Apache-2.0
//
// Readers of other authors read our files (mcap/read.cjs). They are npm packages: where these are
// not installed, nor node, the test is skipped.
#include <array>
#include <cstdio>
#include <cstdlib>
#include <dssm/describe.hpp>

#include "tests/unit/client/recording/recordings.hpp"

namespace dssm::test {
namespace {

struct Detection {
  std::uint8_t kind;
  float box[2];
  double score;
};
DSSM_DESCRIBE(Detection, kind, box, score)
struct Seen {
  bool isNew;
  Detection detections[2];
  std::int64_t frame;
  std::uint8_t last;
};
DSSM_DESCRIBE(Seen, isNew, detections, frame, last)

// The output of a command, with its errors; `status` as pclose() returns it.
std::string output_of(const std::string& command, int& status) {
  std::string output;
  std::FILE* pipe = ::popen((command + " 2>&1").c_str(), "re");
  if (pipe == nullptr) return output;
  std::array<char, 4096> buffer;
  while (const std::size_t bytes = std::fread(buffer.data(), 1, buffer.size(), pipe)) {
    output.append(buffer.data(), bytes);
  }
  status = ::pclose(pipe);
  return output;
}

using McapTools = RecordingTest;

TEST_F(McapTools, ReadWhatWasRecorded) {
  const char* source = std::getenv("DSSM_SOURCE_ROOT");
  ASSERT_NE(source, nullptr) << "run me through `meson test`";
  const std::string folder = std::string(source) + "/tests/unit/client/recording/mcap";
  const char* path_before = std::getenv("NODE_PATH");
  const std::string node = "NODE_PATH='" + folder +
                           "/node_modules:" + (path_before != nullptr ? path_before : "") +
                           "' node ";
  int status = 0;
  output_of(node +
                "-e 'require(\"@mcap/core\"); require(\"@mcap/support\"); "
                "require(\"@foxglove/rosmsg\"); require(\"@foxglove/rosmsg2-serialization\")'",
            status);
  if (status != 0) {
    GTEST_SKIP() << "needs node and npm packages: npm ci --prefix " << folder;
  }

  std::string expected, files;
  for (const Compression compression : {Compression::none, Compression::lz4, Compression::zstd}) {
    RecordingOptions options;
    options.compression = compression;
    options.chunk_bytes = 1500;
    const std::filesystem::path file =
        path(std::to_string(static_cast<int>(compression)) + ".mcap");
    RecordingWriter writer = RecordingWriter::create(file, options).value();
    RecordedStream seen;
    seen.id = {"seen", 1, "pc1"};
    seen.type = type_of<Seen>();
    seen.property = payload_of(1, 9);
    std::uint32_t described = writer.add_stream(seen).value();
    const std::uint32_t plain = writer.add_stream(plain_stream("plain", 30)).value();
    for (int i = 0; i < 60; ++i) {
      if (i == 30) {  // it restarts
        seen.incarnation = 2;
        described = writer.add_stream(seen).value();
        ASSERT_TRUE(writer.set_property(plain, payload_of(2, 9)));
        ASSERT_TRUE(writer.add_gap(plain, 1, 2));
      }
      Seen sample{};
      sample.isNew = i % 2 == 1;
      sample.detections[1] = {7, {0.5F, static_cast<float>(i)}, 2.5};
      sample.frame = -i;
      sample.last = 9;
      // Every tenth one is short, and times are not sorted.
      const std::size_t bytes = i % 10 == 9 ? 1 : sizeof sample;
      const std::int64_t time = i % 7 * 1000 + i;
      ASSERT_TRUE(writer.write(described, {(1LL << 32) + i, time_from_ns(time), Duration(7), bytes},
                               Duration(8), std::as_bytes(std::span(&sample, 1)).first(bytes)));
      if (bytes == 1) sample.frame = sample.last = 0, sample.detections[1] = {};
      const auto detection = [](const Detection& each) {
        char text[100];
        std::snprintf(text, sizeof text, R"({"kind":%d,"box":[%g,%g],"score":%g})", each.kind,
                      static_cast<double>(each.box[0]), static_cast<double>(each.box[1]),
                      each.score);
        return std::string(text);
      };
      expected += "seen:1@pc1 " + std::to_string(i) + " " + std::to_string(time) + R"( {"isnew":)" +
                  (sample.isNew ? "true" : "false") + R"(,"detections":[)" +
                  detection(sample.detections[0]) + "," + detection(sample.detections[1]) +
                  R"(],"frame":")" + std::to_string(sample.frame) + R"(n","last":)" +
                  std::to_string(sample.last) + "}\n";
      Recorded raw = sample_at(i, time, static_cast<std::size_t>(i) % 4);
      write(writer, plain, raw);
      expected += "plain@pc1 " + std::to_string(i) + " " + std::to_string(time) + R"( {"data":[)";
      for (std::size_t k = 0; k < raw.payload.size(); ++k) {
        expected += (k == 0 ? "" : ",") + std::to_string(std::to_integer<int>(raw.payload[k]));
      }
      expected += "]}\n";
    }
    ASSERT_TRUE(writer.add_trigger({"tilt", "a \"reason\"", "pc1", time_from_ns(7)}));
    expected += R"(trigger {"host":"pc1","name":"tilt","reason":"a \"reason\"","time_ns":"7"})"
                "\n";
    ASSERT_TRUE(writer.finish());
    if (compression == Compression::lz4) {  // the same with the end from a repair
      std::filesystem::resize_file(file, std::filesystem::file_size(file) - 100);
      ASSERT_TRUE(repair_recording(file));
    }
    files += " '" + file.string() + "'";
  }
  // A recording without samples.
  RecordingWriter empty = RecordingWriter::create(path("empty.mcap")).value();
  ASSERT_TRUE(empty.add_stream(plain_stream("plain", 30)));
  ASSERT_TRUE(empty.finish());
  files += " '" + path("empty.mcap").string() + "'";
  expected += "\n";

  const std::string output = output_of(node + folder + "/read.cjs" + files, status);
  EXPECT_EQ(status, 0);
  EXPECT_EQ(output, expected);
}

}  // namespace
}  // namespace dssm::test
