// SPDX-License-Identifier: Apache-2.0
//
// Files that are cut, damaged, unfinished, hostile, or of other programs; full disks and kills.
#include <sys/resource.h>
#include <sys/wait.h>

#include <csignal>
#include <cstring>

#include "client/recording/records.hpp"
#include "tests/support/await.hpp"
#include "tests/support/sanitized.hpp"
#include "tests/unit/client/recording/recordings.hpp"

namespace dssm::test {
namespace {

using recording::Buffer;
using recording::Encoder;
using recording::kRecordHeadBytes;
using recording::Op;

class DamagedFiles : public RecordingTest {
 protected:
  // Two streams in some chunks, with a property and gaps; returns what was written.
  std::vector<Recorded> make(const std::filesystem::path& file, Compression compression,
                             int samples = 60) {
    RecordingOptions options;
    options.compression = compression;
    options.chunk_bytes = 700;
    RecordingWriter writer = RecordingWriter::create(file, options).value();
    const std::uint32_t streams[] = {writer.add_stream(plain_stream("a", 24)).value(),
                                     writer.add_stream(plain_stream("b", 24)).value()};
    std::vector<Recorded> written;
    for (int i = 0; i < samples; ++i) {
      Recorded sample = sample_at(i / 2, i * 10);
      sample.stream = streams[i % 2];
      write(writer, streams[i % 2], sample);
      written.push_back(sample);
      if (i == samples / 2) {
        EXPECT_TRUE(writer.set_property(streams[0], payload_of(1, 10)));
        EXPECT_TRUE(writer.add_gap(streams[1], 1000, 3));
      }
    }
    EXPECT_TRUE(writer.finish());
    return written;
  }
};

// Sanitizers make each opening slow.
constexpr std::size_t kCutStep = kIsSanitized ? 37 : 1;

TEST_F(DamagedFiles, CutAtAnyByteLoseOnlyTheOpenChunk) {
  for (const Compression compression : {Compression::none, Compression::lz4, Compression::zstd}) {
    const std::vector<Recorded> written = make(path("whole.mcap"), compression);
    const std::string whole = content_of(path("whole.mcap"));
    std::filesystem::remove(path("whole.mcap"));
    // The number of samples in the chunks that end at a byte.
    std::map<std::size_t, std::size_t> chunks{{0, 0}};
    for (const FoundRecord& record : records_of(whole)) {
      if (record.op == Op::data_end) break;
      if (record.op != Op::chunk) continue;
      write_file(path("some.mcap"), std::string_view(whole).substr(0, record.end));
      chunks[record.end] = all_of(open_recording(path("some.mcap"))).size();
    }
    ASSERT_GT(chunks.size(), 4U);
    EXPECT_EQ(chunks.rbegin()->second, written.size());

    for (std::size_t length = 0; length < whole.size(); length += kCutStep) {
      SCOPED_TRACE(length);
      write_file(path("cut.mcap"), std::string_view(whole).substr(0, length));
      const Recording recording = open_recording(path("cut.mcap"));
      EXPECT_FALSE(recording.warnings().empty());
      const std::vector<Recorded> samples = all_of(recording);
      ASSERT_TRUE(begins_with(written, samples));
      ASSERT_EQ(samples.size(), std::prev(chunks.upper_bound(length))->second);
      if (length / kCutStep % 97 != 0) continue;  // each syncs

      const Result<RecordingRepair> repaired = repair_recording(path("cut.mcap"));
      if (!repaired) {  // there is nothing in it
        EXPECT_TRUE(recording.streams().empty());
        continue;
      }
      EXPECT_FALSE(repaired->was_whole);
      EXPECT_EQ(repaired->samples, samples.size());
      const Recording again = open_recording(path("cut.mcap"));
      EXPECT_EQ(again.warnings(), std::vector<std::string>());
      EXPECT_EQ(all_of(again), samples);
      EXPECT_EQ(again.streams().size(), recording.streams().size());
      // With an index of each message, which other tools need.
      std::size_t indexed = 0, in_chunks = 0;
      const std::string content = content_of(path("cut.mcap"));
      for (const FoundRecord& record : records_of(content)) {
        in_chunks += record.op == Op::chunk;
        if (record.op == Op::message_index) indexed += (record.end - record.start - 15) / 16;
      }
      EXPECT_EQ(indexed, samples.size());
      EXPECT_TRUE(repair_recording(path("cut.mcap"))->was_whole);
    }
  }
}

TEST_F(DamagedFiles, SkipADamagedChunkAndCountItsSamplesAsLost) {
  const std::vector<Recorded> written = make(path("a.mcap"), Compression::lz4);
  std::string content = content_of(path("a.mcap"));
  std::size_t chunk = 0;
  for (const FoundRecord& record : records_of(content)) {
    if (record.op == Op::chunk && ++chunk == 2) content[record.end - 20] ^= 1;
  }
  write_file(path("a.mcap"), content);
  const Recording recording = open_recording(path("a.mcap"));
  EXPECT_EQ(recording.warnings().size(), 0U);  // by its index
  const std::vector<Recorded> samples = all_of(recording);
  ASSERT_EQ(recording.warnings().size(), 1U);
  EXPECT_NE(recording.warnings()[0].find("a.mcap"), std::string::npos);
  ASSERT_GT(samples.size(), 30U);
  ASSERT_LT(samples.size(), written.size());
  for (const Recorded& sample : samples) {
    EXPECT_NE(std::find(written.begin(), written.end(), sample), written.end());
  }
  RecordedRawReader reader = recording.open_raw_reader({"a", 0, ""}).value();
  Bytes payload(24);
  SampleInfo info;
  Tid before_gap = kNoTid, after_gap = kNoTid;
  while (reader.read_next(payload, info) == ReadStatus::ok) {
    EXPECT_EQ(payload, payload_of(info.tid, 24));
    if (reader.lost_samples() > 0 && after_gap == kNoTid) after_gap = info.tid;
    if (reader.lost_samples() == 0) before_gap = info.tid;
  }
  ASSERT_NE(after_gap, kNoTid);
  EXPECT_EQ(reader.lost_samples(), static_cast<std::uint64_t>(after_gap - before_gap - 1));
  EXPECT_EQ(reader.read_tid(before_gap + 1, payload, info), ReadStatus::lost);
  RecordedRawReader by_time = recording.open_raw_reader({"a", 0, ""}).value();
  ASSERT_EQ(by_time.read_at(time_from_ns((before_gap + 1) * 20), payload, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, before_gap);
}

TEST_F(DamagedFiles, NeverReturnAWrongSample) {
  const std::vector<Recorded> written = make(path("whole.mcap"), Compression::zstd);
  const std::string whole = content_of(path("whole.mcap"));
  std::mt19937 random(20);
  for (int i = 0; i < (test::kIsSanitized ? 600 : 3000); ++i) {
    std::string content = whole;
    for (std::size_t n = random() % 4 + 1; n > 0; --n) {
      content[random() % content.size()] = static_cast<char>(random());
    }
    if (i % 2 == 0) content.resize(content.size() - random() % 200);  // it has to be read whole
    write_file(path("damaged.mcap"), content);
    const Result<Recording> recording = Recording::open(path("damaged.mcap"));
    if (!recording) continue;
    for (const Recorded& sample : all_of(*recording)) {
      const std::string& name = recording->streams()[sample.stream].id.name;
      if (name != "a" && name != "b") continue;  // a damaged description
      if (recording->streams()[sample.stream].type.payload_bytes != 24) continue;
      ASSERT_EQ(sample.payload, payload_of(sample.info.tid, 24));
    }
  }
}

TEST_F(DamagedFiles, RefuseAChunkThatClaimsTooMuch) {
  const std::vector<Recorded> written = make(path("a.mcap"), Compression::zstd);
  std::string content = content_of(path("a.mcap"));
  for (const FoundRecord& record : records_of(content)) {
    if (record.op != Op::chunk) continue;
    const std::uint64_t claimed = 1ULL << 40;
    std::memcpy(content.data() + record.start + kRecordHeadBytes + 16, &claimed, sizeof claimed);
    break;
  }
  write_file(path("a.mcap"), std::string_view(content).substr(0, content.size() - 1));
  const Recording recording = open_recording(path("a.mcap"));
  EXPECT_LT(all_of(recording).size(), written.size());
  ASSERT_FALSE(recording.warnings().empty());
  EXPECT_NE(recording.warnings()[0].find("claims"), std::string::npos) << recording.warnings()[0];
}

// A message that says of its sample that it is longer than what it has.
TEST_F(DamagedFiles, RefuseASampleThatIsLongerThanItsMessage) {
  RecordingOptions options;
  options.compression = Compression::none;
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  const std::uint32_t stream = writer.add_stream(plain_stream("a", 64)).value();
  Recorded sample = sample_at(0, 10, 64);
  sample.info.clock_error = sample.clock_error = kUnknownClockError;
  // After a length of 1: the flag that a length follows, and 64.
  sample.payload[1] = std::byte{8};
  sample.payload[2] = std::byte{64};
  write(writer, stream, sample);
  ASSERT_TRUE(writer.finish());
  std::string content = content_of(path("a.mcap"));
  for (const FoundRecord& record : records_of(content)) {
    if (record.op != Op::chunk) continue;
    content.replace(record.start + kRecordHeadBytes + 24, 4, 4, '\0');  // its CRC: none
    const std::string payload(reinterpret_cast<const char*>(sample.payload.data()), 64);
    const std::size_t at = content.find(payload, record.start);
    ASSERT_LT(at, record.end);
    content[at - 4] = 1;
  }
  write_file(path("a.mcap"), content);
  const Recording recording = open_recording(path("a.mcap"));
  EXPECT_TRUE(all_of(recording).empty());
  EXPECT_EQ(recording.warnings().size(), 1U);
}

TEST_F(DamagedFiles, AreNotRepairedWhileTheyAreWritten) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  EXPECT_EQ(repair_recording(path("a.mcap")).error().code, Errc::unavailable);
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(repair_recording(path("missing.mcap")).error().code, Errc::not_found);
}

TEST_F(DamagedFiles, AreWholeAfterTheDiskWasFull) {
  rlimit before{};
  ASSERT_EQ(::getrlimit(RLIMIT_FSIZE, &before), 0);
  for (const rlim_t limit : {3000U, 20000U, 20100U, 20500U, 50000U}) {
    SCOPED_TRACE(limit);
    const std::filesystem::path file = path(std::to_string(limit) + ".mcap");
    RecordingOptions options;
    options.compression = Compression::none;
    options.chunk_bytes = 700;
    RecordingWriter writer = RecordingWriter::create(file, options).value();
    const std::uint32_t stream = writer.add_stream(plain_stream("a", 24)).value();
    const rlimit narrow{limit, before.rlim_max};
    ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &narrow), 0);
    std::vector<Recorded> written;
    Result<void> result;
    for (Tid tid = 0; result; ++tid) {
      const Recorded sample = sample_at(tid, tid);
      result = writer.write(stream, sample.info, sample.clock_error, sample.payload);
      written.push_back(sample);
    }
    const Result<void> finished = writer.finish();
    ASSERT_EQ(::setrlimit(RLIMIT_FSIZE, &before), 0);
    EXPECT_EQ(result.error().code, Errc::no_memory);
    for (const char* part : {file.c_str(), "File too large", "whole file", "Free space"}) {
      EXPECT_NE(result.error().message.find(part), std::string::npos) << result.error().message;
    }
    EXPECT_EQ(finished.error().message, result.error().message);
    EXPECT_LE(std::filesystem::file_size(file), limit);
    const Recording recording = open_recording(file);
    EXPECT_EQ(recording.warnings(), std::vector<std::string>());
    const std::vector<Recorded> samples = all_of(recording);
    EXPECT_TRUE(begins_with(written, samples));
    EXPECT_EQ(writer.progress().samples, samples.size());
    EXPECT_EQ(writer.progress().payload_bytes, 24 * samples.size());
    if (limit > 3000) {
      EXPECT_GT(samples.size(), 90U);
    }
  }
}

TEST_F(DamagedFiles, HoldWhatWasInThemWhenTheirWriterWasKilled) {
  int ready[2];
  ASSERT_EQ(::pipe(ready), 0);
  const pid_t child = ::fork();
  if (child == 0) {
    RecordingOptions options;
    options.chunk_age = std::chrono::milliseconds(1);
    RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
    const std::uint32_t stream = writer.add_stream(plain_stream("a", 24)).value();
    for (Tid tid = 0; tid < 1000; ++tid) write(writer, stream, sample_at(tid, tid));
    await([&] { return writer.progress().waiting_bytes == 0; });
    (void)!::write(ready[1], "", 1);
    for (Tid tid = 1000;; ++tid) write(writer, stream, sample_at(tid, tid));
  }
  char byte;
  ASSERT_EQ(::read(ready[0], &byte, 1), 1);
  ::kill(child, SIGKILL);
  ASSERT_EQ(::waitpid(child, nullptr, 0), child);
  ::close(ready[0]);
  ::close(ready[1]);
  const std::vector<Recorded> samples = all_of(open_recording(path("a.mcap")));
  EXPECT_GE(samples.size(), 1000U);
  for (std::size_t i = 0; i < samples.size(); ++i) {
    ASSERT_EQ(samples[i], sample_at(static_cast<Tid>(i), static_cast<std::int64_t>(i)));
  }
  const Result<RecordingRepair> repaired = repair_recording(path("a.mcap"));
  ASSERT_TRUE(repaired) << repaired.error().message;
  EXPECT_EQ(repaired->samples, samples.size());
  EXPECT_EQ(all_of(open_recording(path("a.mcap"))), samples);
}

// --- of other programs

void add_message(Buffer& out, std::uint16_t channel, std::uint64_t time, std::string_view data) {
  Encoder record(out);
  record.begin(Op::message).number(channel).number(std::uint32_t{77}).number(time).number(time);
  out.append(data);
  record.end();
}

TEST_F(DamagedFiles, OfOtherProgramsAreReadAsFarAsTheirTopicsAreStreams) {
  Buffer file;
  file.append(std::as_bytes(std::span(recording::kMagic)));
  recording::encode_header(file, "ros2", "another program");
  recording::encode(file, recording::Channel{3, 0, "/scan", "json", {}});
  recording::encode(
      file, recording::Channel{4, 0, "/a/topic/that/is/longer/than/names/of/streams", "json", {}});
  add_message(file, 3, 10, "one");  // outside of chunks
  add_message(file, 4, 11, "of no stream");
  add_message(file, 3, 12, "two");
  Buffer records;  // in a chunk, with a channel of its own
  recording::encode(records, recording::Channel{5, 0, "imu:2@pc9", "json", {}});
  add_message(records, 5, 5, "three");
  add_message(records, 3, 7, "four and more");
  recording::ChunkHead head;
  head.uncompressed_bytes = head.compressed_bytes = records.size();
  recording::encode(file, head);
  file.append(records.span());
  const std::string content(reinterpret_cast<const char*>(file.data()), file.size());

  write_file(path("a.mcap"), content);
  const Recording recording = open_recording(path("a.mcap"));
  const auto warnings = recording.warnings();
  EXPECT_TRUE(std::ranges::any_of(warnings, [](const std::string& warning) {
    return warning.find("channel 4") != std::string::npos;
  }));
  ASSERT_EQ(recording.streams().size(), 2U);
  EXPECT_EQ(recording.streams()[0].id.str(), "/scan:0");
  EXPECT_EQ(recording.streams()[1].id.str(), "imu:2@pc9");
  EXPECT_EQ(recording.streams()[0].type.payload_bytes, 13U);
  RecordedRawReader reader = recording.open_raw_reader({"/scan", 0, ""}).value();
  Bytes payload(13);
  SampleInfo info;
  std::string read;
  while (reader.read_next(payload, info) == ReadStatus::ok) {
    read += std::to_string(info.tid) + "=";
    read.append(reinterpret_cast<const char*>(payload.data()), info.payload_bytes);
    read += " ";
  }
  EXPECT_EQ(read, "0=one 1=two 2=four and more ");
  ASSERT_EQ(reader.read_at(time_from_ns(11), payload, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 2);  // times run backwards: the newest one with a time before
  EXPECT_EQ(reader.clock_error(info), kUnknownClockError);
  // Its writer may still be at work, and not all of its channels are known here.
  const auto repaired = repair_recording(path("a.mcap"));
  ASSERT_FALSE(repaired);
  EXPECT_EQ(repaired.error().code, Errc::invalid_argument);
  EXPECT_EQ(content_of(path("a.mcap")), content);
}

}  // namespace
}  // namespace dssm::test
