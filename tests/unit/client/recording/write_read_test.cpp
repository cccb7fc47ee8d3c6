// SPDX-License-Identifier: Apache-2.0
//
// What was recorded is read again: all of it, by tid, by time and in order.
#include <dssm/describe.hpp>
#include <dssm/interpolate.hpp>

#include "tests/support/await.hpp"
#include "tests/unit/client/recording/recordings.hpp"

namespace dssm::test {
namespace {

struct Wheel {
  float speed;
  std::int16_t ticks[3];
};
DSSM_DESCRIBE(Wheel, speed, ticks)
struct Odometry {
  std::uint8_t state;
  double x;
  Wheel wheels[2];
};
DSSM_DESCRIBE(Odometry, state, x, wheels)

RecordedStream odometry_stream() {
  RecordedStream stream;
  stream.id = {"odometry", 2, "pc1"};
  stream.type = type_of<Odometry>();
  stream.depth = 100;
  stream.cycle = std::chrono::milliseconds(5);
  stream.incarnation = 0xfedcba9876543210;
  stream.property = payload_of(3, 30);
  return stream;
}

class WriteRead : public RecordingTest, public testing::WithParamInterface<Compression> {};

TEST_P(WriteRead, KeepsAllThatStreamsAndSamplesHave) {
  RecordingOptions options;
  options.compression = GetParam();
  options.chunk_bytes = 1000;
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  const RecordedStream described = odometry_stream(), plain = plain_stream("plain", 64),
                       empty = plain_stream("empty", 8);
  ASSERT_EQ(writer.add_stream(described).value(), 0U);
  ASSERT_EQ(writer.add_stream(plain).value(), 1U);
  ASSERT_EQ(writer.add_stream(empty).value(), 2U);
  ASSERT_EQ(writer.add_stream(plain).value(), 1U);  // again

  // Times that are not sorted, at 0 and before; tids beyond 32 bits, with gaps; all lengths; all
  // kinds of clock errors.
  std::vector<Recorded> written;
  const std::int64_t times[] = {5, 0, -1, INT64_MIN, INT64_MAX, 1700000000000000000, 7, 7, -5, 1};
  const Duration errors[] = {Duration(0), Duration(1), Duration(123456789), kUnknownClockError,
                             kForeignClockError};
  Tid tids[2] = {0, 4294967290};
  for (int i = 0; i < 300; ++i) {
    Recorded sample = sample_at(0, times[i % 10]);
    sample.stream = static_cast<std::size_t>(i % 3 == 0);
    Tid& tid = tids[sample.stream];
    const std::size_t most = sample.stream == 0 ? sizeof(Odometry) : 64;
    sample.payload = payload_of(
        tid, sample.stream == 0 && i % 4 != 0 ? most : static_cast<std::size_t>(i) % (most + 1));
    sample.info.tid = tid;
    sample.info.clock_error = errors[i % 5];
    sample.info.payload_bytes = sample.payload.size();
    sample.clock_error = errors[(i + 1) % 5];
    tid += 1 + i % 2;
    write(writer, static_cast<std::uint32_t>(sample.stream), sample);
    written.push_back(sample);
  }
  // A sample that is larger than a chunk, and the greatest tid.
  const RecordedStream large = plain_stream("large", 100000);
  Recorded sample = sample_at(INT64_MAX, 9, 99999);
  sample.stream = writer.add_stream(large).value();
  write(writer, 3, sample);
  written.push_back(sample);
  ASSERT_TRUE(writer.add_gap(1, 7, 2));
  ASSERT_TRUE(writer.add_gap(1, 9, 3));
  ASSERT_TRUE(writer.add_gap(2, 0, 1ULL << 40));
  const RecordedTrigger late{"b", "", "", time_from_ns(-3)},
      early{"a", "x\n\"y\"", "pc2", Time::min()};
  ASSERT_TRUE(writer.add_trigger(late));
  ASSERT_TRUE(writer.add_trigger(early));
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(writer.add_trigger(late).error().code, Errc::invalid_argument);
  ASSERT_TRUE(writer.finish());  // changes nothing
  EXPECT_EQ(writer.progress().samples, 301U);
  EXPECT_EQ(writer.progress().waiting_bytes, 0U);
  EXPECT_EQ(writer.progress().lost_samples, 5U + (1ULL << 40));
  EXPECT_EQ(writer.progress().file_bytes, std::filesystem::file_size(path("a.mcap")));

  const Recording recording = open_recording(path("a.mcap"));
  EXPECT_EQ(recording.warnings(), std::vector<std::string>());
  EXPECT_EQ(all_of(recording), written);
  EXPECT_EQ(recording.triggers(), (std::vector{early, late}));
  const RecordedStream added[] = {described, plain, empty, large};
  ASSERT_EQ(recording.streams().size(), 4U);
  for (std::size_t i = 0; i < 4; ++i) {
    const RecordedStreamInfo& stream = recording.streams()[i];
    EXPECT_EQ(stream.id, added[i].id);
    EXPECT_EQ(stream.type, added[i].type);
    EXPECT_EQ(stream.depth, added[i].depth);
    EXPECT_EQ(stream.cycle, added[i].cycle);
    EXPECT_EQ(stream.incarnation, added[i].incarnation);
    EXPECT_EQ(stream.property, added[i].property);
    std::uint64_t samples = 0, bytes = 0;
    for (const Recorded& each : written) {
      if (each.stream != i) continue;
      ++samples;
      bytes += each.payload.size();
    }
    EXPECT_EQ(stream.samples, samples);
    EXPECT_EQ(stream.payload_bytes, bytes);
  }
  EXPECT_EQ(recording.streams()[0].first_time, Time::min());
  EXPECT_EQ(recording.streams()[0].last_time, Time::max());
  EXPECT_EQ(recording.streams()[1].lost_samples, 5U);
  EXPECT_EQ(recording.streams()[1].gaps, (std::vector<RecordedGap>{{7, 5}}));
  EXPECT_EQ(recording.streams()[2].lost_samples, 1ULL << 40);
  EXPECT_EQ(recording.streams()[2].gaps, (std::vector<RecordedGap>{{0, 1ULL << 40}}));
  EXPECT_EQ(recording.streams()[3].last_tid, INT64_MAX);

  RecordedRawReader reader = recording.open_raw_reader({"plain", 0, ""}).value();
  Bytes payload(64);
  for (const Recorded& each : written) {
    if (each.stream != 1) continue;
    SampleInfo info;
    ASSERT_EQ(reader.read_tid(each.info.tid, payload, info), ReadStatus::ok);
    EXPECT_EQ(info.time, each.info.time);
    EXPECT_EQ(reader.clock_error(info), each.clock_error);
    EXPECT_EQ(reader.cursor(), info.tid);
  }
}

std::string compression_name(const testing::TestParamInfo<Compression>& about) {
  constexpr const char* kNames[] = {"none", "lz4", "zstd"};
  return kNames[static_cast<std::size_t>(about.param)];
}
INSTANTIATE_TEST_SUITE_P(Compressions, WriteRead,
                         testing::Values(Compression::none, Compression::lz4, Compression::zstd),
                         compression_name);

using RecordingFiles = RecordingTest;

TEST_F(RecordingFiles, ReadsTypedSamplesInBothForms) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  const std::uint32_t stream = writer.add_stream(odometry_stream()).value();
  for (int i = 0; i < 10; ++i) {
    Odometry odometry{};
    odometry.x = i;
    const std::size_t bytes = i == 9 ? 8 : sizeof odometry;  // a short one: x is missing
    ASSERT_TRUE(writer.write(stream, {i, time_from_ns(i * 10), Duration(1), bytes}, Duration(2),
                             std::as_bytes(std::span(&odometry, 1)).first(bytes)));
  }
  ASSERT_TRUE(writer.finish());

  const Recording recording = open_recording(path("a.mcap"));
  RecordedReader<Odometry> reader = recording.open_reader<Odometry>("odometry:2").value();
  ASSERT_EQ(reader.read_next()->value.x, 0);  // begins at the first one
  EXPECT_EQ(reader.read_next()->value.x, 1);
  EXPECT_EQ(reader.read_at(time_from_ns(55))->value.x, 5);
  EXPECT_EQ(reader.read_at(time_from_ns(55), Duration(4)).status(), ReadStatus::stale);
  EXPECT_EQ(reader.read_at_or_after(time_from_ns(55))->value.x, 6);
  EXPECT_EQ(reader.read_nearest(time_from_ns(56))->value.x, 6);
  EXPECT_EQ(reader.read_tid(7)->value.x, 7);
  EXPECT_EQ(reader.read_previous()->value.x, 6);
  const auto around = reader.read_neighbours(time_from_ns(55));
  ASSERT_TRUE(around);
  EXPECT_EQ(interpolate(around->before, around->after, time_from_ns(55))->value.x, 5.5);
  Odometry odometry;
  odometry.x = 77;
  SampleInfo info;
  ASSERT_EQ(reader.read_newest(odometry, info), ReadStatus::ok);
  EXPECT_EQ(odometry.x, 0);  // what it does not have is 0
  EXPECT_EQ(info.tid, 9);
  EXPECT_EQ(reader.property().value(), odometry_stream().property);

  Odometry other;
  RecordedReader<Odometry> second = recording.open_reader<Odometry>("odometry:2@pc1").value();
  RecordedJointSample joint[] = {reader.joint_sample(odometry), second.joint_sample(other)};
  EXPECT_EQ(read_joint_at(time_from_ns(33), joint).status, ReadStatus::ok);
  EXPECT_EQ(odometry.x + other.x, 6);
  EXPECT_EQ(read_joint_at(time_from_ns(33), joint, Duration(1)).status,
            ReadStatus::clock_out_of_bounds);

  EXPECT_EQ(recording.open_reader<int>("odometry:2").error().code, Errc::type_mismatch);
  const Error missing = recording.open_raw_reader({"odometer", 0, ""}).error();
  EXPECT_EQ(missing.code, Errc::not_found);
  EXPECT_NE(missing.message.find("'odometry:2@pc1'"), std::string::npos) << missing.message;
}

TEST_F(RecordingFiles, ReadsIncarnationsInBothDirections) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  for (const std::uint64_t incarnation : {7, 8, 9}) {
    const auto stream = writer.add_stream(plain_stream("s", 24, incarnation)).value();
    if (incarnation == 8) continue;  // one without samples
    for (Tid tid = 0; tid < 3; ++tid) {
      write(writer, stream, sample_at(tid, static_cast<std::int64_t>(incarnation) * 100 + tid));
    }
  }
  ASSERT_TRUE(writer.finish());
  const Recording recording = open_recording(path("a.mcap"));
  EXPECT_EQ(recording.streams().size(), 3U);
  RecordedRawReader reader = recording.open_raw_reader({"s", 0, ""}).value();
  Bytes payload(24);
  SampleInfo info;
  std::vector<std::string> seen;
  const auto note = [&](ReadStatus status) {
    seen.push_back(status == ReadStatus::ok
                       ? std::to_string(reader.incarnation()) + ":" + std::to_string(info.tid)
                       : std::string(name_of(status)));
  };
  for (int i = 0; i < 9; ++i) note(reader.read_next(payload, info));
  EXPECT_EQ(seen, (std::vector<std::string>{"7:0", "7:1", "7:2", "restarted", "restarted", "9:0",
                                            "9:1", "9:2", "not_yet"}));
  seen.clear();
  for (int i = 0; i < 7; ++i) note(reader.read_previous(payload, info));
  EXPECT_EQ(seen,
            (std::vector<std::string>{"9:1", "9:0", "restarted", "7:2", "7:1", "7:0", "too_old"}));
  EXPECT_EQ(reader.restarts(), 3U);
  seen.clear();
  note(reader.read_at(time_from_ns(901), payload, info));
  note(reader.read_at(time_from_ns(901), payload, info));
  note(reader.read_at(time_from_ns(850), payload, info));
  note(reader.read_at(time_from_ns(850), payload, info));
  note(reader.read_at_or_after(time_from_ns(850), payload, info));
  note(reader.read_at_or_after(time_from_ns(850), payload, info));
  note(reader.read_at(time_from_ns(699), payload, info));
  EXPECT_EQ(seen, (std::vector<std::string>{"restarted", "9:1", "restarted", "7:2", "restarted",
                                            "9:0", "too_old"}));
}

RecordingOptions small_files() {
  RecordingOptions options;
  options.compression = Compression::none;
  options.chunk_bytes = 500;
  options.max_file_bytes = 4000;
  return options;
}

TEST_F(RecordingFiles, SplitsBySizeAndOpensTheFolderAsOne) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), small_files()).value();
  const auto stream = writer.add_stream(plain_stream("s", 24)).value();
  const auto restarted = writer.add_stream(plain_stream("s", 24, 2)).value();
  ASSERT_TRUE(writer.set_property(stream, payload_of(1, 5)));
  ASSERT_TRUE(writer.set_property(restarted, payload_of(2, 6)));
  std::vector<Recorded> written;
  for (int i = 0; i < 300; ++i) {
    const auto to = i < 150 ? stream : restarted;
    Recorded sample = sample_at(i, i);
    sample.stream = to;
    write(writer, to, sample);
    written.push_back(sample);
  }
  ASSERT_TRUE(writer.add_gap(stream, 1000, 9));  // of a stream that is not in the last file yet
  ASSERT_TRUE(writer.finish());
  EXPECT_GT(writer.progress().files, 3U);
  ASSERT_TRUE(std::filesystem::exists(path("a_1.mcap")));

  const Recording recording = open_recording(folder_);
  EXPECT_EQ(recording.files().size(), writer.progress().files);
  EXPECT_EQ(recording.files()[0], path("a.mcap"));
  EXPECT_EQ(recording.files()[1], path("a_1.mcap"));
  EXPECT_EQ(all_of(recording), written);
  ASSERT_EQ(recording.streams().size(), 2U);
  EXPECT_EQ(recording.streams()[0].property, payload_of(1, 5));
  EXPECT_EQ(recording.streams()[0].lost_samples, 9U);
  RecordedRawReader reader = recording.open_raw_reader({"s", 0, ""}).value();
  Bytes payload(24);
  SampleInfo info;
  EXPECT_EQ(reader.read_tid(149, payload, info), ReadStatus::ok);

  // Each file is a recording of its own, with the streams and their properties.
  const Recording second = open_recording(path("a_2.mcap"));
  ASSERT_FALSE(second.streams().empty());
  EXPECT_EQ(second.streams().back().property, payload_of(2, 6));

  // Two recordings of the same samples are not one.
  std::filesystem::copy_file(path("a_1.mcap"), path("b.mcap"));
  EXPECT_EQ(Recording::open(folder_).error().code, Errc::conflict);
}

TEST_F(RecordingFiles, AreLittleLargerThanTheirLimit) {
  RecordingOptions options;  // whose chunks are much larger
  options.compression = Compression::none;
  options.max_file_bytes = 20'000;
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  const auto stream = writer.add_stream(plain_stream("s", 24)).value();
  for (int i = 0; i < 3000; ++i) write(writer, stream, sample_at(i, i));
  ASSERT_TRUE(writer.finish());
  EXPECT_GT(writer.progress().files, 3U);
  for (const auto& file : std::filesystem::directory_iterator(folder_)) {
    EXPECT_LT(file.file_size(), 30'000U) << file.path();
  }
}

TEST_F(RecordingFiles, HaveADescriptionFromTheNextFileOn) {
  RecordingOptions options;
  options.chunk_bytes = 500;
  options.queue_bytes = 1000;
  options.max_file_bytes = 4000;
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  RecordedStream about = plain_stream("s", 24);
  const auto stream = writer.add_stream(about).value();
  std::vector<Recorded> written;
  const auto write_until = [&](std::uint32_t files) {
    while (writer.progress().files < files) {
      const auto tid = static_cast<Tid>(written.size());
      written.push_back(sample_at(tid, tid, tid % 5 == 0 ? 20 : 24));  // also short ones
      write(writer, stream, written.back());
    }
  };
  write_until(3);
  about.type = {"Point", 24, 8, {{"x", Scalar::float64, 0, 1}, {"y", Scalar::float64, 8, 1}}};
  EXPECT_EQ(writer.add_stream(about).value(), stream);
  write_until(6);
  EXPECT_TRUE(writer.has_fields(stream));
  ASSERT_TRUE(writer.finish());

  EXPECT_TRUE(open_recording(path("a_1.mcap")).streams()[0].type.fields.empty());
  EXPECT_EQ(open_recording(path("a_5.mcap")).streams()[0].type, about.type);
  const Recording recording = open_recording(folder_);
  ASSERT_EQ(recording.streams().size(), 1U);
  EXPECT_EQ(recording.streams()[0].type, about.type);
  EXPECT_EQ(all_of(recording), written);
}

// The disk is slower than the test, so nearly all waits for it when the description comes.
TEST_F(RecordingFiles, StaySmallWhenMuchWaitsBeforeADescription) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), small_files()).value();
  RecordedStream about = plain_stream("s", 24);
  const auto stream = writer.add_stream(about).value();
  for (int i = 0; i < 600; ++i) write(writer, stream, sample_at(i, i));
  about.type = {"Point", 24, 8, {{"x", Scalar::float64, 0, 1}, {"y", Scalar::float64, 8, 1}}};
  EXPECT_EQ(writer.add_stream(about).value(), stream);
  for (int i = 600; i < 1000; ++i) write(writer, stream, sample_at(i, i));
  ASSERT_TRUE(writer.finish());
  const Recording recording = open_recording(folder_);
  EXPECT_EQ(all_of(recording).size(), 1000U);
  for (const auto& file : recording.files()) EXPECT_LT(std::filesystem::file_size(file), 8000U);
}

TEST_F(RecordingFiles, HaveNoDescriptionThatCameAfterTheLastFileBegan) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  const auto bytes = writer.add_stream(plain_stream("bytes", 24)).value();
  EXPECT_TRUE(writer.has_fields(writer.add_stream(odometry_stream()).value()));
  RecordedStream about = plain_stream("bytes", 24);
  about.type = {"Point", 24, 8, {{"x", Scalar::float64, 0, 1}, {"y", Scalar::float64, 8, 1}}};
  EXPECT_EQ(writer.add_stream(about).value(), bytes);
  ASSERT_TRUE(writer.finish());
  EXPECT_FALSE(writer.has_fields(bytes));
  EXPECT_TRUE(open_recording(path("a.mcap")).streams()[0].type.fields.empty());
}

TEST_F(RecordingFiles, SplitsByTimeOfTheSamples) {
  RecordingOptions options;
  options.chunk_bytes = 100;
  options.max_file_duration = std::chrono::seconds(10);
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  const auto stream = writer.add_stream(plain_stream("s", 24)).value();
  for (int i = 0; i < 35; ++i) write(writer, stream, sample_at(i, i * 1'000'000'000LL));
  ASSERT_TRUE(writer.finish());
  ASSERT_EQ(writer.progress().files, 4U);
  const Recording last = open_recording(path("a_3.mcap"));
  EXPECT_EQ(last.streams()[0].first_time, time_from_ns(30'000'000'000));
}

TEST_F(RecordingFiles, DeletesItsOldestFilesOnly) {
  RecordingOptions options;
  options.compression = Compression::none;
  options.chunk_bytes = 500;
  options.max_total_bytes = 16000;
  write_file(path("a_2.mcap"), "of another recording");
  write_file(path("other.mcap"), "of another recording");
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  const auto stream = writer.add_stream(plain_stream("s", 24)).value();
  for (int i = 0; i < 1000; ++i) write(writer, stream, sample_at(i, i));
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(content_of(path("a_2.mcap")), "of another recording");
  std::filesystem::remove(path("a_2.mcap"));
  EXPECT_TRUE(std::filesystem::remove(path("other.mcap")));
  EXPECT_FALSE(std::filesystem::exists(path("a.mcap")));
  std::uint64_t total = 0;
  for (const auto& file : std::filesystem::directory_iterator(folder_)) total += file.file_size();
  EXPECT_LT(total, 20000U);  // and what the last chunk and the last summary are more
  const Recording recording = open_recording(folder_);
  EXPECT_EQ(recording.streams()[0].last_tid, 999);
  EXPECT_GT(recording.streams()[0].samples, 50U);
}

TEST_F(RecordingFiles, KeepTheLastPropertyAndItsAbsence) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  const auto a = writer.add_stream(odometry_stream()).value();
  const auto b = writer.add_stream(plain_stream("b", 24)).value();
  write(writer, b, sample_at(1, 1));
  ASSERT_TRUE(writer.set_property(a, {}));
  ASSERT_TRUE(writer.set_property(b, payload_of(1, 3)));
  write(writer, b, sample_at(2, 2));
  ASSERT_TRUE(writer.set_property(b, payload_of(2, 4)));
  ASSERT_TRUE(writer.finish());
  const Recording recording = open_recording(path("a.mcap"));
  EXPECT_EQ(recording.streams()[a].property, Bytes());
  EXPECT_EQ(recording.streams()[b].property, payload_of(2, 4));
  EXPECT_EQ(recording.open_raw_reader(odometry_stream().id).value().property().error().code,
            Errc::not_found);
}

// The properties of a stream, each after the ns of its time, "begin" for that of the beginning.
std::vector<std::string> properties_of(const Recording& recording, std::size_t stream) {
  std::vector<std::string> all;
  const std::vector<Time>& times = recording.streams()[stream].property_times;
  for (std::size_t i = 0; i < times.size(); ++i) {
    const Bytes property = recording.property(stream, i).value();
    all.push_back((times[i] == Time::min() ? "begin" : std::to_string(to_ns(times[i]))) + " " +
                  std::string(reinterpret_cast<const char*>(property.data()), property.size()));
  }
  return all;
}

Bytes bytes_of(std::string_view text) {
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}

using Texts = std::vector<std::string>;

TEST_F(RecordingFiles, HaveEachPropertyFromItsTimeOn) {
  RecordedStream first = plain_stream("a", 24);
  first.property = bytes_of("one");
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  const auto a = writer.add_stream(first).value();
  const auto b = writer.add_stream(plain_stream("b", 24)).value();
  for (Tid tid = 0; tid < 3; ++tid) write(writer, a, sample_at(tid, 10 * (tid + 1)));
  ASSERT_TRUE(writer.set_property(a, bytes_of("two")));  // after the last sample
  ASSERT_TRUE(writer.set_property(a, bytes_of("two")));
  for (Tid tid = 3; tid < 6; ++tid) write(writer, a, sample_at(tid, 10 * (tid + 1)));
  ASSERT_TRUE(writer.set_property(a, bytes_of("three"), time_from_ns(50)));  // noticed late
  ASSERT_TRUE(writer.set_property(a, {}, time_from_ns(90)));
  ASSERT_TRUE(writer.set_property(b, bytes_of("early")));  // there are no samples
  write(writer, b, sample_at(0, -5));
  ASSERT_TRUE(writer.set_property(b, bytes_of("before 1970")));
  ASSERT_TRUE(writer.finish());

  const auto expect_all = [&](const Recording& recording) {
    EXPECT_EQ(properties_of(recording, a), (Texts{"begin one", "31 two", "50 three", "90 "}));
    EXPECT_EQ(properties_of(recording, b), Texts{"begin before 1970"});
    EXPECT_EQ(recording.streams()[a].property, Bytes());
    const RecordedStreamInfo& about = recording.streams()[a];
    EXPECT_EQ(about.property_at(Time::min()), 0U);
    EXPECT_EQ(about.property_at(time_from_ns(30)), 0U);
    EXPECT_EQ(about.property_at(time_from_ns(31)), 1U);
    EXPECT_EQ(about.property_at(Time::max()), 3U);
    EXPECT_EQ(recording.property(a, 4).error().code, Errc::invalid_argument);
    EXPECT_EQ(recording.property(2, 0).error().code, Errc::invalid_argument);
  };
  const Recording recording = open_recording(path("a.mcap"));
  expect_all(recording);

  // A reader has that of its place.
  RecordedRawReader reader = recording.open_raw_reader({"a", 0, ""}).value();
  Bytes payload(24);
  SampleInfo info;
  EXPECT_EQ(reader.property().value(), bytes_of("one")) << "of the first sample";
  for (const char* property : {"one", "one", "one", "two", "three", "three"}) {
    ASSERT_EQ(reader.read_next(payload, info), ReadStatus::ok);
    EXPECT_EQ(reader.property().value(), bytes_of(property)) << info.tid;
  }
  ASSERT_EQ(reader.read_previous(payload, info), ReadStatus::ok);
  ASSERT_EQ(reader.read_previous(payload, info), ReadStatus::ok);
  EXPECT_EQ(reader.property().value(), bytes_of("two"));
  reader.seek(1000);
  EXPECT_EQ(reader.property().error().code, Errc::not_found) << "it was removed";

  // The same by all records, without the summary.
  std::filesystem::resize_file(path("a.mcap"), std::filesystem::file_size(path("a.mcap")) - 1);
  expect_all(open_recording(path("a.mcap")));
}

TEST_F(RecordingFiles, LeaveOutAPropertyThatAnotherOneReplacedForAllOfItsTime) {
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  const auto stream = writer.add_stream(plain_stream("s", 24)).value();
  write(writer, stream, sample_at(0, 100));
  ASSERT_TRUE(writer.set_property(stream, bytes_of("a"), time_from_ns(50)));
  ASSERT_TRUE(writer.set_property(stream, bytes_of("b"), time_from_ns(80)));
  ASSERT_TRUE(writer.set_property(stream, bytes_of("c"), time_from_ns(90)));
  ASSERT_TRUE(writer.set_property(stream, bytes_of("d"), time_from_ns(80)));
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(properties_of(open_recording(path("a.mcap")), stream), (Texts{"50 a", "80 d"}));
  EXPECT_FALSE(open_recording(path("a.mcap")).streams()[stream].property_at(time_from_ns(49)));
}

TEST_F(RecordingFiles, RepeatThePropertyOfTheFileBeforeWithItsTime) {
  RecordingOptions options;
  options.compression = Compression::none;
  options.chunk_bytes = 500;
  options.max_file_bytes = 3000;
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  const auto stream = writer.add_stream(plain_stream("s", 24)).value();
  Texts expected;
  for (int i = 0; i < 300; ++i) {
    if (i % 100 == 30) {
      const std::string text = "p" + std::to_string(i);
      ASSERT_TRUE(writer.set_property(stream, bytes_of(text)));
      expected.push_back(std::to_string(i * 10 - 9) + " " + text);
    }
    write(writer, stream, sample_at(i, i * 10));
  }
  ASSERT_TRUE(writer.finish());
  ASSERT_GT(writer.progress().files, 6U);
  EXPECT_EQ(properties_of(open_recording(folder_), stream), expected);
  const std::string last = "a_" + std::to_string(writer.progress().files - 1) + ".mcap";
  EXPECT_EQ(properties_of(open_recording(path(last)), stream), Texts{expected.back()});
}

// As a black box makes of two incidents.
TEST_F(RecordingFiles, KeepThePropertyThatEachOfSeveralRecordingsBeganWith) {
  for (const int number : {0, 1}) {
    RecordingWriter writer =
        RecordingWriter::create(path(std::to_string(number) + ".mcap")).value();
    RecordedStream about = plain_stream("s", 24);
    about.property = bytes_of(number == 0 ? "one" : "two");
    const auto stream = writer.add_stream(about).value();
    write(writer, stream, sample_at(10 * number, 100 * number + 5));
    ASSERT_TRUE(writer.finish());
  }
  EXPECT_EQ(properties_of(open_recording(folder_), 0), (Texts{"begin one", "105 two"}));
}

// Before properties had times, each file began with one of time 0, and a change had the time of the
// chunk before.
TEST_F(RecordingFiles, OfSeveralWritersAreOneInTheOrderOfWriting) {
  RecordingOptions options;
  options.recording = "of two";
  RecordingWriter first = RecordingWriter::create(path("b.mcap"), options).value();
  const auto a = first.add_stream(plain_stream("a", 24)).value();
  const auto b = first.add_stream(plain_stream("b", 24)).value();
  write(first, b, sample_at(0, 200));
  write(first, a, sample_at(50, 190));  // later than it was due
  ASSERT_TRUE(first.finish());
  options.earlier_files = first.progress().files;
  RecordingWriter second = RecordingWriter::create(path("a.mcap"), options).value();
  ASSERT_EQ(second.add_stream(plain_stream("a", 24)).value(), 0U);
  ASSERT_EQ(second.add_stream(plain_stream("old", 24)).value(), 1U);
  write(second, 0, sample_at(51, 191));
  write(second, 1, sample_at(0, 100));
  ASSERT_TRUE(second.finish());
  std::vector<Tid> tids;
  for (const Recorded& sample : all_of(open_recording(folder_))) tids.push_back(sample.info.tid);
  EXPECT_EQ(tids, (std::vector<Tid>{0, 50, 51, 0}));
}

TEST_F(RecordingFiles, OpenFromBeforePropertiesHadTimes) {
  std::vector<std::filesystem::path> files;
  for (const int number : {0, 1}) {
    files.push_back(path(std::to_string(number) + ".mcap"));
    RecordingWriter writer = RecordingWriter::create(files.back()).value();
    RecordedStream about = plain_stream("s", 24);
    about.property = bytes_of(number == 0 ? "one" : "two");
    const auto stream = writer.add_stream(about).value();
    for (Tid tid = 0; tid < 3; ++tid) {
      write(writer, stream, sample_at(10 * number + tid, 100 * number + 10 * tid));
    }
    if (number == 0) {
      ASSERT_TRUE(writer.set_property(stream, bytes_of("two"), time_from_ns(20)));
    }
    ASSERT_TRUE(writer.finish());
  }
  EXPECT_EQ(properties_of(Recording::open(files).value(), 0), (Texts{"begin one", "20 two"}));
}

TEST_F(RecordingFiles, HoldAnOldChunkWithoutFurtherSamples) {
  RecordingOptions options;
  options.chunk_age = std::chrono::milliseconds(1);
  RecordingWriter writer = RecordingWriter::create(path("a.mcap"), options).value();
  write(writer, writer.add_stream(plain_stream("s", 24)).value(), sample_at(0, 0));
  await([&] { return writer.progress().waiting_bytes == 0; });
  EXPECT_EQ(open_recording(path("a.mcap")).streams().at(0).samples, 1U);  // while it is written
}

TEST_F(RecordingFiles, RefuseWhatIsNotARecording) {
  const auto error_of = [&](const std::filesystem::path& file) {
    const Result<Recording> opened = Recording::open(file);
    return opened ? Errc::closed : opened.error().code;
  };
  EXPECT_EQ(error_of(path("missing.mcap")), Errc::not_found);
  EXPECT_EQ(error_of(folder_), Errc::not_found);
  EXPECT_EQ(error_of("/dev/null"), Errc::invalid_argument);
  write_file(path("text.mcap"), "This is no recording.");
  EXPECT_EQ(error_of(path("text.mcap")), Errc::protocol);
  write_file(path("short.mcap"), "no");
  EXPECT_EQ(error_of(path("short.mcap")), Errc::protocol);
}

TEST_F(RecordingFiles, RefuseWrongUse) {
  const auto create = [&](const RecordingOptions& options, const char* name = "a.mcap") {
    const auto created = RecordingWriter::create(path(name), options);
    return created ? Errc::closed : created.error().code;
  };
  RecordingOptions options;
  options.chunk_bytes = 0;
  EXPECT_EQ(create(options), Errc::invalid_argument);
  options.chunk_bytes = kMaxPayloadBytes + 1;
  EXPECT_EQ(create(options), Errc::invalid_argument);
  options = {};
  options.chunk_age = {};
  EXPECT_EQ(create(options), Errc::invalid_argument);
  options = {};
  options.max_total_bytes = 100;
  options.max_file_bytes = 51;
  EXPECT_EQ(create(options), Errc::invalid_argument);
  EXPECT_FALSE(std::filesystem::exists(path("a.mcap")));
  EXPECT_EQ(create({}, "no/a.mcap"), Errc::not_found);
  write_file(path("there.mcap"), "kept");
  EXPECT_EQ(create({}, "there.mcap"), Errc::conflict);
  EXPECT_EQ(content_of(path("there.mcap")), "kept");

  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  RecordedStream stream = plain_stream("s", 24);
  stream.id.name = "a:b";
  EXPECT_EQ(writer.add_stream(stream).error().code, Errc::invalid_argument);
  stream = plain_stream("s", 0);
  EXPECT_EQ(writer.add_stream(stream).error().code, Errc::invalid_argument);
  const auto number = writer.add_stream(plain_stream("s", 24)).value();
  const auto error_of = [&](std::uint32_t to, const Recorded& sample) {
    const auto written = writer.write(to, sample.info, Duration(0), sample.payload);
    return written ? Errc::closed : written.error().code;
  };
  EXPECT_EQ(error_of(number + 1, sample_at(0, 0)), Errc::invalid_argument);
  EXPECT_EQ(error_of(number, sample_at(0, 0, 25)), Errc::invalid_argument);
  Recorded wrong = sample_at(0, 0);
  wrong.info.payload_bytes = 23;
  EXPECT_EQ(error_of(number, wrong), Errc::invalid_argument);
  write(writer, number, sample_at(5, 0));
  EXPECT_EQ(error_of(number, sample_at(5, 0)), Errc::invalid_argument);
  EXPECT_EQ(error_of(number, sample_at(4, 0)), Errc::invalid_argument);
  EXPECT_EQ(writer.add_gap(9, 0, 1).error().code, Errc::invalid_argument);
  EXPECT_EQ(writer.set_property(9, {}).error().code, Errc::invalid_argument);
  write(writer, number, sample_at(6, 0));  // all that changed nothing
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(error_of(number, sample_at(7, 0)), Errc::invalid_argument);
  EXPECT_EQ(all_of(open_recording(path("a.mcap"))).size(), 2U);
}

// --- against a plain model

// What the calls by time return, from their descriptions in dssm/reader.hpp.
struct Model {
  std::vector<std::pair<Tid, std::int64_t>> samples;

  std::optional<std::size_t> at(std::int64_t t) const {
    for (std::size_t i = samples.size(); i-- > 0;) {
      if (samples[i].second <= t) return i;
    }
    return std::nullopt;
  }
  std::optional<std::size_t> at_or_after(std::int64_t t) const {
    std::size_t first = samples.size();
    while (first > 0 && samples[first - 1].second >= t) --first;
    if (first == samples.size()) return std::nullopt;
    return first;
  }
};

TEST_F(RecordingFiles, ReadByTimeAsAPlainModelDoes) {
  const char* text = std::getenv("DSSM_TEST_SEED");
  const unsigned seed = text != nullptr ? static_cast<unsigned>(std::atoi(text)) : 20;
  SCOPED_TRACE("DSSM_TEST_SEED=" + std::to_string(seed));
  std::mt19937 random(seed);
  const auto any = [&](std::int64_t low, std::int64_t high) {
    return std::uniform_int_distribution<std::int64_t>(low, high)(random);
  };
  for (int round = 0; round < 30; ++round) {
    const std::filesystem::path file = path(std::to_string(round) + ".mcap");
    RecordingOptions options;
    options.chunk_bytes = static_cast<std::uint64_t>(any(1, 2000));
    RecordingWriter writer = RecordingWriter::create(file, options).value();
    Model models[2];
    for (const char* name : {"a", "b"}) (void)writer.add_stream(plain_stream(name, 24)).value();
    // Sorted, with steps back, or random.
    const std::int64_t back = round % 3 == 0 ? 0 : round % 3 == 1 ? 30 : 1000;
    std::int64_t times[2] = {any(-500, 500), any(-500, 500)};
    Tid tids[2] = {any(0, 5), any(0, 5)};
    for (int i = static_cast<int>(any(0, 400)); i > 0; --i) {
      const auto stream = static_cast<std::uint32_t>(any(0, 1));
      std::int64_t& time = times[stream];
      time += any(0, 5) == 0 ? -any(0, back) : any(0, 10);
      write(writer, stream, sample_at(tids[stream], time));
      models[stream].samples.emplace_back(tids[stream], time);
      tids[stream] += any(0, 9) == 0 ? 3 : 1;
    }
    ASSERT_TRUE(writer.finish());
    if (round % 2 == 1) {  // without its summary
      std::filesystem::resize_file(file, std::filesystem::file_size(file) - 1);
    }
    const Recording recording = open_recording(file);
    for (std::uint32_t stream = 0; stream < 2; ++stream) {
      const Model& model = models[stream];
      const auto& samples = model.samples;
      RecordedRawReader reader =
          recording.open_raw_reader({stream == 0 ? "a" : "b", 0, ""}).value();
      Bytes payload(24);
      SampleInfo info;
      const auto expect = [&](ReadStatus status, std::optional<std::size_t> wanted,
                              ReadStatus otherwise) {
        if (!wanted) {
          EXPECT_EQ(status, samples.empty() ? ReadStatus::not_yet : otherwise);
          return;
        }
        ASSERT_EQ(status, ReadStatus::ok);
        EXPECT_EQ(info.tid, samples[*wanted].first);
        EXPECT_EQ(to_ns(info.time), samples[*wanted].second);
        EXPECT_EQ(payload, payload_of(info.tid, 24));
      };
      for (int i = 0; i < 100; ++i) {
        const std::int64_t t =
            i % 2 == 0 || samples.empty()
                ? any(-2000, 3000)
                : samples[static_cast<std::size_t>(any(0, std::ssize(samples) - 1))].second;
        const auto at = model.at(t), later = model.at_or_after(t);
        expect(reader.read_at(time_from_ns(t), payload, info), at, ReadStatus::too_old);
        expect(reader.find(time_from_ns(t), info), at, ReadStatus::too_old);
        expect(reader.read_at_or_after(time_from_ns(t), payload, info), later, ReadStatus::not_yet);
        Neighbours around;
        const ReadStatus status = reader.find_neighbours(time_from_ns(t), around);
        const bool has_both = at && *at + 1 < samples.size();
        ASSERT_EQ(status == ReadStatus::ok, has_both);
        std::optional<std::size_t> nearest = at;
        if (!at && !samples.empty()) nearest = 0;
        if (has_both) {
          EXPECT_EQ(around.before.tid, samples[*at].first);
          EXPECT_EQ(around.after.tid, samples[*at + 1].first);
          if (samples[*at + 1].second - t < t - samples[*at].second) nearest = *at + 1;
        }
        expect(reader.read_nearest(time_from_ns(t), payload, info), nearest, ReadStatus::not_yet);
      }
      reader.seek(kNoTid);
      for (std::size_t i = 0; i < samples.size(); ++i) {
        expect(reader.read_next(payload, info), i, ReadStatus::not_yet);
      }
      EXPECT_EQ(reader.read_next(payload, info), ReadStatus::not_yet);
      if (samples.empty()) continue;
      const auto span = static_cast<std::size_t>(samples.back().first - samples.front().first + 1);
      EXPECT_EQ(reader.lost_samples(), span - samples.size());
      for (Tid tid = -1; tid <= samples.back().first + 1; ++tid) {
        const auto found =
            std::ranges::find(samples, tid, [](const auto& each) { return each.first; });
        const ReadStatus status = reader.read_info(tid, info);
        if (found != samples.end()) {
          EXPECT_EQ(to_ns(info.time), found->second);
        }
        EXPECT_EQ(status, found != samples.end()        ? ReadStatus::ok
                          : tid < samples.front().first ? ReadStatus::too_old
                          : tid > samples.back().first  ? ReadStatus::not_yet
                                                        : ReadStatus::lost);
      }
      reader.seek(samples.back().first + 1);
      for (std::size_t i = samples.size(); i-- > 0;) {
        expect(reader.read_previous(payload, info), i, ReadStatus::too_old);
      }
      EXPECT_EQ(reader.read_previous(payload, info), ReadStatus::too_old);
    }
    // From a time on, in the order of recording.
    const std::vector<Recorded> all = all_of(recording);
    for (int i = 0; i < 10; ++i) {
      const Time t = time_from_ns(any(-1000, 2000));
      auto first =
          std::ranges::find_if(all, [&](const Recorded& each) { return each.info.time >= t; });
      RecordingCursor cursor = recording.cursor();
      cursor.seek(t);
      RecordedSample sample;
      for (; first != all.end(); ++first) {
        ASSERT_TRUE(cursor.next(sample));
        EXPECT_EQ(sample.info.tid, first->info.tid);
        EXPECT_EQ(sample.stream, first->stream);
      }
      EXPECT_FALSE(cursor.next(sample));
    }
    // To and fro.
    RecordingCursor cursor = recording.cursor();
    std::size_t at = 0;  // of the next one
    for (int i = 0; i < 300; ++i) {
      RecordedSample sample;
      if (any(0, 20) == 0) {
        const Time t = time_from_ns(any(-1000, 2000));
        cursor.seek(t);
        at = static_cast<std::size_t>(
            std::ranges::find_if(all, [&](const Recorded& each) { return each.info.time >= t; }) -
            all.begin());
      } else if (any(0, 1) == 0) {
        ASSERT_EQ(cursor.next(sample), at < all.size());
        if (at < all.size()) {
          EXPECT_EQ(sample.info.tid, all[at++].info.tid);
        }
      } else {
        ASSERT_EQ(cursor.previous(sample), at > 0);
        if (at > 0) {
          EXPECT_EQ(sample.info.tid, all[--at].info.tid);
        }
      }
    }
  }
}

}  // namespace
}  // namespace dssm::test
