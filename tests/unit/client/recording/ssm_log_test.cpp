// SPDX-License-Identifier: Apache-2.0
//
// Logs of SSM read as recordings: good ones, merged ones, damaged ones.
#include <gmock/gmock.h>

#include <cmath>
#include <cstring>
#include <limits>

#include "tests/unit/client/recording/recordings.hpp"

namespace dssm::test {
namespace {

using testing::ElementsAre;
using testing::HasSubstr;

// A record of 8 bytes of data: its time again.
std::string record(double time_s) {
  std::string bytes(2 * sizeof time_s, '\0');
  std::memcpy(bytes.data(), &time_s, sizeof time_s);
  std::memcpy(bytes.data() + sizeof time_s, &time_s, sizeof time_s);
  return bytes;
}

std::string records(const std::vector<double>& times_s) {
  std::string bytes;
  for (const double time_s : times_s) bytes += record(time_s);
  return bytes;
}

struct SsmLogs : RecordingTest {
  std::string save(const std::string& name, const std::string& content) {
    write_file(path(name), content);
    return path(name).string();
  }
  std::string error_of(const std::string& content) {
    const auto opened = Recording::open(save("bad.log", content));
    return opened ? "no error" : opened.error().message;
  }
};

TEST_F(SsmLogs, AreRecordingsWithOneStream) {
  const auto log = Recording::open(
      save("a.log", "odometry 3 8 49 0.050000 1795250129.792010 4\nprop" +
                        records({1795250130.25, 1795250129.5, 1795250131.000000238})));
  ASSERT_TRUE(log) << log.error().message;
  ASSERT_EQ(log->streams().size(), 1U);
  const RecordedStreamInfo& stream = log->streams()[0];
  EXPECT_EQ(stream.id, (StreamId{"odometry", 3, ""}));
  EXPECT_EQ(stream.type, (TypeInfo{"", 8, 1, {}}));
  EXPECT_EQ(stream.depth, 49U);
  EXPECT_EQ(stream.cycle, std::chrono::milliseconds(50));
  EXPECT_EQ(std::string(reinterpret_cast<const char*>(stream.property.data()), 4), "prop");
  EXPECT_EQ(stream.metadata.at("ssm_log"), "odometry 3 8 49 0.050000 1795250129.792010 4");
  EXPECT_EQ(stream.samples, 3U);
  EXPECT_TRUE(log->warnings().empty());

  RecordedRawReader reader = log->open_raw_reader({"odometry", 3, ""}).value();
  double data = 0;
  SampleInfo info;
  const auto payload = std::as_writable_bytes(std::span(&data, 1));
  ASSERT_EQ(reader.read_at(time_from_ns(1795250130'000'000'000), payload, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 1) << "times may fall";
  EXPECT_EQ(data, 1795250129.5);
  EXPECT_EQ(info.clock_error, kUnknownClockError);
  ASSERT_EQ(reader.read_newest(payload, info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 2);
  EXPECT_EQ(to_ns(info.time), 1795250131'000'000'238) << "to the nanosecond";
}

TEST_F(SsmLogs, OfTimesThatFallAreSearchedExactly) {
  const auto log =
      Recording::open(save("a.log", "a 0 8 10 0.1 1000 0\n" + records({1, 2, 9, 10, 3})));
  RecordedRawReader reader = log->open_raw_reader({"a", 0, ""}).value();
  SampleInfo info;
  ASSERT_EQ(reader.find(time_from_ns(3'500'000'000), info), ReadStatus::ok);
  EXPECT_EQ(info.tid, 4);
}

TEST_F(SsmLogs, MayBeLongerThanWhatIsReadAtOnce) {
  std::string content = "big 0 8 10 0.001000 5.000000 0\n";
  constexpr int kRecords = 200'000;
  for (int i = 0; i < kRecords; ++i) content += record(i / 1024.0);
  const auto log = Recording::open(save("a.log", content)).value();
  EXPECT_EQ(log.streams()[0].samples, std::uint64_t{kRecords});
  RecordingCursor cursor = log.cursor();
  Tid next = 0;
  for (RecordedSample sample; cursor.next(sample); ++next) {
    double data = 0;
    ASSERT_EQ(sample.payload.size(), sizeof data);
    std::memcpy(&data, sample.payload.data(), sizeof data);
    ASSERT_EQ(data, static_cast<double>(next) / 1024);
    ASSERT_EQ(sample.info.tid, next);
  }
  EXPECT_EQ(next, kRecords);
}

TEST_F(SsmLogs, AreMergedByTime) {
  const std::string head = " 0 8 10 0.100000 1000.000000 0\n";
  save("a.log", "a" + head + records({1, 2, 5, 9}));
  save("b.log", "b" + head + records({0.5, 2, 3, 7}));
  save("notes.txt", "not one");
  const auto log = Recording::open(folder_);
  ASSERT_TRUE(log) << log.error().message;
  ASSERT_EQ(log->streams().size(), 2U);
  const auto times_from = [&](std::int64_t ns) {
    std::vector<double> times;
    RecordingCursor cursor = log->cursor();
    cursor.seek(time_from_ns(ns));
    for (RecordedSample sample; cursor.next(sample);) {
      times.push_back(static_cast<double>(to_ns(sample.info.time)) / 1e9);
    }
    return times;
  };
  EXPECT_THAT(times_from(0), ElementsAre(0.5, 1, 2, 2, 3, 5, 7, 9));
  EXPECT_THAT(times_from(4'000'000'000), ElementsAre(5, 7, 9));
}

TEST_F(SsmLogs, OfOneStreamAreItsIncarnations) {
  save("late.log", "a 0 8 10 0.1 2000 0\n" + records({2001, 2002}));
  save("early.log", "a 0 8 10 0.1 1000 0\n" + records({1001}));
  const auto log = Recording::open(folder_).value();
  ASSERT_EQ(log.streams().size(), 2U);
  EXPECT_EQ(log.streams()[0].samples, 1U);
  EXPECT_EQ(log.streams()[1].samples, 2U);
}

TEST_F(SsmLogs, WithoutDataHaveEmptySamples) {
  std::string times(sizeof(double), '\0');
  const double time = 1.5;
  std::memcpy(times.data(), &time, sizeof time);
  const auto log = Recording::open(save("a.log", "tick 0 0 10 0.1 1 0\n" + times)).value();
  RecordingCursor cursor = log.cursor();
  RecordedSample sample;
  ASSERT_TRUE(cursor.next(sample));
  EXPECT_EQ(sample.payload.size(), 0U);
  EXPECT_FALSE(cursor.next(sample));
}

TEST_F(SsmLogs, ThatAreDamagedAreReadAsFarAsPossible) {
  const std::string head = "a 0 8 10 0.1 1000 0\n";
  const auto cut = Recording::open(save("cut.log", head + records({1, 2}) + "1234567")).value();
  EXPECT_EQ(cut.streams()[0].samples, 2U);
  EXPECT_THAT(cut.warnings(), ElementsAre(HasSubstr("its last 7 bytes are left out")));

  const auto odd = Recording::open(
      save("odd.log", head + records({std::nan(""), 2, std::numeric_limits<double>::infinity(), 3,
                                      -1e300, 0.1234567890123})));
  ASSERT_TRUE(odd) << odd.error().message;
  EXPECT_EQ(odd->streams()[0].samples, 3U);
  EXPECT_EQ(odd->streams()[0].lost_samples, 3U);
  EXPECT_EQ(odd->streams()[0].gaps, (std::vector<RecordedGap>{{0, 1}, {2, 1}, {4, 1}}));
  EXPECT_THAT(odd->warnings(), ElementsAre(HasSubstr("3 records are left out"),
                                           HasSubstr("1 times are rounded to a nanosecond")));
  RecordingCursor cursor = odd->cursor();
  std::vector<Tid> tids;
  for (RecordedSample sample; cursor.next(sample);) tids.push_back(sample.info.tid);
  EXPECT_THAT(tids, ElementsAre(1, 3, 5));
}

TEST_F(SsmLogs, ThatAreNoneAreRefusedWithTheReason) {
  EXPECT_THAT(error_of("some text\n"), HasSubstr("not an MCAP file"));
  EXPECT_THAT(error_of("some text\n"), HasSubstr("NAME ID SIZE NUM CYCLE START PROPERTY_SIZE"));
  EXPECT_THAT(error_of("a 0 8 10 0.1 1000 0"), HasSubstr("no first line"));
  EXPECT_THAT(error_of("a 0 8 10 0.1 1000 0" + std::string(5000, ' ') + "\n"),
              HasSubstr("no first line"));
  EXPECT_THAT(error_of("a 0 -8 10 0.1 1000 0\n"), HasSubstr("NAME ID"));
  EXPECT_THAT(error_of("a 0 8 10 0.1 1000 -1\n"), HasSubstr("NAME ID"));
  EXPECT_THAT(error_of("a -1 8 10 0.1 1000 0\n"), HasSubstr("ids start at 0"));
  EXPECT_THAT(error_of("a 0 8 10 nan 1000 0\n"), HasSubstr("NAME ID"));
  EXPECT_THAT(error_of("a 0 99999999999 10 0.1 1000 0\n"), HasSubstr("sizes beyond 2147483647"));
  EXPECT_THAT(error_of("a 0 2147483647 10 0.1 1000 0\n"), HasSubstr("64 MiB"));
  EXPECT_THAT(error_of("a 0 8 10 0.1 1000 5\nprop"), HasSubstr("ends inside its property"));
  EXPECT_THAT(error_of("a:b 0 8 10 0.1 1000 0\n"), HasSubstr("as a log of SSM: stream name 'a:b'"));
  EXPECT_EQ(repair_recording(save("a.log", "a 0 8 10 0.1 1000 0\n")).error().code,
            Errc::invalid_argument);
}

TEST_F(SsmLogs, KeepTheirFirstLineInMcap) {
  RecordedStream stream = plain_stream("s", 24);
  stream.id.host.clear();
  stream.type.fields = {{"m", Scalar::int16, 2, 1, 2, 3, 5}, {"n%", Scalar::uint8, 0, 1, 1}};
  stream.metadata = {{"ssm_log", "s 0 24 16 0.01 5 0"}, {"depth", "not mine"}, {"mounted", "left"}};
  RecordingWriter writer = RecordingWriter::create(path("a.mcap")).value();
  const auto number = writer.add_stream(stream);
  ASSERT_TRUE(number) << number.error().message;
  write(writer, *number, sample_at(0, 0));
  ASSERT_TRUE(writer.finish());
  const auto read = Recording::open(path("a.mcap")).value();
  const RecordedStreamInfo& info = read.streams().at(0);
  EXPECT_EQ(info.id, stream.id) << "its host is not known";
  EXPECT_EQ(info.type, stream.type) << "with its bit fields";
  EXPECT_EQ(info.depth, 16U);
  EXPECT_EQ(info.metadata, (std::map<std::string, std::string>{{"ssm_log", "s 0 24 16 0.01 5 0"},
                                                               {"mounted", "left"}}));
}

}  // namespace
}  // namespace dssm::test
