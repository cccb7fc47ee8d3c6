// SPDX-License-Identifier: Apache-2.0
//
// Readers of other authors read our files (mcap/read.cjs). They are npm packages: where these are
// not installed, nor node, the test is skipped.
#include <array>
#include <cstdio>
#include <cstdlib>
#include <dssm/describe.hpp>

#include "tests/support/sanitized.hpp"
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

// How often a recording is cut off. Sanitizers make each opening slow.
constexpr int kCuts = kIsSanitized ? 200 : 10'000;

constexpr Compression kCompressions[] = {Compression::none, Compression::lz4, Compression::zstd};

class McapTools : public RecordingTest {
 protected:
  // False, and skips the test, where something is missing.
  bool find_node() {
    const char* source = std::getenv("DSSM_SOURCE_ROOT");
    if (source == nullptr) {
      ADD_FAILURE() << "run me through `meson test`";
      return false;
    }
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
      [&] { GTEST_SKIP() << "needs node and npm packages: npm ci --prefix " << folder; }();
    }
    read_ = node + folder + "/read.cjs ";
    return status == 0;
  }

  struct Made {
    std::string lines;  // as read.cjs prints them
    std::vector<Recorded> samples;
  };

  // A stream of a described type, which restarts, and one of plain bytes, with a property, a gap
  // and a trigger, in some chunks.
  Made make(const std::filesystem::path& file, Compression compression) {
    RecordingOptions options;
    options.compression = compression;
    options.chunk_bytes = 1500;
    RecordingWriter writer = RecordingWriter::create(file, options).value();
    RecordedStream seen;
    seen.id = {"seen", 1, "pc1"};
    seen.type = type_of<Seen>();
    seen.property = payload_of(1, 9);
    std::uint32_t described = writer.add_stream(seen).value();
    const std::uint32_t plain = writer.add_stream(plain_stream("plain", 30)).value();
    Made made;
    for (int i = 0; i < 60; ++i) {
      if (i == 30) {  // it restarts
        seen.incarnation = 2;
        described = writer.add_stream(seen).value();
        EXPECT_TRUE(writer.set_property(plain, payload_of(2, 9)));
        EXPECT_TRUE(writer.add_gap(plain, 1, 2));
      }
      Seen sample{};
      sample.isNew = i % 2 == 1;
      sample.detections[1] = {7, {0.5F, static_cast<float>(i)}, 2.5};
      sample.frame = -i;
      sample.last = 9;
      // Every tenth one is short, and times are not sorted.
      const std::size_t bytes = i % 10 == 9 ? 1 : sizeof sample;
      const std::int64_t time = i % 7 * 1000 + i;
      const auto payload = std::as_bytes(std::span(&sample, 1)).first(bytes);
      Recorded recorded{{(1LL << 32) + i, time_from_ns(time), Duration(7), bytes},
                        Duration(8),
                        Bytes(payload.begin(), payload.end()),
                        described};
      write(writer, described, recorded);
      made.samples.push_back(recorded);
      if (bytes == 1) sample.frame = sample.last = 0, sample.detections[1] = {};
      const auto detection = [](const Detection& each) {
        char text[100];
        std::snprintf(text, sizeof text, R"({"kind":%d,"box":[%g,%g],"score":%g})", each.kind,
                      static_cast<double>(each.box[0]), static_cast<double>(each.box[1]),
                      each.score);
        return std::string(text);
      };
      made.lines += "seen:1@pc1 " + std::to_string(i) + " " + std::to_string(time) +
                    R"( {"isnew":)" + (sample.isNew ? "true" : "false") + R"(,"detections":[)" +
                    detection(sample.detections[0]) + "," + detection(sample.detections[1]) +
                    R"(],"frame":")" + std::to_string(sample.frame) + R"(n","last":)" +
                    std::to_string(sample.last) + "}\n";
      Recorded raw = sample_at(i, time, static_cast<std::size_t>(i) % 4);
      raw.stream = plain;
      write(writer, plain, raw);
      made.samples.push_back(raw);
      made.lines += "plain@pc1 " + std::to_string(i) + " " + std::to_string(time) + R"( {"data":[)";
      for (std::size_t k = 0; k < raw.payload.size(); ++k) {
        made.lines += (k == 0 ? "" : ",") + std::to_string(std::to_integer<int>(raw.payload[k]));
      }
      made.lines += "]}\n";
    }
    EXPECT_TRUE(writer.add_trigger({"tilt", "a \"reason\"", "pc1", time_from_ns(7)}));
    made.lines += R"(trigger {"host":"pc1","name":"tilt","reason":"a \"reason\"","time_ns":"7"})"
                  "\n";
    EXPECT_TRUE(writer.finish());
    return made;
  }

  std::filesystem::path file_of(Compression compression) const {
    return path(std::to_string(static_cast<int>(compression)) + ".mcap");
  }

  std::string read_;  // the command that runs read.cjs
};

TEST_F(McapTools, ReadWhatWasRecorded) {
  if (!find_node()) return;
  std::string expected, files;
  for (const Compression compression : kCompressions) {
    const std::filesystem::path file = file_of(compression);
    expected += make(file, compression).lines;
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

  int status = 0;
  const std::string output = output_of(read_ + files, status);
  EXPECT_EQ(status, 0);
  EXPECT_EQ(output, expected);
}

// And so does Recording.
TEST_F(McapTools, ReadAllWholeChunksOfAFileThatIsCutAtAnyByte) {
  if (!find_node()) return;
  const auto* const given = std::getenv("DSSM_TEST_SEED");
  const unsigned seed = given != nullptr ? static_cast<unsigned>(std::strtoul(given, nullptr, 10))
                                         : std::random_device{}();
  std::printf("DSSM_TEST_SEED=%u\n", seed);
  std::mt19937 random(seed);

  struct File {
    std::filesystem::path path;
    std::vector<Recorded> samples;
    std::size_t bytes;
    // By the byte at which a chunk ends, the number of samples up to there.
    std::map<std::size_t, std::size_t> samples_at{{0, 0}};
  };
  std::vector<File> files;
  std::string names;
  for (const Compression compression : kCompressions) {
    File file{file_of(compression), {}, 0};
    file.samples = make(file.path, compression).samples;
    const std::string content = content_of(file.path);
    file.bytes = content.size();
    // The samples of a chunk are counted by the message indexes that follow it.
    std::size_t end = 0, samples = 0, chunks = 0;
    for (const FoundRecord& record : records_of(content)) {
      chunks += record.op == recording::Op::chunk;
      if (record.op == recording::Op::chunk) end = record.end;
      if (record.op != recording::Op::message_index) continue;
      samples += (record.end - record.start - recording::kRecordHeadBytes - 6) / 16;
      file.samples_at[end] = samples;
    }
    EXPECT_GE(chunks, 5U);
    ASSERT_EQ(samples, file.samples.size());
    names += " '" + file.path.string() + "'";
    files.push_back(std::move(file));
  }

  // Descending lengths: the files are shortened from one to the next.
  std::vector<std::pair<std::size_t, std::size_t>> cuts;  // file, length
  for (int i = 0; i < kCuts; ++i) {
    const std::size_t file = random() % files.size();
    cuts.emplace_back(file, random() % files[file].bytes);
  }
  std::sort(cuts.rbegin(), cuts.rend());
  std::string input, expected;
  for (const auto& [file, length] : cuts) {
    input += std::to_string(file) + " " + std::to_string(length) + "\n";
    expected +=
        std::to_string(std::prev(files[file].samples_at.upper_bound(length))->second) + "\n";
  }
  write_file(path("cuts"), input);
  int status = 0;
  const std::string output =
      output_of(read_ + "--cut" + names + " < '" + path("cuts").string() + "'", status);
  EXPECT_EQ(status, 0) << output;
  EXPECT_TRUE(output == expected) << "@mcap/core read other numbers of messages";

  for (const auto& [index, length] : cuts) {
    const File& file = files[index];
    SCOPED_TRACE(file.path.string() + " cut to " + std::to_string(length));
    std::filesystem::resize_file(file.path, length);
    const Recording recording = open_recording(file.path);
    EXPECT_FALSE(recording.warnings().empty());
    const std::vector<Recorded> samples = all_of(recording);
    ASSERT_TRUE(begins_with(file.samples, samples));
    ASSERT_EQ(samples.size(), std::prev(file.samples_at.upper_bound(length))->second);
  }
}

}  // namespace
}  // namespace dssm::test
