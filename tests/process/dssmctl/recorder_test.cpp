// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl record does while it reads no ring: here the test decides when it reads.
#include "client/dssmctl/recorder.hpp"

#include <sys/stat.h>
#include <unistd.h>

#include <csignal>
#include <dssm/recording.hpp>
#include <filesystem>
#include <fstream>
#include <optional>
#include <thread>

#include "tests/process/dssmctl/fleet_test.hpp"
#include "tests/support/folder.hpp"

namespace dssm::test {
namespace {

using namespace std::chrono_literals;

// How many parts of its rings this process, with the recorder and the test's writers, has mapped.
std::size_t mapped_parts(const StreamId& id) {
  std::ifstream maps("/proc/self/maps");
  std::size_t parts = 0;
  for (std::string line; std::getline(maps, line);) {
    parts += contains(line, "dssm-ring:" + id.str() + "#");
  }
  return parts;
}

class RecorderOf : public CtlTest {
 protected:
  // Until it has the stream open. Nothing is taken then until the test does.
  void start(const StreamId& id, const RecordingOptions& how = {}) {
    recorder_ =
        ctl::Recorder::start(session_with(daemon_), RecordingWriter::create(file_, how).value(),
                             {ctl::StreamFilter({}, {}), {}, {}, {}, false})
            .value();
    await_opened(id);
    // dssmd counts the reader before the recorder has the ring.
    await([&] { return recorder_->take() && recorder_->streams() == 1; });
  }
  void await_opened(const StreamId& id) {
    await([&] { return session_.stream_info(id).value().readers == 1; });
  }
  // A stream named "again" that has `samples` samples, in place of the one before.
  template <Payload T>
  RawWriter replace(int samples, std::uint64_t depth = 64) {
    (void)session_.remove({"again", 0, ""});
    RawWriter writer = session_.create_raw({"again", 0, ""}, type_of<T>(), depth_of(depth)).value();
    for (int i = 0; i < samples; ++i) {
      const T value = static_cast<T>(i);
      writer.write(std::as_bytes(std::span(&value, 1)));
    }
    return writer;
  }

  // Ends the recording: of so many samples it has some, and counts the others as lost.
  void finish_and_count(std::uint64_t written) {
    ASSERT_TRUE(recorder_->finish());
    const RecordingProgress progress = recorder_->progress();
    EXPECT_GT(progress.samples, 0U);
    EXPECT_EQ(progress.samples + progress.lost_samples, written);
  }
  // Of each stream in the file.
  std::vector<std::uint64_t> recorded_samples() const {
    const Recording recording = Recording::open(file_).value();
    std::vector<std::uint64_t> samples;
    for (const RecordedStreamInfo& stream : recording.streams()) samples.push_back(stream.samples);
    return samples;
  }

  TestFolder folder_;
  std::string file_ = folder_.file("a.mcap");
  std::unique_ptr<ctl::Recorder> recorder_;
};

// The reader of the first one could continue with the last one, too.
TEST_F(RecorderOf, AStreamHasAllTypesThatItHadInATurn) {
  RawWriter writer = replace<double>(0);
  start(writer.id());
  writer = replace<float>(5);
  await_opened(writer.id());
  writer = replace<std::int64_t>(6);
  await_opened(writer.id());
  writer = replace<double>(7);
  await_opened(writer.id());
  ASSERT_TRUE(recorder_->finish());
  EXPECT_EQ(recorder_->streams(), 1U);
  EXPECT_EQ(recorder_->take_notices(),
            std::vector<std::string>(3,
                                     "'again:0@pc1' is opened again: its samples are of "
                                     "another type now"));
  EXPECT_EQ(recorded_samples(), (std::vector<std::uint64_t>{0, 5, 6, 7}));
  EXPECT_EQ(recorder_->progress().lost_samples, 0U);
}

TEST_F(RecorderOf, AStreamOfAnotherTypeLosesWhatItsRingOverwroteBeforeItWasOpened) {
  RawWriter writer = replace<double>(0);
  start(writer.id());
  writer = replace<float>(1000, 8);
  await_opened(writer.id());
  finish_and_count(1000);
}

TEST_F(RecorderOf, AStreamThatIsCreatedAgainTwiceMeanwhileHasAllSamples) {
  RawWriter writer = replace<double>(0);
  start(writer.id());
  writer = replace<double>(5);
  await_opened(writer.id());
  writer = replace<double>(6);
  await_opened(writer.id());
  ASSERT_TRUE(recorder_->finish());
  EXPECT_EQ(recorder_->streams(), 1U);
  EXPECT_EQ(recorder_->take_notices(), std::vector<std::string>());
  EXPECT_EQ(recorded_samples(), (std::vector<std::uint64_t>{0, 5, 6}));
}

TEST_F(RecorderOf, AStreamThatWasRemovedDoesNotKeepItsRing) {
  RawWriter writer = replace<double>(0);
  ctl::RecorderPlan plan{ctl::StreamFilter({}, {}), {}, {}, {}, false};
  plan.keep_removed = {};
  recorder_ =
      ctl::Recorder::start(session_with(daemon_), RecordingWriter::create(file_).value(), plan)
          .value();
  await([&] { return recorder_->take() && recorder_->streams() == 1; });
  const StreamId id = writer.id();
  {
    RawWriter removed = std::move(writer);
    const double value = 0;
    for (int i = 0; i < 5; ++i) removed.write(std::as_bytes(std::span(&value, 1)));
    ASSERT_TRUE(session_.remove(id));
  }
  EXPECT_GT(mapped_parts(id), 0U);
  await([&] { return recorder_->take() && mapped_parts(id) == 0; });
  EXPECT_EQ(recorder_->streams(), 1U) << "that the file has";
  EXPECT_TRUE(recorder_->streams_without_fields().empty());
  writer = replace<double>(6);
  await([&] { return recorder_->take() && recorder_->progress().samples == 11; });
  ASSERT_TRUE(recorder_->finish());
  EXPECT_EQ(recorder_->streams(), 1U);
  EXPECT_EQ(recorded_samples(), (std::vector<std::uint64_t>{5, 6}));
  EXPECT_EQ(recorder_->progress().lost_samples, 0U);
}

TEST_F(RecorderOf, AStreamThatComesLaterLosesWhatItsRingOverwroteBeforeItWasOpened) {
  RawWriter other = session_.create_raw({"other", 0, ""}, type_of<double>(), depth_of(8)).value();
  start(other.id());
  const RawWriter writer = replace<float>(1000, 8);
  await_opened(writer.id());
  finish_and_count(1000);
}

// As new samples do, those of the past may wait in their ring for others.
TEST_F(RecorderOf, ThePastLosesWhatItsRingOverwroteAfterItWasOpened) {
  RawWriter writer = replace<double>(0, 128);
  const double value = 0;
  const auto payload = std::as_bytes(std::span(&value, 1));
  for (int i = 0; i < 8; ++i) writer.write(payload, WallClock::now() + 50ms);
  recorder_ = ctl::Recorder::start(session_with(daemon_), RecordingWriter::create(file_).value(),
                                   {ctl::StreamFilter({}, {}), {}, 1h, {}, false})
                  .value();
  await([&] { return recorder_->take() && recorder_->streams() == 1; });
  for (int i = 8; i < 1000; ++i) writer.write(payload);
  finish_and_count(1000);
}

TEST_F(RecorderOf, ARangeLosesWhatItsRingOverwroteAfterItWasOpened) {
  RawWriter writer = replace<double>(0, 128);
  const Time begin = WallClock::now() + 50ms;  // they wait in their ring, as above
  const double value = 0;
  const auto write = [&](int i) {
    writer.write(std::as_bytes(std::span(&value, 1)), begin + i * 1ms);
  };
  for (int i = 0; i < 8; ++i) write(i);
  ctl::RecorderPlan plan{ctl::StreamFilter({}, {}), {}, {}, {}, false};
  plan.range = {begin + 3ms, begin + 6ms};
  recorder_ =
      ctl::Recorder::start(session_with(daemon_), RecordingWriter::create(file_).value(), plan)
          .value();
  await([&] { return recorder_->take() && recorder_->streams() == 1; });
  for (int i = 8; i < 1000; ++i) write(i);
  ASSERT_TRUE(recorder_->finish());
  const RecordingProgress progress = recorder_->progress();
  EXPECT_EQ(progress.samples + progress.lost_samples, 4U);
}

// Its reader could have continued with any type of that size before it got a name.
TEST_F(RecorderOf, AStreamThatGotANameForItsTypeIsOpenedAgainForAnother) {
  RawWriter writer =
      session_.create_raw({"again", 0, ""}, {"", sizeof(double), 1, {}}, depth_of(64)).value();
  start(writer.id());
  writer = replace<double>(1);
  await([&] { return recorder_->take() && recorder_->progress().samples == 1; });
  writer = replace<std::int64_t>(1000, 8);
  await_opened(writer.id());
  ASSERT_TRUE(recorder_->finish());
  const RecordingProgress progress = recorder_->progress();
  EXPECT_EQ(progress.samples + progress.lost_samples, 1001U);
}

// A stream of pc2, which is away for longer than `keep_removed`, and then has the same ring.
class RecorderOfAHostThatReturns : public FleetTest {
 protected:
  void start(bool on_demand) {
    await_streams(1);
    ctl::RecorderPlan plan{ctl::StreamFilter({}, {}), {}, {}, {}, on_demand};
    plan.keep_removed = {};
    std::optional<RecordingWriter> file;
    if (!on_demand) file = RecordingWriter::create(file_).value();
    recorder_ = ctl::Recorder::start(session_with(daemon_), std::move(file), plan).value();
    await([&] { return recorder_->take() && (on_demand ? is_open() : recorder_->streams() == 1); });
  }
  bool is_open() const { return mapped_parts(there_.id()) > writers_parts_; }
  void write(int samples) {
    for (int i = 0; i < samples; ++i) there_.write(static_cast<double>(written_++));
  }
  void await_recorded() {
    await([&] {
      return recorder_->take() &&
             recorder_->progress().samples == static_cast<std::uint64_t>(written_);
    });
  }
  void take_for(Duration time) {
    const MonoTime end = deadline_in(time);
    await([&] { return !recorder_->take() || MonoClock::now() >= end; });
  }
  void lose_host() {
    pc2_.kill_hard();
    await_state("pc2", HostState::down);
  }
  void return_host() {
    pc2_.start();
    await([&] { return there_.set_property(property_).has_value(); });
    await_streams(1);
  }
  void expect_to_go_on_when_host_returns() {
    write(5);
    return_host();
    await_recorded();
    write(5);
    await_recorded();
    expect_all_once();
  }
  void expect_all_once() {
    ASSERT_TRUE(recorder_->finish());
    EXPECT_EQ(recorder_->take_notices(), std::vector<std::string>());
    EXPECT_EQ(recorder_->progress().lost_samples, 0U);
    const Recording recording = Recording::open(file_).value();
    ASSERT_EQ(recording.streams().size(), 1U);
    auto reader = recording.open_reader<double>("there").value();
    for (int i = 0; i < written_; ++i) {
      const auto sample = reader.read_next();
      ASSERT_TRUE(sample) << i;
      EXPECT_EQ(sample->value, i);
    }
    EXPECT_FALSE(reader.read_next());
    EXPECT_EQ(reader.property().value(), property_);
  }

  const std::vector<std::byte> property_{std::byte{7}};
  Writer<double> there_ = on_pc2_.create<double>("there", depth_of(4096)).value();
  std::size_t writers_parts_ = mapped_parts(there_.id());
  int written_ = 0;
  TestFolder folder_;
  std::string file_ = folder_.file("a.mcap");
  std::unique_ptr<ctl::Recorder> recorder_;
};

TEST_F(RecorderOfAHostThatReturns, KeepsItsStreamsOpenMeanwhile) {
  start(false);
  write(10);
  await_recorded();
  lose_host();
  take_for(4s);  // it looks for the stream twice, a second apart, and drops it a second later
  EXPECT_TRUE(is_open());
  expect_to_go_on_when_host_returns();
}

TEST_F(RecorderOfAHostThatReturns, OnDemandGoesOnWhereItWas) {
  start(true);
  write(10);
  ASSERT_TRUE(recorder_->begin(RecordingWriter::create(file_).value(), 1h));
  await_recorded();
  lose_host();
  await([&] { return recorder_->take() && !is_open(); });
  expect_to_go_on_when_host_returns();
}

// Its past is taken in parts, so that the ring still has samples when the host is lost and returns.
TEST_F(RecorderOfAHostThatReturns, OnDemandGoesOnWithARingThatWasNotTakenYet) {
  start(true);
  const Time begin = WallClock::now() - 1000s;
  for (; written_ < 500; ++written_) there_.write(written_, begin + written_ * 1s);
  await([&] {
    const Result<StreamInfo> there = session_.stream_info(there_.id());
    return recorder_->take() && there && there->mirror && there->mirror->newest == written_ - 1;
  });
  ASSERT_TRUE(recorder_->begin(RecordingWriter::create(file_).value(), 1h));
  lose_host();
  const MonoTime end = deadline_in(1500ms);  // longer than it takes to see that
  while (MonoClock::now() < end) {
    ASSERT_TRUE(recorder_->take());
    std::this_thread::sleep_for(20ms);
  }
  ASSERT_LT(recorder_->progress().samples, static_cast<std::uint64_t>(written_));
  return_host();
  await_recorded();
  take_for(1500ms);
  write(5);
  await_recorded();
  expect_all_once();
}

struct RecordedVolts {
  double volts;
};
DSSM_DESCRIBE(RecordedVolts, volts)

TEST_F(RecorderOf, AStreamHasItsDescriptionFromTheNextFileOn) {
  const TypeInfo unnamed{"", sizeof(RecordedVolts), 1, {}};
  RawWriter writer = session_.create_raw({"again", 0, ""}, unnamed, depth_of(64)).value();
  RecordingOptions how;
  how.chunk_bytes = how.max_file_bytes = 1;
  start(writer.id(), how);
  std::int64_t written = 0;
  const auto take_until_files = [&](std::uint32_t files) {
    await([&] {
      writer.write(std::as_bytes(std::span(&written, 1)));
      ++written;
      EXPECT_TRUE(recorder_->take());
      return recorder_->progress().files >= files;
    });
  };
  take_until_files(2);
  EXPECT_EQ(recorder_->streams_without_fields(), std::vector<std::string>{"again:0@pc1"});
  ASSERT_TRUE(session_.describe(writer.id(), type_of<RecordedVolts>()));
  await([&] {
    take_until_files(recorder_->progress().files + 1);
    return recorder_->streams_without_fields().empty();
  });
  take_until_files(recorder_->progress().files + 3);
  ASSERT_TRUE(recorder_->finish());
  EXPECT_TRUE(Recording::open(file_).value().streams()[0].type.fields.empty());
  const Recording recording = Recording::open(folder_.path()).value();
  EXPECT_EQ(Recording::open(recording.files().back()).value().streams()[0].type,
            type_of<RecordedVolts>());
  ASSERT_EQ(recording.streams().size(), 1U);
  EXPECT_EQ(recording.streams()[0].type, type_of<RecordedVolts>());
  EXPECT_EQ(recording.streams()[0].samples, static_cast<std::uint64_t>(written));
}

TEST(RecorderOfAnyUser, GoesOnWhereItWasWhenItMayReadAgain) {
  if (::geteuid() != 0) GTEST_SKIP() << "only root can become somebody else";
  const TestFolder folder;
  const std::string configuration = folder.file("dssmd.conf"), file = folder.file("a.mcap"),
                    refused = folder.file("refused");
  ASSERT_EQ(::chmod(folder.path().c_str(), 0777), 0);
  const auto allow = [&](const std::string& verb) {
    std::ofstream(configuration) << "rights = [\"local " << verb << " *\"]\n";
  };
  allow("read");
  const DaemonProcess daemon({"--config", configuration, "--listen", "", "--socket-mode", "0666"});
  ASSERT_EQ(::chmod(daemon.runtime_dir().c_str(), 0755), 0);
  Session root = session_with(daemon);
  Writer<double> writer = root.create<double>("lidar", {64, Duration(1)}).value();
  constexpr int kEarlier = 5, kSamples = 30;
  int written = 0;
  while (written < kEarlier) writer.write(written++);
  const pid_t child = ::fork();
  if (child == 0) {
    become_nobody({});
    const auto recorder =
        ctl::Recorder::start(session_with(daemon), RecordingWriter::create(file, {}).value(),
                             {ctl::StreamFilter({}, {}), {}, {}, {}, false})
            .value();
    while (recorder->progress().samples < kSamples) {
      if (const Result<void> taken = recorder->take(); !taken) {
        std::fprintf(stderr, "%s\n", taken.error().message.c_str());
        ::_exit(1);
      }
      for (const std::string& notice : recorder->take_notices()) {
        if (contains(notice, "is not recorded yet: ")) std::ofstream(refused) << notice;
      }
      std::this_thread::sleep_until(recorder->next_take());
    }
    ::_exit(recorder->finish() ? 0 : 1);
  }
  const auto write_when = [&](std::uint32_t readers, int samples) {
    await([&] { return root.stream_info({"lidar", 0, ""}).value().readers == readers; });
    for (int i = 0; i < samples; ++i) writer.write(written++);
  };
  for (const int recorded_before : {0, 10}) {
    write_when(1, recorded_before);
    allow("write");
    ::kill(daemon.pid(), SIGHUP);
    write_when(0, 5);
    await([&] { return std::filesystem::remove(refused); });
    allow("read");
    ::kill(daemon.pid(), SIGHUP);
  }
  write_when(1, 10);
  ASSERT_EQ(written, kEarlier + kSamples);
  EXPECT_EQ(wait_for(child), 0);
  const Recording recording = Recording::open(file).value();
  ASSERT_EQ(recording.streams().size(), 1U);
  EXPECT_EQ(recording.streams()[0].samples, std::uint64_t{kSamples}) << "nor what was there before";
  EXPECT_EQ(recording.streams()[0].lost_samples, 0U);
}

}  // namespace
}  // namespace dssm::test
