// SPDX-License-Identifier: Apache-2.0
//
// dssmctl record, and what info shows of a recording.
#include <signal.h>

#include <dssm/recording.hpp>
#include <filesystem>

#include "tests/process/dssmctl/fleet_test.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

struct RecordedPose {
  double x, y;
  std::int64_t number;
};
DSSM_DESCRIBE(RecordedPose, x, y, number)

// A folder of its own for files.
class TestFolder {
 public:
  std::string file(const std::string& name) const { return path_ / name; }
  std::string path() const { return path_; }
  TestFolder() {
    std::string name = std::filesystem::temp_directory_path() / "dssm-record-XXXXXX";
    if (!::mkdtemp(name.data())) std::abort();
    path_ = name;
  }
  TestFolder(const TestFolder&) = delete;
  TestFolder& operator=(const TestFolder&) = delete;
  ~TestFolder() { std::filesystem::remove_all(path_); }

 private:
  std::filesystem::path path_;
};

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

TEST_F(Record, OfThePastTakesWhatTheRingsHoldOfThatTimeAndEnds) {
  auto pose = session_.create<RecordedPose>("pose", depth_of(256)).value();
  const Time now = WallClock::now();
  for (int i = 0; i < 100; ++i) pose.write({0, 0, i}, now - 100s + i * 1s);
  const std::string text = output({"record", "--past", "30.5s", "-o", file_});
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

TEST_F(Record, SaysWhatIsWrong) {
  const Finished folder = ctl({"record", "-o", folder_.file("no/a.mcap")});
  EXPECT_EQ(folder.exit_status, 1);
  EXPECT_TRUE(contains(folder.err, "no/a.mcap")) << folder.err;
  EXPECT_EQ(ctl({"record", "--for", "1ms", "-o", file_}).exit_status, 0);
  const Finished again = ctl({"record", "--for", "1ms", "-o", file_});
  EXPECT_EQ(again.exit_status, 1);
  EXPECT_TRUE(contains(again.err, "a file of that name exists")) << again.err;
  const Finished missing = ctl({"info", folder_.file("b.mcap")});
  EXPECT_EQ(missing.exit_status, 1);
  EXPECT_TRUE(contains(missing.err, "b.mcap")) << missing.err;
}

class RecordFleet : public FleetTest {
 protected:
  TestFolder folder_;
};

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
