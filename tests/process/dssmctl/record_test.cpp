// SPDX-License-Identifier: Apache-2.0
//
// dssmctl record and play, and what info shows of a recording.
#include <pty.h>
#include <signal.h>

#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>

#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct RecordedPose {
  double x, y;
  std::int64_t number;
};
DSSM_DESCRIBE(RecordedPose, x, y, number)

void write_poses(Writer<RecordedPose>& writer, std::int64_t first, std::int64_t last) {
  for (std::int64_t i = first; i <= last; ++i) {
    writer.write({0.5 * static_cast<double>(i), -1, i}, at_ns(kSecond + i * 1'000'000),
                 Duration(i));
  }
}

// That `reader` goes on with samples `first` to `last` of write_poses().
void expect_poses(RecordedReader<RecordedPose>& reader, std::int64_t first, std::int64_t last) {
  for (std::int64_t i = first; i <= last; ++i) {
    const auto sample = reader.read_next();
    ASSERT_TRUE(sample) << i << ": " << name_of(sample.status());
    ASSERT_EQ(sample->value.number, i);
    EXPECT_EQ(sample->value.x, 0.5 * static_cast<double>(i));
    EXPECT_EQ(sample->info.tid, i);
    EXPECT_EQ(sample->info.time, at_ns(kSecond + i * 1'000'000));
    EXPECT_EQ(sample->info.clock_error, Duration(i));
  }
}

std::vector<std::byte> bytes_of(std::string_view text) {
  const auto bytes = std::as_bytes(std::span(text));
  return {bytes.begin(), bytes.end()};
}

// The properties that a stream of a recording had, each after the number of samples before it: "10
// calibrated". None that is not there yet.
std::vector<std::string> properties_in(const std::string& file, const std::string& stream) {
  const Result<Recording> recording = Recording::open(file);
  if (!recording) return {};
  std::vector<std::string> all;
  for (std::size_t i = 0; i < recording->streams().size(); ++i) {
    const RecordedStreamInfo& about = recording->streams()[i];
    if (about.id.name != stream) continue;
    for (std::size_t n = 0; n < about.property_times.size(); ++n) {
      int before = 0;
      RecordingCursor cursor = recording->cursor();
      for (RecordedSample sample; cursor.next(sample);) {
        before += sample.stream == i && sample.info.time < about.property_times[n];
      }
      const auto property = recording->property(i, n).value();
      all.push_back(std::to_string(before) + " " +
                    std::string(reinterpret_cast<const char*>(property.data()), property.size()));
    }
  }
  return all;
}

class Record : public CtlTest {
 protected:
  // Until dssmctl has the stream open: what is written from now on is recorded.
  void await_reader(const StreamId& id, std::uint32_t readers = 1) {
    await([&] { return session_.stream_info(id).value().readers >= readers; });
  }
  // Until the file has so many samples of its first stream: chunks are written when they are a
  // second old.
  void await_recorded(std::uint64_t samples) {
    await([&] {
      const Result<Recording> recording = Recording::open(file_);
      return recording && !recording->streams().empty() &&
             recording->streams()[0].samples == samples;
    });
  }
  static RecordedReader<RecordedPose> recorded(const std::string& file, const std::string& stream) {
    return Recording::open(file).value().open_reader<RecordedPose>(stream).value();
  }

  TestFolder folder_;
  std::string file_ = folder_.file("a.mcap");
};

TEST_F(Record, KeepsWhatIsWrittenWithTimesTidsAndProperties) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(4096)).value();
  auto other = session_.create<RecordedPose>("other", depth_of(16)).value();
  const std::byte property[] = {std::byte{1}, std::byte{2}};
  ASSERT_TRUE(session_.set_property(pose.id(), property));
  write_poses(pose, 0, 9);
  Running running(argv({"record", "p*", "-o", file_}), environment());
  await_reader(pose.id());
  write_poses(pose, 10, 2009);
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  const std::string text = running.rest();
  EXPECT_TRUE(contains(text, file_ + ": 2000 samples of 1 stream, ")) << text;
  EXPECT_TRUE(contains(text, ", 0 lost\n")) << text;

  const Recording recording = Recording::open(file_).value();
  ASSERT_EQ(recording.streams().size(), 1U);
  const RecordedStreamInfo& stream = recording.streams().front();
  EXPECT_EQ(stream.id, pose.id());
  EXPECT_EQ(stream.type, pose.type());
  EXPECT_EQ(stream.depth, 4096U);
  EXPECT_EQ(stream.incarnation, pose.incarnation());
  EXPECT_EQ(stream.property, std::vector<std::byte>(std::begin(property), std::end(property)));
  RecordedReader<RecordedPose> reader = recorded(file_, "pose");
  expect_poses(reader, 10, 2009);
  EXPECT_FALSE(reader.read_next());
}

TEST_F(Record, HasEachPropertyFromTheRightSampleOn) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(4096)).value();
  auto silent = session_.create<RecordedPose>("silent", depth_of(4)).value();
  ASSERT_TRUE(pose.set_property(bytes_of("first")));
  ASSERT_TRUE(silent.set_property(bytes_of("first")));
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(pose.id());
  await_reader(silent.id());
  // The recorder may read the samples before it hears of the property.
  write_poses(pose, 0, 9);
  ASSERT_TRUE(pose.set_property(bytes_of("second")));
  write_poses(pose, 10, 29);
  ASSERT_TRUE(silent.set_property(bytes_of("second")));
  await([&] { return properties_in(file_, "pose").size() == 2; });
  ASSERT_TRUE(pose.set_property({}));
  write_poses(pose, 30, 39);
  await([&] { return properties_in(file_, "pose").size() == 3; });
  ASSERT_TRUE(pose.set_property(bytes_of("no sample comes any more")));
  await([&] { return properties_in(file_, "pose").size() == 4; });
  ASSERT_TRUE(pose.set_property(bytes_of("just now")));
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  // The last two are both after the last sample, at the same time of the recording.
  EXPECT_EQ(properties_in(file_, "pose"),
            (std::vector<std::string>{"0 first", "10 second", "30 ", "40 just now"}));
  EXPECT_EQ(properties_in(file_, "silent"), std::vector<std::string>{"0 second"});
  const Json info = Json::parse(output({"info", file_, "--json"}));
  EXPECT_EQ(info["streams"][0]["property_changes"], 3) << info.dump(2);
  EXPECT_EQ(info["streams"][1]["property_changes"], 0) << info.dump(2);
}

TEST_F(Record, HasThePropertyOfAStreamThatRestarts) {
  auto pose = std::optional(session_.create<RecordedPose>("pose", depth_of(64)).value());
  ASSERT_TRUE(pose->set_property(bytes_of("first")));
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(pose->id());
  write_poses(*pose, 0, 9);
  ASSERT_TRUE(session_.remove(pose->id()));
  pose = session_.create<RecordedPose>("pose", depth_of(64)).value();
  ASSERT_TRUE(pose->set_property(bytes_of("again")));
  write_poses(*pose, 0, 4);
  await([&] { return properties_in(file_, "pose").size() == 2; });
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  EXPECT_EQ(properties_in(file_, "pose"), (std::vector<std::string>{"0 first", "0 again"}));
}

TEST_F(Record, OfThePastTakesWhatTheRingsHoldOfThatTimeAndEnds) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(256)).value();
  const Time now = WallClock::now();
  // Half a minute may pass until dssmctl begins.
  for (int i = 0; i < 100; ++i) pose.write({0, 0, i}, now - (99 - i) * 1min);
  const std::string text = output({"record", "--past", "1770s", "-o", file_});
  RecordedReader<RecordedPose> reader = recorded(file_, "pose");
  for (int i = 70; i < 100; ++i) {
    const auto sample = reader.read_next();
    ASSERT_TRUE(sample) << text;
    EXPECT_EQ(sample->value.number, i);
  }
  EXPECT_FALSE(reader.read_next());
}

TEST_F(Record, TakesStreamsThatComeLaterAndRestart) {
  const auto early = session_.create<RecordedPose>("early", depth_of(4)).value();
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(early.id());
  auto pose = std::optional(session_.create<RecordedPose>("pose", depth_of(4096)).value());
  write_poses(*pose, 0, 99);
  await_reader(pose->id());
  ASSERT_TRUE(session_.remove(pose->id()));
  pose = session_.create<RecordedPose>("pose", depth_of(4096)).value();
  write_poses(*pose, 0, 49);
  await_reader(pose->id());
  running.signal(SIGTERM);
  EXPECT_EQ(running.status(), 0);
  RecordedReader<RecordedPose> reader = recorded(file_, "pose");
  expect_poses(reader, 0, 99);
  EXPECT_EQ(reader.read_next().status(), ReadStatus::restarted);
  expect_poses(reader, 0, 49);
}

TEST_F(Record, OpensAStreamAgainThatHasAnotherType) {
  auto pose = std::optional(session_.create<RecordedPose>("pose", depth_of(64)).value());
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(pose->id());
  write_poses(*pose, 0, 9);
  await([&] {  // dssmd counts the reader before the recorder has the ring
    const Result<Recording> recording = Recording::open(file_);
    return recording && recording->streams().size() == 1 && recording->streams()[0].samples == 10;
  });
  ASSERT_TRUE(session_.remove(pose->id()));
  pose.reset();
  auto number = session_.create<double>("pose", depth_of(64)).value();
  for (int i = 0; i < 5; ++i) number.write(i);
  const std::string notice = running.line();
  EXPECT_TRUE(contains(notice, "'pose:0@pc1' is opened again: ")) << notice;
  await([&] {
    const Result<Recording> recording = Recording::open(file_);
    return recording && recording->streams().size() == 2 && recording->streams()[1].samples == 5;
  });
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  const Recording recording = Recording::open(file_).value();
  EXPECT_EQ(recording.streams()[0].samples, 10U);
  EXPECT_EQ(recording.streams()[1].type, number.type());
  EXPECT_EQ(recording.streams()[1].samples, 5U);
}

TEST_F(Record, NamesAStreamThatWasRemovedBeforeItWasOpened) {
  auto pose = std::optional(session_.create<RecordedPose>("pose", depth_of(64)).value());
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(pose->id());
  running.stop();
  ASSERT_TRUE(session_.remove(pose->id()));
  pose.reset();
  session_.create<double>("pose", depth_of(64)).value().write(1);
  ASSERT_TRUE(session_.remove({"pose", 0, ""}));
  const auto number = session_.create<float>("pose", depth_of(64)).value();
  running.signal(SIGCONT);
  const auto names_removed = [](const std::string& line) {
    return contains(line, "'pose:0@pc1' was removed, or its host lost, before it could be ");
  };
  std::string line = running.line();
  while (!line.empty() && !names_removed(line)) line = running.line();  // "is opened again"
  EXPECT_TRUE(names_removed(line));
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
}

TEST_F(Record, OfThePastIsInTheOrderOfTimesOfAllStreams) {
  auto first = session_.create<RecordedPose>("first", depth_of(1024)).value();
  auto second = session_.create<RecordedPose>("second", depth_of(1024)).value();
  const Time begin = WallClock::now() - 20s;
  for (int i = 0; i < 1000; ++i) {
    first.write({0, 0, i}, begin + i * 10ms);
    second.write({0, 0, i}, begin + i * 10ms);
  }
  output({"record", "--past", "1h", "-o", file_});
  const Recording recording = Recording::open(file_).value();
  RecordingCursor cursor = recording.cursor();
  Time newest{};
  int samples = 0;
  for (RecordedSample sample; cursor.next(sample); ++samples) {
    EXPECT_GE(sample.info.time, newest - 200ms);
    newest = std::max(newest, sample.info.time);
  }
  EXPECT_EQ(samples, 2000);
}

// Samples of `late` are written 20 ms after their times, as those of a LIDAR are.
TEST_F(Record, IsInTheOrderOfTimesOfAllStreams) {
  auto prompt = session_.create<RecordedPose>("prompt", depth_of(4096)).value();
  auto late = session_.create<RecordedPose>("late", depth_of(4096)).value();
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(prompt.id());
  await_reader(late.id());
  constexpr int kPrompt = 500, kLate = 50;
  for (int i = 0; i < kPrompt; ++i) {
    const Time now = WallClock::now();
    prompt.write({0, 0, i}, now);
    if (i % (kPrompt / kLate) == 0) late.write({0, 0, i}, now - 20ms);
    std::this_thread::sleep_for(1ms);  // the stream's cycle
  }
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  const Recording recording = Recording::open(file_).value();
  RecordingCursor cursor = recording.cursor();
  Time newest{};
  int samples = 0, disordered = 0;
  for (RecordedSample sample; cursor.next(sample); ++samples) {
    disordered += sample.info.time < newest ? 1 : 0;
    newest = std::max(newest, sample.info.time);
  }
  EXPECT_EQ(samples, kPrompt + kLate);
  // This program may stand still between the write of one stream and that of the other.
  EXPECT_LE(disordered, kLate / 10);
}

TEST_F(Record, TakesOnlyStreamsOfATypeIfAsked) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(64)).value();
  auto number = session_.create<double>("number", depth_of(64)).value();
  Running running(argv({"record", "--type", "*Pose", "-o", file_}), environment());
  await_reader(pose.id());
  // It comes later than one that is not recorded.
  auto later = session_.create<double>("later", depth_of(64)).value();
  auto other = session_.create<RecordedPose>("other", depth_of(64)).value();
  await_reader(other.id());
  number.write(1);
  later.write(1);
  write_poses(pose, 0, 9);
  write_poses(other, 0, 9);
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  const std::string text = running.rest();
  EXPECT_TRUE(contains(text, ": 20 samples of 2 streams, ")) << text;
}

TEST_F(Record, NamesPatternsThatNoStreamFits) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(64)).value();
  const Finished done =
      ctl({"record", "po*", "laser", "--past", "1s", "-o", folder_.file("b.mcap")});
  EXPECT_EQ(done.exit_status, 0) << done.err;
  EXPECT_TRUE(contains(done.err, "no stream fits laser so far")) << done.err;
}

TEST_F(Record, KeepsTheQuotaOfItsFolder) {
  constexpr std::uint64_t kBytes = 100'000;  // of a sample
  constexpr std::uintmax_t kQuota = 8'000'000;
  auto blob =
      session_.create_raw({"blob", 0, ""}, TypeInfo{"", kBytes, 1, {}}, depth_of(256)).value();
  for (int day = 10; day < 20; ++day) {
    const std::string file = folder_.file("dssm_2026_11_" + std::to_string(day) + "-12_00_00.mcap");
    std::ofstream(file) << std::string(kQuota / 10, 'x');
    std::filesystem::last_write_time(
        file, std::filesystem::file_time_type::clock::now() - 1h * (30 - day));
  }
  const auto total = [&] {
    std::uintmax_t bytes = 0;
    for (const auto& entry : std::filesystem::directory_iterator(folder_.path())) {
      bytes += entry.file_size();
    }
    return bytes;
  };
  const auto exists = [&](int day) {
    return std::filesystem::exists(
        folder_.file("dssm_2026_11_" + std::to_string(day) + "-12_00_00.mcap"));
  };
  Running running(
      argv({"record", "--compression", "none", "--quota", "8000000", "-o", folder_.path()}),
      environment());
  await_reader(blob.id());
  EXPECT_TRUE(!exists(10) && exists(11));  // before anything is recorded
  const std::vector<std::byte> payload(kBytes);
  for (int i = 0; i < 200; ++i) blob.write(payload);
  await([&] { return !exists(19); });  // while it records
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  EXPECT_TRUE(contains(running.rest(), ": 200 samples of 1 stream"));
  EXPECT_LE(total(), kQuota);
  EXPECT_GE(total(), kQuota / 2);
  EXPECT_EQ(Recording::open(folder_.path()).value().streams()[0].last_tid, 199);
}

TEST_F(Record, KeepsTheTotalSizeOfItsFiles) {
  constexpr std::uint64_t kBytes = 100'000;  // of a sample
  auto blob =
      session_.create_raw({"blob", 0, ""}, TypeInfo{"", kBytes, 1, {}}, depth_of(256)).value();
  Running running(
      argv({"record", "--compression", "none", "--max-total-size", "8000000", "-o", file_}),
      environment());
  await_reader(blob.id());
  const std::vector<std::byte> payload(kBytes);
  for (int i = 0; i < 200; ++i) blob.write(payload);
  await([&] { return !std::filesystem::exists(file_); });
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  EXPECT_TRUE(contains(running.rest(), ": 200 samples of 1 stream"));
  std::uintmax_t total = 0;
  for (const auto& entry : std::filesystem::directory_iterator(folder_.path())) {
    total += entry.file_size();
  }
  EXPECT_LE(total, 8'000'000U);
  EXPECT_GE(total, 4'000'000U);
  EXPECT_EQ(Recording::open(folder_.path()).value().streams()[0].last_tid, 199);
}

TEST_F(Record, BeginsAnotherFileAfterATime) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(4096)).value();
  Running running(argv({"record", "--max-file-duration", "100ms", "-o", file_}), environment());
  await_reader(pose.id());
  std::int64_t written = 0;
  await([&] {
    pose.write({0, 0, written++});
    const std::filesystem::directory_iterator files(folder_.path());
    return std::distance(begin(files), end(files)) >= 3;
  });
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  const Recording recording = Recording::open(folder_.path()).value();
  EXPECT_GE(recording.files().size(), 3U);
  EXPECT_EQ(recording.streams()[0].samples, static_cast<std::uint64_t>(written));
}

TEST_F(Record, OfThePastContinuesIfAsked) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(256)).value();
  for (int i = 0; i < 10; ++i) pose.write({0, 0, i});
  Running running(argv({"record", "--past", "1h", "--follow", "-o", file_}), environment());
  await_recorded(10);
  for (int i = 10; i < 15; ++i) pose.write({0, 0, i});
  await_recorded(15);
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  EXPECT_TRUE(contains(running.rest(), ": 15 samples of 1 stream"));
}

TEST_F(Record, NamesWhatItDeletedAlsoWhenItCannotBegin) {
  const std::string old = folder_.file("dssm_2026_11_10-12_00_00.mcap");
  const std::string newer = folder_.file("dssm_2026_11_11-12_00_00.mcap");
  for (const std::string& file : {old, newer}) std::ofstream(file) << std::string(70'000, 'x');
  std::filesystem::last_write_time(old, std::filesystem::last_write_time(newer) - 1h);
  std::vector<std::string> words = argv({"record", "--quota", "64KiB", "-o", folder_.path()});
  // No file may have a byte, which is as a full disk is.
  words.insert(words.begin(), {"env", "--ignore-signal=XFSZ", "prlimit", "--fsize=0"});
  const Finished finished = run(words, environment());
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_TRUE(contains(finished.err, "File too large")) << finished.err;
  EXPECT_TRUE(contains(finished.err, "'" + old + "' is deleted, because of --quota\n"))
      << finished.err;
  EXPECT_FALSE(std::filesystem::exists(old));
  EXPECT_TRUE(std::filesystem::exists(newer));
}

TEST_F(Record, TakesAQuotaOnlyForAFolder) {
  const Finished refused = ctl({"record", "--quota", "1MiB", "-o", file_});
  EXPECT_EQ(refused.exit_status, 2);
  EXPECT_TRUE(contains(refused.err, "'" + file_ + "' is no folder")) << refused.err;
  EXPECT_FALSE(std::filesystem::exists(file_));
}

TEST_F(Record, InfoTakesNamesWithASlashForStreams) {
  const auto pose = session_.create<RecordedPose>("robot/pose", depth_of(4)).value();
  EXPECT_TRUE(contains(output({"info", "robot/pose"}), "robot/pose"));
}

TEST_F(Record, NamesTheStreamsOfWhichItHasOnlyBytes) {
  const auto pose = session_.create<RecordedPose>("pose", depth_of(4)).value();
  const Finished all = ctl({"record", "--for", "1ms", "-o", file_});
  EXPECT_EQ(all.exit_status, 0);
  EXPECT_EQ(all.err, "");
  output({"create", "scan", "--size", "8", "--depth", "4"});
  output({"create", "spur", "--size", "8", "--depth", "4"});
  const Finished bytes = ctl({"record", "--for", "1ms", "-o", folder_.file("b.mcap")});
  EXPECT_EQ(bytes.exit_status, 0);
  const auto lines = lines_of(bytes.err);
  ASSERT_EQ(lines.size(), 1U) << bytes.err;
  EXPECT_TRUE(contains(lines[0], "scan:0@pc1, spur:0@pc1")) << bytes.err;
  EXPECT_FALSE(contains(lines[0], "pose")) << bytes.err;
  EXPECT_TRUE(contains(lines[0], "`dssmctl describe STREAM`")) << bytes.err;
  const Finished one = ctl({"record", "p*", "--for", "1ms", "-o", folder_.file("c.mcap")});
  EXPECT_EQ(one.err, "");
}

// Folders and files that `record -o NAME` makes have names as streams have.
TEST_F(Record, InfoTakesNamesOfRecordingsInTheWorkingDirectory) {
  const auto pose = session_.create<RecordedPose>("pose", depth_of(4)).value();
  std::filesystem::create_directory(folder_.file("drives"));
  output({"record", "--for", "1ms", "-o", folder_.file("drives")});
  output({"record", "--for", "1ms", "-o", folder_.file("bare")});
  std::filesystem::create_directory(folder_.file("empty"));
  std::ofstream(folder_.file("notes")) << "of a meeting\n";
  const auto info = [&](const std::string& name) {
    return dssm::test::run(
        {"sh", "-c", "cd '" + folder_.path() + "' && '" + dssmctl_path() + "' info " + name},
        environment());
  };
  for (const char* name : {"drives", "bare"}) {
    const Finished shown = info(name);
    EXPECT_EQ(shown.exit_status, 0) << shown.err;
    EXPECT_TRUE(contains(shown.out, "files:")) << shown.out;
    EXPECT_TRUE(contains(shown.out, "pose")) << shown.out;
  }
  for (const char* name : {"empty", "notes", "none"}) {
    const Finished none = info(name);
    EXPECT_EQ(none.exit_status, 1);
    EXPECT_TRUE(contains(none.err, std::string("stream '") + name)) << none.err;
  }
  const auto same = session_.create<RecordedPose>("bare", depth_of(4)).value();
  EXPECT_TRUE(contains(info("bare").out, "owner:")) << "a stream comes first";
}

TEST_F(Record, InfoSaysWhyAFolderIsNoRecording) {
  std::ofstream(folder_.file("foreign.mcap")) << "abc";
  const Finished finished = ctl({"info", folder_.path()});
  EXPECT_EQ(finished.exit_status, 1);
  EXPECT_TRUE(contains(finished.err, "foreign.mcap")) << finished.err;
}

TEST_F(Record, InfoFailsWhenNothingCanBeRead) {
  for (const char* content : {"", "\x89MCAP"}) {
    std::ofstream(file_, std::ios::trunc) << content;
    const Finished info = ctl({"info", file_});
    EXPECT_EQ(info.exit_status, 1);
    EXPECT_EQ(info.out, "");
    EXPECT_TRUE(contains(info.err, "has no stream that can be read")) << info.err;
  }
}

// What a ring overwrites while the recorder stands still.
TEST_F(Record, CountsWhatWasLostInTheFile) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(16)).value();
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(pose.id());
  write_poses(pose, 0, 0);
  await_recorded(1);
  running.stop();
  write_poses(pose, 1, 1000);
  running.signal(SIGINT);
  running.signal(SIGCONT);
  EXPECT_EQ(running.status(), 0);
  const Json info = Json::parse(output({"info", file_, "--json"}));
  const std::uint64_t lost = info["lost_samples"], samples = info["samples"];
  EXPECT_EQ(lost + samples, 1001U) << info.dump(2);
  EXPECT_GE(lost, 900U);
  EXPECT_EQ(info["streams"][0]["last_tid"], 1000);
  EXPECT_TRUE(contains(running.rest(), ", " + std::to_string(lost) + " lost"));
}

TEST_F(Record, LeavesAFileThatOpensWhenItIsKilled) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(4096)).value();
  Running running(argv({"record", "-o", file_}), environment());
  await_reader(pose.id());
  write_poses(pose, 0, 499);
  await_recorded(500);
  running.signal(SIGKILL);
  running.status();
  RecordedReader<RecordedPose> reader = recorded(file_, "pose");
  expect_poses(reader, 0, 499);
  EXPECT_TRUE(contains(ctl({"info", file_}).err, "it has no end")) << ctl({"info", file_}).err;
  EXPECT_TRUE(contains(output({"record", "--repair", file_}), "500 samples, completed"));
  EXPECT_EQ(ctl({"info", file_}).err, "");
}

TEST_F(Record, EndsWithAWholeFileWhenTheDiskIsFull) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(100'000)).value();
  std::vector<std::string> words = argv({"record", "--compression", "none", "-o", file_});
  // No file may become longer, which is as a full disk is.
  words.insert(words.begin(), {"env", "--ignore-signal=XFSZ", "prlimit", "--fsize=3000000"});
  Running running(words, environment());
  await_reader(pose.id());
  std::int64_t written = 0;
  const std::string first = running.line([&] {
    if (written == 100'000) return;  // no more than its ring holds, and more than the file can
    write_poses(pose, written, written + 99);
    written += 100;
  });
  const std::string text = first + "\n" + running.rest();
  EXPECT_EQ(running.status(), 1) << text;
  EXPECT_TRUE(contains(text, file_ + "': File too large; nothing more is recorded. ")) << text;
  EXPECT_TRUE(contains(text, "is a whole file with what was written before. Free space")) << text;

  const Recording recording = Recording::open(file_).value();
  EXPECT_EQ(recording.warnings(), std::vector<std::string>());
  const std::uint64_t samples = recording.streams()[0].samples;
  EXPECT_TRUE(contains(text, std::to_string(samples) + " samples of 1 stream, ")) << text;
  RecordedReader<RecordedPose> reader = recorded(file_, "pose");
  EXPECT_GT(samples, 10'000U);
  expect_poses(reader, 0, static_cast<std::int64_t>(samples) - 1);
  EXPECT_FALSE(reader.read_next());
}

TEST_F(Record, EndsInTimeAndShowsNumbersForPrograms) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(64)).value();
  const Json summary = json({"record", "--for", "50ms", "-o", folder_.path()});
  EXPECT_EQ(summary["streams"], 1);
  EXPECT_EQ(summary["samples"], 0);
  const std::string file = summary["file"];
  EXPECT_TRUE(contains(file, "/dssm_20")) << file;
  EXPECT_EQ(Json::parse(output({"info", file, "--json"}))["streams"][0]["stream"], pose.id().str());
}

TEST_F(Record, EndsAtATime) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(64)).value();
  const Time until = WallClock::now() + 2s;
  const std::string text = output(
      {"record", "--until", std::to_string(static_cast<double>(to_ns(until)) / 1e9), "-o", file_});
  EXPECT_GE(WallClock::now(), until);
  EXPECT_TRUE(contains(text, ": 0 samples of 1 stream")) << text;
}

TEST_F(Record, SaysWhatIsWrong) {
  const Finished folder = ctl({"record", "-o", folder_.file("no/a.mcap")});
  EXPECT_EQ(folder.exit_status, 1);
  EXPECT_TRUE(contains(folder.err, "mkdir -p '" + folder_.file("no") + "'")) << folder.err;
  const Finished slash = ctl({"record", "--for", "1ms", "-o", folder_.file("no/")});
  EXPECT_EQ(slash.exit_status, 1);
  EXPECT_TRUE(contains(slash.err, "mkdir -p '" + folder_.file("no/") + "'")) << slash.err;
  EXPECT_EQ(ctl({"record", "--for", "1ms", "-o", file_}).exit_status, 0);
  const Finished again = ctl({"record", "--for", "1ms", "-o", file_});
  EXPECT_EQ(again.exit_status, 1);
  EXPECT_TRUE(contains(again.err, "a file of that name exists")) << again.err;
  const Finished missing = ctl({"info", folder_.file("b.mcap")});
  EXPECT_EQ(missing.exit_status, 1);
  EXPECT_TRUE(contains(missing.err, "b.mcap")) << missing.err;
}

// --- play

class Play : public Record {
 protected:
  // Stream "pose", with a property; returns its number.
  static std::uint32_t add_pose(RecordingWriter& writer) {
    RecordedStream stream{{"pose", 0, "pc9"}, type_of<RecordedPose>(), 512, 1ms, 1, {}};
    stream.property = {std::byte{7}};
    return writer.add_stream(stream).value();
  }
  // Sample `i` of write_poses().
  static void write_pose(RecordingWriter& writer, std::uint32_t stream, std::int64_t i) {
    const RecordedPose pose{0.5 * static_cast<double>(i), -1, i};
    const SampleInfo info{i, at_ns(kSecond + i * 1'000'000), Duration(i), sizeof pose};
    ASSERT_TRUE(writer.write(stream, info, 1us, std::as_bytes(std::span(&pose, 1))));
  }
  // A recording of samples 0 to 99 of write_poses() in stream "pose", with one property, and from
  // sample 50 on another one.
  void make_recording() {
    auto writer = RecordingWriter::create(file_).value();
    const std::uint32_t number = add_pose(writer);
    for (std::int64_t i = 0; i < 100; ++i) {
      if (i == 50) {
        ASSERT_TRUE(writer.set_property(number, std::vector{std::byte{8}}));
      }
      write_pose(writer, number, i);
    }
    ASSERT_TRUE(writer.finish());
  }

  // A sample of a stream of doubles, which is added if it is not there.
  static void write_number(RecordingWriter& writer, const StreamId& id, std::int64_t number,
                           std::uint64_t incarnation = 1) {
    const auto stream =
        writer.add_stream({id, type_of<double>(), 64, 1ms, incarnation, {}}).value();
    const double value = static_cast<double>(number);
    const SampleInfo info{number, at_ns(kSecond + number * 1'000'000), 1us, sizeof value};
    ASSERT_TRUE(writer.write(stream, info, 1us, std::as_bytes(std::span(&value, 1))));
  }
  // Stream "pose" with samples 0 to 2 of write_poses() and a property; then with numbers 3 and 4.
  void make_recording_of_two_types() {
    auto writer = RecordingWriter::create(file_).value();
    const std::uint32_t number = add_pose(writer);
    for (const std::int64_t i : {0, 1, 2}) write_pose(writer, number, i);
    for (const std::int64_t i : {3, 4}) write_number(writer, {"pose", 0, "pc9"}, i, 2);
    ASSERT_TRUE(writer.finish());
  }

  std::vector<std::string> own_streams() {
    std::vector<std::string> names;
    for (const StreamInfo& stream : session_.list_own_streams().value()) {
      names.push_back(stream.id.name);
    }
    return names;
  }

  int property() {  // -1: none
    const auto property = session_.property({"pose", 0, ""});
    return property ? std::to_integer<int>(property->at(0)) : -1;
  }

  void expect_played(const std::string& stream, std::int64_t first, std::int64_t last) {
    auto reader = session_.open_reader<RecordedPose>(stream).value();
    reader.seek(kNoTid);
    for (std::int64_t i = first; i <= last; ++i) {
      const auto sample = reader.read_next();
      ASSERT_TRUE(sample) << i;
      ASSERT_EQ(sample->value.number, i);
      EXPECT_EQ(sample->info.time, at_ns(kSecond + i * 1'000'000));
      EXPECT_EQ(sample->info.clock_error, Duration(i));
    }
    EXPECT_FALSE(reader.read_next());
  }
  void expect_newest_pose(std::int64_t number) {
    EXPECT_EQ(session_.open_reader<RecordedPose>("pose").value().read_newest()->value.number,
              number);
  }
};

TEST_F(Play, GivesBackWhatWasRecorded) {
  make_recording();
  EXPECT_EQ(output({"play", file_}), file_ + ": 100 samples of 1 stream played\n");
  expect_played("pose@pc1", 0, 99);
  const StreamInfo info = session_.stream_info({"pose", 0, ""}).value();
  EXPECT_EQ(info.type, type_of<RecordedPose>());
  EXPECT_EQ(info.depth, 512U);
  EXPECT_EQ(info.cycle, 1ms);
  EXPECT_EQ(property(), 8) << "the one at the end";
}

// Its index is whole, so this is found only while it is played.
TEST_F(Play, SaysThatAPartIsDamaged) {
  make_recording();
  std::string content = text_of(file_);
  constexpr char kChunk = 6;  // MCAP's records: this byte, the length, the content
  for (std::size_t at = 8; at + 9 < content.size();) {
    std::uint64_t bytes = 0;
    std::memcpy(&bytes, &content[at + 1], sizeof bytes);
    if (content[at] == kChunk) content[at + 9 + bytes - 20] ^= 1;
    at += 9 + bytes;
  }
  std::ofstream(file_) << content;
  const Finished played = ctl({"play", file_});
  EXPECT_TRUE(contains(played.err, "'" + file_ + "'")) << played.err << played.out;
  const Finished repaired = ctl({"record", "--repair", file_});
  EXPECT_EQ(repaired.exit_status, 1) << repaired.out;
  EXPECT_TRUE(contains(repaired.out, ": 0 samples, the file has its end, but parts are damaged"))
      << repaired.out;
  EXPECT_TRUE(contains(repaired.err, "100 of the samples of")) << repaired.err;
  const std::string other = folder_.file("other.mcap");
  const Finished converted = ctl({"convert", file_, other});
  EXPECT_EQ(converted.exit_status, 1) << converted.out;
  EXPECT_TRUE(contains(converted.err, "no sample of '" + file_ + "' can be read")) << converted.err;
  EXPECT_FALSE(std::filesystem::exists(other));
}

TEST_F(Play, SaysThatAStreamIsHereWithAnotherType) {
  make_recording();
  (void)session_.create<double>("pose", depth_of(4)).value();
  const Finished played = ctl({"play", file_});
  EXPECT_EQ(played.exit_status, 1);
  EXPECT_TRUE(contains(played.err, "`dssmctl rm pose` removes it, and --map pose=OTHER"))
      << played.err;
}

// It would change the clock under the first one, and both would end early.
TEST_F(Play, RefusesAClockThatAnotherPlayerHas) {
  make_recording();
  for (const std::vector<std::string>& where : {std::vector<std::string>{}, {"--this-host"}}) {
    std::vector<std::string> first = {"play", file_, "--rate", "0.001"},
                             second = {"play", file_, "--map", "pose=copy"};
    first.insert(first.end(), where.begin(), where.end());
    second.insert(second.end(), where.begin(), where.end());
    Running running(argv(first), environment());
    auto clock = session_.open_playback_clock().value();
    await([&] { return clock.setting().speed == 0.001; });
    const Finished refused = ctl(second);
    EXPECT_EQ(refused.exit_status, 1) << refused.out;
    EXPECT_TRUE(contains(refused.err, "its playback clock follows 'dssmctl play@pc1'"))
        << refused.err;
    EXPECT_FALSE(session_.stream_info({"copy", 0, ""}));
    EXPECT_EQ(clock.setting().speed, 0.001);
    running.signal(SIGINT);
    EXPECT_EQ(running.status(), 0);
  }
}

TEST_F(Play, SaysThatTheClockWasSetToAnotherTime) {
  make_recording();
  Running running(argv({"play", file_, "--rate", "0.001"}), environment());
  auto clock = session_.open_playback_clock().value();
  await([&] { return clock.setting().speed == 0.001; });
  clock.set_time(5000);
  EXPECT_EQ(running.status(), 0);
  const std::string text = running.rest();
  EXPECT_TRUE(contains(text, "another program has set the playback clock to 5000.")) << text;
}

// A key would let it run, and there is no terminal.
TEST_F(Play, DoesNotWaitForKeysThatCannotCome) {
  make_recording();
  const Finished refused = ctl({"play", file_, "--now", "--start-paused"});
  EXPECT_EQ(refused.exit_status, 2);
  EXPECT_TRUE(contains(refused.err, "there is no terminal")) << refused.err;
}

TEST_F(Play, SetsThePropertyOfTheTimeAtWhichItIs) {
  make_recording();
  output({"play", file_, "--to", "1.049"});
  EXPECT_EQ(property(), 7);
  output({"play", file_, "--rate", "-1"});
  EXPECT_EQ(property(), 7);
  output({"play", file_, "--from", "1.050", "--rate", "1e6"});
  EXPECT_EQ(property(), 8);
  Running looped(argv({"play", file_, "--loop", "--rate", "0.1"}), environment());
  for (const int expected : {7, 8, 7, 8}) {
    await([&] { return property() == expected; });
  }
  looped.signal(SIGINT);
  EXPECT_EQ(looped.status(), 0);
}

// Where it has no sample for a while, and when none comes any more.
TEST_F(Play, SetsPropertiesOfAStreamWithoutSamples) {
  auto writer = RecordingWriter::create(file_).value();
  RecordedStream stream{{"pose", 0, "pc9"}, type_of<RecordedPose>(), 512, 1ms, 1, {}};
  const auto number = writer.add_stream(stream).value();
  const RecordedPose pose{1, 2, 3};
  for (const std::int64_t tid : {0, 1}) {
    const SampleInfo info{tid, at_ns((1 + 10'000 * tid) * kSecond), Duration(0), sizeof pose};
    ASSERT_TRUE(writer.write(number, info, 1us, std::as_bytes(std::span(&pose, 1))));
  }
  for (const int property : {1, 2}) {
    ASSERT_TRUE(writer.set_property(number, std::vector{static_cast<std::byte>(property)},
                                    at_ns(1000 * property * kSecond)));
  }
  ASSERT_TRUE(writer.set_property(number, std::vector{std::byte{9}}));
  ASSERT_TRUE(writer.finish());
  auto clock = session_.open_playback_clock().value();
  Running running(argv({"play", file_}), environment());
  await([&] { return clock.now_s() < 10; });
  EXPECT_EQ(property(), -1);
  for (const int expected : {1, 2}) {
    clock.set_time(1000 * expected - 0.5);
    await([&] { return property() == expected; });
  }
  clock.set_speed(1e6);
  EXPECT_EQ(running.status(), 0);
  EXPECT_EQ(property(), 9);
}

TEST_F(Play, PlaysAPartUnderAnotherName) {
  make_recording();
  output({"play", file_, "--map", "po*=copy:2", "--from", "1.010", "--to", "-0.05"});
  expect_played("copy:2", 10, 49);
  const Finished nothing = ctl({"play", file_, "--from", "5"});
  EXPECT_EQ(nothing.exit_status, 2);
  EXPECT_TRUE(contains(nothing.err, "goes from 1.000000000 to 1.099000000")) << nothing.err;
  const Finished none = ctl({"play", file_, "camera", "scan*"});
  EXPECT_EQ(none.exit_status, 1);
  EXPECT_TRUE(contains(none.err, "no stream of the recording fits camera, scan*")) << none.err;
  EXPECT_TRUE(contains(none.err, "'" + file_ + "' has pose:0@pc9\n")) << none.err;
}

TEST_F(Play, RefusesAMappingThatAppliesToNoStream) {
  make_recording();
  for (const std::vector<std::string>& mappings :
       {std::vector<std::string>{"pos=copy"}, {"pose=copy", "po*=second"}}) {
    std::vector<std::string> words = {"play", file_};
    for (const std::string& mapping : mappings) words.insert(words.end(), {"--map", mapping});
    const Finished refused = ctl(words);
    EXPECT_EQ(refused.exit_status, 1);
    EXPECT_TRUE(contains(refused.err, "--map " + mappings.back() +
                                          " applies to no stream that is "
                                          "played; '" +
                                          file_ + "' has pose:0@pc9"))
        << refused.err;
    EXPECT_EQ(own_streams(), std::vector<std::string>{}) << "it would be played as itself";
  }
}

TEST_F(Play, CountsTimesFromBothEnds) {
  make_recording();
  output({"play", file_, "--map", "pose=copy", "--from", "+10ms", "--to", "+0.02"});
  expect_played("copy", 10, 20);
  output({"play", file_, "--map", "pose=all", "--from", "-1h", "--to", "+1h"});
  expect_played("all", 0, 99);
}

// Otherwise it would drive the clocks of all hosts to that time and play nothing.
TEST_F(Play, RefusesTimesOutsideOfTheRecording) {
  make_recording();
  for (const std::vector<std::string>& words : std::vector<std::vector<std::string>>{
           {"--from", "0.5"}, {"--to", "100"}, {"--from", "+1h"}, {"--to", "-1h"}}) {
    const Finished refused = ctl({"play", file_, words[0], words[1], "--rate", "1e6"});
    EXPECT_EQ(refused.exit_status, 2) << words[1];
    EXPECT_TRUE(contains(refused.err, "goes from 1.000000000 to 1.099000000")) << refused.err;
    EXPECT_TRUE(contains(refused.err, "+2s is 2 s after its beginning")) << refused.err;
  }
  EXPECT_EQ(ctl({"play", file_, "--from", "+-2s"}).exit_status, 2);
}

// By the clock, so that programs may follow or stop it.
TEST_F(Play, IsPacedByThePlaybackClockAndResetsIt) {
  make_recording();
  auto clock = session_.open_playback_clock().value();
  Running running(argv({"play", file_, "--rate", "0.001"}), environment());
  await([&] { return clock.setting().speed == 0.001 && !clock.setting().paused; });
  EXPECT_LT(clock.now_s(), 1.099);
  clock.set_speed(1e6);
  EXPECT_TRUE(contains(running.rest(), "100 samples of 1 stream played"));
  EXPECT_EQ(running.status(), 0);
  expect_played("pose", 0, 99);
  EXPECT_EQ(clock.setting().offset_s, 0);
  EXPECT_EQ(clock.setting().speed, 1);

  clock.set_paused(true);
  Running stopped(argv({"play", file_, "--rate", "0.001", "--loop"}), environment());
  await([&] { return clock.setting().speed == 0.001; });
  stopped.signal(SIGTERM);
  EXPECT_EQ(stopped.status(), 0);
  EXPECT_EQ(clock.setting().speed, 1);
  EXPECT_FALSE(clock.setting().paused);
}

TEST_F(Play, StampsWithThePresentTimesIfAsked) {
  make_recording();
  const Time before = WallClock::now();
  output({"play", file_, "--now", "--rate", "2"});
  auto reader = session_.open_reader<RecordedPose>("pose").value();
  reader.seek(kNoTid);
  const Time first = reader.read_next()->info.time;
  EXPECT_GE(first, before);
  EXPECT_LE(first, WallClock::now());
  const auto last = reader.read_newest();
  EXPECT_EQ(last->value.number, 99);
  EXPECT_EQ(last->info.time - first, 49'500us);
}

TEST_F(Play, DoesNotWriteBesideAnotherProgram) {
  make_recording();
  auto pose = session_.create<RecordedPose>("pose", depth_of(512)).value();
  const Finished refused = ctl({"play", file_});
  EXPECT_EQ(refused.exit_status, 1);
  EXPECT_TRUE(contains(refused.err, "is written by another program")) << refused.err;
  EXPECT_EQ(pose.newest_tid(), kNoTid);
  output({"play", file_, "--force"});
  expect_played("pose", 0, 99);
}

// A request that is played would be one for the black box of this PC.
TEST_F(Play, LeavesOutTheStreamsOfTheBlackBox) {
  auto writer = RecordingWriter::create(file_).value();
  for (const char* name : {"dssm_trigger", "number", "dssm_incident"}) {
    write_number(writer, {name, 0, "pc9"}, 0);
  }
  ASSERT_TRUE(writer.finish());
  using Names = std::vector<std::string>;
  output({"play", file_});
  output({"play", file_, "*"});
  EXPECT_EQ(own_streams(), Names{"number"});
  output({"play", file_, "--map", "dssm_incident=old"});
  EXPECT_EQ(own_streams(), Names({"number", "old"}));
  output({"play", file_, "dssm_t*"});
  EXPECT_EQ(own_streams(), Names({"number", "old", "dssm_trigger"}));
  const std::string only = folder_.file("b.mcap");
  auto other = RecordingWriter::create(only).value();
  write_number(other, {"dssm_trigger", 0, "pc9"}, 0);
  ASSERT_TRUE(other.finish());
  const Finished none = ctl({"play", only});
  EXPECT_TRUE(contains(none.err, "has only streams of the black box, dssm_trigger:0@pc9;"))
      << none.err;
}

// Else a program that creates one of them with another type would be refused.
TEST_F(Play, LeavesNoEmptyStreamsWhenItFails) {
  auto writer = RecordingWriter::create(file_).value();
  for (const std::int64_t i : {0, 1, 2}) write_number(writer, {"number", 0, "pc9"}, i);
  write_number(writer, {"other", 0, "pc9"}, 3);
  ASSERT_TRUE(writer.finish());
  const Finished nothing = ctl({"play", file_, "number", "--from", "1.003"});
  EXPECT_TRUE(contains(nothing.err, "no sample of these streams is in that part")) << nothing.err;
  EXPECT_EQ(own_streams(), std::vector<std::string>{});
  { const auto other = session_.create<RecordedPose>("other", depth_of(64)).value(); }
  const Finished refused = ctl({"play", file_});
  EXPECT_EQ(refused.exit_status, 1);
  EXPECT_TRUE(contains(refused.err, "'other")) << refused.err;
  EXPECT_EQ(own_streams(), std::vector<std::string>{"other"});
}

TEST_F(Play, LeavesNoEmptyStreamInPlaceOfOneThatItReplaced) {
  make_recording_of_two_types();
  output({"play", file_});
  const StreamInfo before = session_.stream_info({"pose", 0, ""}).value();
  const std::string failing = folder_.file("b.mcap");
  auto writer = RecordingWriter::create(failing).value();
  write_pose(writer, add_pose(writer), 0);
  write_number(writer, {"pose", 0, "pc9"}, 1, 2);
  write_number(writer, {"number", 0, "pc9"}, 2);
  ASSERT_TRUE(writer.finish());
  EXPECT_EQ(before.type.name, type_of<double>().name) << "of the recording's end";
  const Finished failed = ctl({"play", failing, "--map", "number=number@pc9"});
  EXPECT_EQ(failed.exit_status, 1);
  EXPECT_TRUE(contains(failed.err, "pc9")) << failed.err;
  EXPECT_EQ(own_streams(), std::vector<std::string>{});
}

TEST_F(Play, PlaysAStreamThatCameAgainWithAnotherType) {
  make_recording_of_two_types();
  for (int run = 0; run < 2; ++run) {  // the second one finds the stream with the last type
    EXPECT_EQ(output({"play", file_}), file_ + ": 5 samples of 1 stream played\n");
    auto reader = session_.open_reader<double>("pose").value();
    reader.seek(kNoTid);
    for (const double number : {3.0, 4.0}) EXPECT_EQ(reader.read_next()->value, number);
    EXPECT_FALSE(reader.read_next());
    EXPECT_EQ(property(), -1);
  }
  output({"play", file_, "--rate", "-1"});
  expect_newest_pose(0);
  EXPECT_EQ(property(), 7);
  // Another program writes it beside: then the stream stays as it is.
  const auto pose = session_.create<RecordedPose>("pose", depth_of(512)).value();
  const Finished refused = ctl({"play", file_, "--force"});
  EXPECT_EQ(refused.exit_status, 1);
  EXPECT_TRUE(contains(refused.err, "'pose:0@pc1' has another type in the recording"))
      << refused.err;
  expect_newest_pose(2);
}

TEST_F(Play, PlaysBackwards) {
  make_recording();
  output({"play", file_, "--rate", "-1", "--from", "1.010", "--to", "1.020"});
  auto reader = session_.open_reader<RecordedPose>("pose").value();
  reader.seek(kNoTid);
  for (std::int64_t i = 20; i >= 10; --i) {
    const auto sample = reader.read_next();
    ASSERT_TRUE(sample) << i;
    EXPECT_EQ(sample->value.number, i);
    EXPECT_EQ(sample->info.time, at_ns(kSecond + i * 1'000'000));
  }
  EXPECT_FALSE(reader.read_next());
}

// `dssmctl play` on a terminal of its own, in whose foreground it is.
class PlayByKeys : public Play {
 protected:
  PlayByKeys() { make_recording(); }
  ~PlayByKeys() override {
    if (pid_ > 0) ::kill(pid_, SIGKILL), wait_for(pid_);
    if (terminal_ >= 0) ::close(terminal_);
  }

  void play(std::vector<std::string> words) {
    words.insert(words.begin(), {dssmctl_path(), "play", file_});
    std::vector<char*> argv;
    for (std::string& word : words) argv.push_back(word.data());
    argv.push_back(nullptr);
    std::string socket = environment().front();
    pid_ = ::forkpty(&terminal_, nullptr, nullptr, nullptr);
    if (pid_ == 0) {
      ::putenv(socket.data());
      ::execv(argv[0], argv.data());
      ::_exit(127);
    }
    await([&] { return clock_.setting().paused && clock_.now_s() < 2; });
    reader_ = session_.open_reader<RecordedPose>("pose").value();
    reader_->seek(kNoTid);
  }
  void press(std::string_view key) {
    ASSERT_EQ(::write(terminal_, key.data(), key.size()), static_cast<ssize_t>(key.size()));
  }
  // What it prints must be read, or it stands still.
  std::string read_some() {
    pollfd input{terminal_, POLLIN, 0};
    std::string text;
    char buffer[4096];
    while (::poll(&input, 1, 0) > 0) {
      const ssize_t got = ::read(terminal_, buffer, sizeof buffer);
      if (got <= 0) break;
      text.append(buffer, static_cast<std::size_t>(got));
    }
    shown_ += text;
    return text;
  }
  void expect_next(std::int64_t number) {
    for (;;) {
      read_some();
      const auto sample = reader_->read_next();
      if (!sample) {
        ASSERT_NE(reader_->wait(kWatchdog), WaitStatus::timeout) << number << shown_;
        continue;
      }
      EXPECT_EQ(sample->value.number, number);
      EXPECT_EQ(sample->info.time, at_ns(kSecond + number * 1'000'000));
      return;
    }
  }

  static constexpr std::string_view kRight = "\x1b[C", kLeft = "\x1b[D", kUp = "\x1b[A",
                                    kPageDown = "\x1b[6~", kHome = "\x1b[H";
  static constexpr Duration kWatchdog = 60s;
  PlaybackClock clock_ = session_.open_playback_clock().value();
  std::optional<Reader<RecordedPose>> reader_;
  std::string shown_;
  pid_t pid_ = -1;
  int terminal_ = -1;
};

TEST_F(PlayByKeys, StepsInBothDirections) {
  play({"--start-paused"});
  for (const std::int64_t number : {0, 1, 2}) press(kRight), expect_next(number);
  EXPECT_NEAR(clock_.now_s(), 1.002, 1e-6);
  for (const std::int64_t number : {1, 0}) press(kLeft), expect_next(number);
  press(kLeft);  // there is none
  for (const std::int64_t number : {1, 2}) press(kRight), expect_next(number);
  EXPECT_NEAR(clock_.now_s(), 1.002, 1e-6);
  EXPECT_TRUE(contains(shown_, "Space: pause")) << shown_;
  press("q");
  EXPECT_EQ(wait_for(std::exchange(pid_, -1)), 0);
  EXPECT_FALSE(clock_.setting().paused);
}

TEST_F(PlayByKeys, JumpsAndGivesWhatTheStreamsHadThen) {
  play({"--start-paused"});
  EXPECT_EQ(property(), 7);
  clock_.set_time(1.0505);  // as another program may do
  expect_next(50);
  EXPECT_EQ(property(), 8);
  press(kRight), expect_next(51);
  press(kLeft), expect_next(50);
  press(kLeft), expect_next(49);
  EXPECT_EQ(property(), 7);
  press(kRight), expect_next(50);
  EXPECT_EQ(property(), 8);
  press(kRight), expect_next(51);
  press(kHome), expect_next(0);
  EXPECT_EQ(property(), 7);
  press(kRight), expect_next(1);
  press(kPageDown), expect_next(99);  // to the end, where it stays while it is paused
  press(" ");
  EXPECT_EQ(wait_for(std::exchange(pid_, -1)), 0);
  EXPECT_FALSE(reader_->read_next());
}

TEST_F(PlayByKeys, ChangesSpeedAndDirection) {
  play({"--start-paused", "--rate", "0.001"});
  press(kUp);
  await([&] { return std::fabs(clock_.setting().speed - 0.0011) < 1e-9; });
  press("r");
  await([&] { return std::fabs(clock_.setting().speed + 0.0011) < 1e-9; });
  press("r");
  for (const std::int64_t number : {0, 1, 2}) press(kRight), expect_next(number);
  press("r");
  press(" ");
  await([&] { return !clock_.setting().paused; });
  clock_.set_speed(-1000);
  for (const std::int64_t number : {2, 1, 0}) expect_next(number);
  EXPECT_EQ(wait_for(std::exchange(pid_, -1)), 0);
}

// Changes come 50 ms after their keys, on all hosts at the same moment.
TEST_F(PlayByKeys, LeavesOutWhatAJumpSkippedWhenAKeyFollowsIt) {
  play({"--start-paused", "--rate", "0.001"});
  press(" ");
  await([&] { return !clock_.setting().paused; });
  expect_next(0);
  clock_.set_time(1.0905);  // as another program may do
  press(" ");
  std::int64_t number = 0;
  await([&] {
    read_some();
    while (const auto sample = reader_->read_next()) {
      number = sample->value.number;
      EXPECT_TRUE(number < 45 || number >= 90) << number;  // one is due each second
    }
    return clock_.setting().paused && number >= 90;
  });
}

TEST_F(PlayByKeys, PlaysAllThatIsDueUntilItIsPausedOrTurns) {
  play({"--start-paused", "--loop", "--rate", "0.1"});
  // By the clock at that time.
  const auto due = [](double now_s) {
    return std::min<std::int64_t>((std::llround(now_s * 1e9) - kSecond) / 1'000'000, 99);
  };
  const auto newest = [&] {
    read_some();
    const auto sample = reader_->read_newest();
    return sample ? sample->value.number : -1;
  };
  const auto await_pause = [&] {
    double before = 0;
    Time asked_before = WallClock::now();
    await([&] {
      const Time asked = WallClock::now();
      const double now = clock_.now_s();
      // Not even for the next sample; but after the last one, which may have come since it was
      // asked before, all begins again.
      const std::chrono::duration<double> passed = WallClock::now() - asked_before;
      EXPECT_TRUE(now >= before || before + 0.1 * passed.count() >= 1.0989)
          << before << " " << now << " after " << passed.count() << " s";
      before = now;
      asked_before = asked;
      newest();
      return clock_.setting().paused;
    });
    await([&] { return newest() == due(clock_.now_s()); });
  };
  for (const std::string_view key : {std::string_view(" "), kRight}) {
    press(" ");
    await([&] { return !clock_.setting().paused && newest() >= 10; });
    press(key);
    await_pause();
  }
  press(" ");
  await([&] { return !clock_.setting().paused && newest() >= 10; });
  const Tid first = reader_->read_newest()->info.tid;
  press("r");
  std::int64_t turned_at = 0;
  await([&] {
    turned_at = due(clock_.now_s());
    newest();
    return clock_.setting().speed < 0;
  });
  press("q");
  EXPECT_EQ(wait_for(std::exchange(pid_, -1)), 0);
  std::int64_t greatest = newest();
  while (const auto sample = reader_->read_previous()) {
    if (sample->info.tid < first) break;
    greatest = std::max(greatest, sample->value.number);
  }
  EXPECT_GE(greatest, turned_at);
}

TEST_F(PlayByKeys, HasTheTypeThatTheStreamHadThen) {
  std::filesystem::remove(file_);
  make_recording_of_two_types();
  play({"--start-paused"});
  const auto await_newest = [&]<class T>(const T&, std::int64_t number) {
    await([&] {
      read_some();
      auto reader = session_.open_reader<T>("pose");
      if (!reader) return false;
      const auto sample = reader->read_newest();
      if (!sample) return false;
      if constexpr (std::is_same_v<T, double>) return sample->value == static_cast<double>(number);
      if constexpr (!std::is_same_v<T, double>) return sample->value.number == number;
    });
  };
  const auto await_pose = [&](std::int64_t number) { await_newest(RecordedPose{}, number); };
  const auto await_number = [&](std::int64_t number) { await_newest(double{}, number); };
  for (const std::int64_t number : {0, 1, 2}) press(kRight), await_pose(number);
  press(kRight), await_number(3);
  press(kLeft), await_pose(2);
  EXPECT_EQ(property(), 7);
  press(kRight), await_number(3);
  EXPECT_EQ(property(), -1);
  press(kHome), await_pose(0);
  press(kPageDown), await_number(4);
  press("q");
  EXPECT_EQ(wait_for(std::exchange(pid_, -1)), 0);
}

// play(record(x)) is x: `origin_` has the streams, and daemon_ gets them.
class RoundTrip : public PlayByKeys {
 protected:
  static constexpr std::int64_t kSamples = 60;

  // Which stream sample number `i` of all is of, and with which clock error.
  static bool is_of_pose(std::int64_t i) { return i % 3 != 1; }
  static Duration clock_error_of(std::int64_t i) {
    return i % 5 == 0 ? kUnknownClockError : Duration(1000 + i * i);
  }
  static Time time_of(std::int64_t i) { return at_ns(kSecond + i * 10'000'001); }

  // All that a recording has of its samples, in their order.
  struct Sample {
    std::string stream;
    SampleInfo info;
    Duration bound;
    std::vector<std::byte> payload;
    friend bool operator==(const Sample& a, const Sample& b) {
      return a.stream == b.stream && a.info.tid == b.info.tid && a.info.time == b.info.time &&
             a.info.clock_error == b.info.clock_error && a.bound == b.bound &&
             a.payload == b.payload;
    }
  };
  static std::vector<Sample> samples_in(const Recording& recording) {
    std::vector<Sample> all;
    RecordingCursor cursor = recording.cursor();
    for (RecordedSample sample; cursor.next(sample);) {
      all.push_back({recording.streams()[sample.stream].id.str(),
                     sample.info,
                     sample.clock_error,
                     {sample.payload.begin(), sample.payload.end()}});
    }
    return all;
  }

  DaemonProcess origin_;
  Session there_ = session_with(origin_);
};

TEST_F(RoundTrip, OfRecordAndPlayKeepsAll) {
  const std::string first = folder_.file("first.mcap"), second = folder_.file("second.mcap");
  // Between them samples are written.
  const std::vector<std::pair<std::string, std::string>> changes = {
      {"p0", ""}, {"p1", "b1"}, {"", "b2"}, {"p3", ""}};
  const auto properties_of = [](const std::string& file) {
    return std::pair(properties_in(file, "pose"), properties_in(file, "blob"));
  };
  {
    auto pose = there_.create<RecordedPose>("pose", depth_of(128)).value();
    const TypeInfo opaque{"", 24, 1, {}};
    auto blob = there_.create_raw({"blob", 2, ""}, opaque, {64, 7ms}).value();
    ASSERT_TRUE(pose.set_property(bytes_of(changes[0].first)));
    Running record(argv({"record", "-o", first}), {origin_.environment()});
    for (const StreamId& id : {pose.id(), blob.id()}) {
      await([&] { return there_.stream_info(id).value().readers >= 1; });
    }
    std::size_t set_pose = 1, set_blob = 0;
    for (std::int64_t i = 0; i < kSamples; ++i) {
      if (is_of_pose(i)) {
        pose.write({static_cast<double>(i), -0.5, i}, time_of(i), clock_error_of(i));
      } else {
        std::vector<std::byte> payload(24, static_cast<std::byte>(i));
        blob.write(payload, time_of(i), clock_error_of(i));
      }
      if (i % 20 != 19) continue;
      // One that is replaced at once may be missed.
      await([&] {
        const auto [of_pose, of_blob] = properties_of(first);
        return of_pose.size() == set_pose && of_blob.size() == set_blob;
      });
      const auto& [to_pose, to_blob] = changes[static_cast<std::size_t>(i / 20 + 1)];
      ASSERT_TRUE(pose.set_property(bytes_of(to_pose)));
      ASSERT_TRUE(blob.set_property(bytes_of(to_blob)));
      ++set_pose, ++set_blob;
    }
    await([&] { return properties_of(first).second.size() == set_blob; });
    record.signal(SIGINT);
    EXPECT_EQ(record.status(), 0);
  }
  using Texts = std::vector<std::string>;
  EXPECT_EQ(properties_of(first),
            std::pair(Texts({"0 p0", "13 p1", "27 ", "40 p3"}), Texts({"7 b1", "13 b2", "20 "})));

  file_ = first;
  play({"--start-paused"});
  Running record(argv({"record", "-o", second}), environment());
  await([&] {
    const Result<Recording> begun = Recording::open(second);
    return begun && begun->streams().size() == 2;
  });
  for (std::int64_t i = 0; i < kSamples; ++i) {
    press(kRight);
    // Each property came with the first sample after it.
    if (i % 20 != 19) continue;
    const auto changed = static_cast<std::size_t>(i / 20);
    await([&] {
      read_some();
      const auto [of_pose, of_blob] = properties_of(second);
      return of_pose.size() == changed + 1 && of_blob.size() == changed;
    });
  }
  press(" ");  // to the end
  EXPECT_EQ(wait_for(std::exchange(pid_, -1)), 0);
  await([&] { return properties_of(second).second.size() == 3; });
  record.signal(SIGINT);
  EXPECT_EQ(record.status(), 0);

  EXPECT_EQ(properties_of(second), properties_of(first));
  const Recording one = Recording::open(first).value(), other = Recording::open(second).value();
  const std::vector<Sample> samples = samples_in(one);
  EXPECT_EQ(samples.size(), 60U);
  EXPECT_EQ(std::ranges::count(samples, "pose:0@pc1", &Sample::stream), 40);
  EXPECT_TRUE(samples_in(other) == samples);
  ASSERT_EQ(other.streams().size(), 2U);
  for (const RecordedStreamInfo& stream : one.streams()) {
    const auto played = std::ranges::find(other.streams(), stream.id, &RecordedStreamInfo::id);
    ASSERT_NE(played, other.streams().end()) << stream.id.str();
    EXPECT_EQ(played->type, stream.type);
    EXPECT_EQ(played->depth, stream.depth);
    EXPECT_EQ(played->cycle, stream.cycle);
    EXPECT_EQ(played->lost_samples, 0U);
  }
}

class RecordFleet : public FleetTest {
 protected:
  TestFolder folder_;
};

TEST_F(RecordFleet, HasThePropertiesOfStreamsOfOtherHosts) {
  const std::string file = folder_.file("a.mcap");
  auto there = on_pc2_.create<RecordedPose>("pose", depth_of(4096)).value();
  await_streams(1);
  Running running(argv({"record", "-o", file}), environment());
  std::int64_t next = 0;  // sample; of which the first ones are before the recording
  await([&] {
    write_poses(there, next, next);
    ++next;
    const Result<Recording> recording = Recording::open(file);
    return recording && !recording->streams().empty() && recording->streams()[0].samples > 0;
  });
  ASSERT_TRUE(there.set_property(bytes_of("calibrated")));
  write_poses(there, next, next + 9);
  await([&] { return !properties_in(file, "pose").empty(); });
  running.signal(SIGINT);
  EXPECT_EQ(running.status(), 0);
  const Recording recording = Recording::open(file).value();
  EXPECT_EQ(recording.streams()[0].property_times, std::vector{at_ns(kSecond + next * 1'000'000)});
  EXPECT_EQ(recording.property(0, 0).value(), bytes_of("calibrated"));
}

TEST_F(RecordFleet, PlaysHereWhatAnotherHostWritesNow) {
  const std::string file = folder_.file("a.mcap");
  auto there = on_pc2_.create<RecordedPose>("pose", depth_of(4)).value();
  await_streams(1);
  auto writer = RecordingWriter::create(file).value();
  const auto number =
      writer.add_stream({{"pose", 0, "pc2"}, type_of<RecordedPose>(), 64, 1ms, 1, {}}).value();
  const RecordedPose pose{1, 2, 3};
  ASSERT_TRUE(writer.write(number, {0, at_ns(kSecond), 1us, sizeof pose}, 1us,
                           std::as_bytes(std::span(&pose, 1))));
  ASSERT_TRUE(writer.finish());
  output({"play", file});
  EXPECT_EQ(session_.open_reader<RecordedPose>("pose@pc1").value().read_newest()->value.number, 3);
  EXPECT_EQ(there.newest_tid(), kNoTid);
}

TEST_F(RecordFleet, PlaysOnTheHostsOfTheStreams) {
  const std::string file = folder_.file("a.mcap");
  auto writer = RecordingWriter::create(file).value();
  for (const char* host : {"pc2", "pc3"}) {
    const auto number =
        writer.add_stream({{"pose", 0, host}, type_of<RecordedPose>(), 64, 1ms, 1, {}}).value();
    const RecordedPose pose{1, 2, 3};
    ASSERT_TRUE(writer.write(number, {0, at_ns(kSecond), 1us, sizeof pose}, 1us,
                             std::as_bytes(std::span(&pose, 1))));
  }
  ASSERT_TRUE(writer.finish());
  EXPECT_TRUE(contains(ctl({"play", file}).err, "are both to be played as 'pose'"));
  output({"play", file, "--on-hosts"});
  for (Session* session : {&on_pc2_, &on_pc3_}) {
    auto reader = session->open_reader<RecordedPose>("pose").value();
    ASSERT_EQ(reader.wait_for_tid(0, kNever), WaitStatus::ready);
    EXPECT_EQ(reader.read_newest()->value.number, 3);
  }
}

TEST_F(RecordFleet, LeavesNoEmptyStreamsOnHostsWhenOneIsDown) {
  const std::string file = folder_.file("a.mcap");
  auto writer = RecordingWriter::create(file).value();
  for (const char* host : {"pc2", "pc9"}) {
    ASSERT_TRUE(writer.add_stream({{"pose", 0, host}, type_of<RecordedPose>(), 64, 1ms, 1, {}}));
  }
  const auto number =
      writer.add_stream({{"pose", 0, "pc2"}, type_of<RecordedPose>(), 64, 1ms, 1, {}}).value();
  const RecordedPose pose{1, 2, 3};
  ASSERT_TRUE(writer.write(number, {0, at_ns(kSecond), 1us, sizeof pose}, 1us,
                           std::as_bytes(std::span(&pose, 1))));
  ASSERT_TRUE(writer.finish());
  const Finished failed = ctl({"play", file, "--on-hosts"});
  EXPECT_EQ(failed.exit_status, 1);
  EXPECT_TRUE(contains(failed.err, "pc9")) << failed.err;
  EXPECT_TRUE(on_pc2_.list_own_streams().value().empty());
}

// The playback clocks of all hosts while a recording is played.
class PlayFleet : public RecordFleet {
 protected:
  PlaybackClock here_ = session_.open_playback_clock().value();
  PlaybackClock there_ = on_pc2_.open_playback_clock().value();

  // That both show the same, for as long as `condition` is not met.
  void expect_equal_until(const std::function<bool()>& condition) {
    await([&] {
      const double before = here_.now_s(), other = there_.now_s(), after = here_.now_s();
      EXPECT_GE(other, std::min(before, after) - 1e-6);
      EXPECT_LE(other, std::max(before, after) + 1e-6);
      return condition() || HasFailure();
    });
  }
};

TEST_F(PlayFleet, ClocksOfAllHostsChangeAtTheSameMoment) {
  const auto change = [&](auto time_s, auto speed, auto paused) {
    here_.change_at(WallClock::now() + 200ms, time_s, speed, paused);
    const auto followers = session_.share_playback_clock(17).value();
    ASSERT_EQ(followers.size(), 2U);
    EXPECT_EQ(followers[0].host, "pc2");
    EXPECT_FALSE(followers[0].error) << followers[0].error->message;
    const auto next = here_.next_setting();
    expect_equal_until([&] { return here_.setting() == next && there_.setting() == next; });
  };
  change(100.0, 1.0, false);
  change(std::nullopt, 50.0, std::nullopt);
  change(std::nullopt, -3.0, std::nullopt);
  change(std::nullopt, std::nullopt, true);
  change(7.0, 1000.0, false);
  EXPECT_GT(there_.now_s(), 7);
  EXPECT_EQ(on_pc3_.open_playback_clock().value().setting(), here_.setting());
  EXPECT_TRUE(session_.share_playback_clock(17, true));
  await([&] { return there_.setting() == PlaybackClock::Setting{}; });
}

TEST_F(PlayFleet, OneDriverAtATime) {
  here_.set_speed(3);
  ASSERT_TRUE(session_.share_playback_clock(1));
  EXPECT_EQ(there_.setting().speed, 3);
  EXPECT_EQ(session_.share_playback_clock(2).error().code, Errc::conflict);
  const auto followers = on_pc3_.share_playback_clock(3);
  ASSERT_FALSE(followers);
  EXPECT_TRUE(contains(followers.error().message, "follows 'the test@pc1'"))
      << followers.error().message;
  ASSERT_TRUE(session_.share_playback_clock(1, true));
  ASSERT_TRUE(session_.share_playback_clock(2));
}

TEST_F(PlayFleet, AClockThatFollowsIsNotChangedInVain) {
  const auto set_there = [&] {
    return run(argv({"playback", "set", "--speed", "3"}), {pc2_.environment()});
  };
  Finished finished;
  await([&] {  // the lease may end before dssmctl has asked
    EXPECT_TRUE(session_.share_playback_clock(1));
    return (finished = set_there()).exit_status == 1;
  });
  EXPECT_EQ(
      finished.err,
      "dssmctl: playback set: change the playback clock of 'pc2': it follows 'the test@pc1', which "
      "would undo the change within a second; use `dssmctl playback` on 'pc1', or end that "
      "program\n");
  EXPECT_EQ(there_.setting(), PlaybackClock::Setting{});
  EXPECT_EQ(run(argv({"playback"}), {pc2_.environment()}).exit_status, 0) << "shows it";
  await([&] {  // the end of the lease undoes it
    EXPECT_TRUE(session_.share_playback_clock(1));
    output({"playback", "set", "--speed", "2"});  // on the driver's host
    return here_.setting().speed == 2;
  });
  await([&] {  // an answer that takes long is not waited for
    EXPECT_TRUE(session_.share_playback_clock(1, true));
    return set_there().exit_status == 0;
  });
  EXPECT_EQ(there_.setting().speed, 3);
}

TEST_F(PlayFleet, FollowsAPlayerAndForgetsOneThatIsGone) {
  const std::string file = folder_.file("a.mcap");
  auto writer = RecordingWriter::create(file).value();
  const auto number =
      writer.add_stream({{"pose", 0, "pc9"}, type_of<RecordedPose>(), 64, 1ms, 1, {}}).value();
  for (std::int64_t i = 0; i < 2; ++i) {
    const RecordedPose pose{1, 2, i};
    ASSERT_TRUE(writer.write(number, {i, at_ns((1 + i) * kSecond), 1us, sizeof pose}, 1us,
                             std::as_bytes(std::span(&pose, 1))));
  }
  ASSERT_TRUE(writer.finish());
  {
    Running running(argv({"play", file, "--rate", "0.001"}), environment());
    await([&] { return there_.setting().speed == 0.001 && !there_.setting().paused; });
    EXPECT_EQ(there_.setting(), here_.setting());
    here_.set_speed(1e6);  // as another program may do
    EXPECT_EQ(running.status(), 0);
    await([&] { return there_.setting() == PlaybackClock::Setting{}; });
  }
  Running alone(argv({"play", file, "--rate", "0.001", "--this-host"}), environment());
  await([&] { return here_.setting().speed == 0.001; });
  EXPECT_EQ(there_.setting(), PlaybackClock::Setting{});
  alone.signal(SIGINT);
  EXPECT_EQ(alone.status(), 0);
  Running killed(argv({"play", file, "--rate", "0.001"}), environment());
  await([&] { return there_.setting().speed == 0.001; });
  killed.signal(SIGKILL);
  killed.status();
  await([&] { return there_.setting() == PlaybackClock::Setting{}; });
  await([&] { return here_.setting() == PlaybackClock::Setting{}; });
}

TEST_F(RecordFleet, TakesOnlyStreamsOfAHostIfAsked) {
  auto here = session_.create<RecordedPose>("pose", depth_of(64)).value();
  auto there = on_pc2_.create<RecordedPose>("pose", depth_of(64)).value();
  await_streams(1);
  here.write({0, 0, 1});
  there.write({0, 0, 2});
  const std::string file = folder_.file("a.mcap");
  output({"record", "--past", "1h", "--host", "pc2", "-o", file});
  const Recording recording = Recording::open(file).value();
  ASSERT_EQ(recording.streams().size(), 1U);
  EXPECT_EQ(recording.streams()[0].id.str(), "pose:0@pc2");
  EXPECT_EQ(recording.streams()[0].samples, 1U);
}

TEST_F(RecordFleet, CountsThePastOfAnotherHostFromNow) {
  auto there = on_pc2_.create<RecordedPose>("there", depth_of(1024)).value();
  await_streams(1);
  const Time now = WallClock::now();
  for (int i = 0; i < 100; ++i) there.write({0, 0, i}, now - 5s + i * 1ms);
  const std::string text =
      output({"record", "--past", "1s", "there", "-o", folder_.file("a.mcap")});
  EXPECT_TRUE(contains(text, ": 0 samples of 1 stream")) << text;
}

TEST_F(RecordFleet, TakesThePastOfAllHosts) {
  auto here = session_.create<RecordedPose>("here", depth_of(1024)).value();
  auto there = on_pc2_.create<RecordedPose>("there", depth_of(1024)).value();
  await_streams(1);
  const Time now = WallClock::now();
  for (int i = 0; i < 500; ++i) {
    here.write({0, 0, i}, now - 1s + i * 1ms);
    there.write({0, 0, i}, now - 1s + i * 1ms);
  }
  const std::string file = folder_.file("a.mcap");
  output({"record", "--past", "1h", "-o", file});
  const Recording recording = Recording::open(file).value();
  for (const char* name : {"here@pc1", "there@pc2"}) {
    auto reader = recording.open_reader<RecordedPose>(name).value();
    for (int i = 0; i < 500; ++i) {
      const auto sample = reader.read_next();
      ASSERT_TRUE(sample) << name << " " << i;
      EXPECT_EQ(sample->value.number, i);
    }
  }
}

}  // namespace
}  // namespace dssm::test
