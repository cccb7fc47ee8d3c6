// SPDX-License-Identifier: Apache-2.0
//
// dssmctl pub, find and show.
#include "tests/process/dssmctl/ctl_test.hpp"

namespace dssm::test {
namespace {

struct Posture {
  double x, y;
};
DSSM_DESCRIBE(Posture, x, y)

class Pub : public CtlTest {
 protected:
  Writer<Posture> writer_ = session_.create<Posture>("pose", depth_of(64)).value();
  Writer<Posture> copy_ = session_.create<Posture>("copy", depth_of(64)).value();
  Reader<Posture> reader_ = session_.open_reader<Posture>("copy").value();
};

TEST_F(Pub, WritesWhatTheCommandLineSays) {
  EXPECT_EQ(output({"pub", "copy", "x=1.5", "y=-2"}),
            copy_.id().str() + ": 1 sample written, up to tid 0\n");
  const auto sample = reader_.read_newest();
  ASSERT_TRUE(sample);
  EXPECT_EQ(sample->value.x, 1.5);
  EXPECT_EQ(sample->value.y, -2);
  EXPECT_LT(WallClock::now() - sample->info.time, std::chrono::minutes(1));
  EXPECT_EQ(json({"pub", "copy", "x=0", "--rate", "1000", "--count", "3"})["newest_tid"], 3);
}

TEST_F(Pub, WritesAgainWhatEchoPrinted) {
  for (int i = 0; i < 5; ++i) {
    writer_.write({i / 3.0, -1.0 * i}, at_ns(kSecond * (100 + i)), Duration(i));
  }
  for (const char* form : {"--json", "--csv"}) {
    const std::string text = output({"echo", "pose", "--at", "100", "-n", "5", form});
    const Finished finished = ctl({"pub", "copy", "--stdin", "--times"}, text);
    ASSERT_EQ(finished.exit_status, 0) << finished.err;
    EXPECT_EQ(reader_.newest_tid(), form == std::string("--json") ? 4 : 9);
  }
  reader_.seek(kNoTid);
  for (int i = 0; i < 10; ++i) {
    const auto sample = reader_.read_next();
    ASSERT_TRUE(sample);
    EXPECT_EQ(sample->value.x, i % 5 / 3.0);
    EXPECT_EQ(sample->info.time, at_ns(kSecond * (100 + i % 5)));
    EXPECT_EQ(sample->info.clock_error, Duration(i % 5));
  }
}

TEST_F(Pub, SaysWhichLineIsWrongAndKeepsThoseBefore) {
  const Finished finished = ctl({"pub", "copy", "--stdin"}, "{\"x\": 1}\n{\"x\": 2}\n{\"z\": 3}\n");
  EXPECT_EQ(finished.exit_status, 2);
  EXPECT_EQ(finished.err,
            "dssmctl: pub: line 3: no field 'z'; there are 'x', 'y'; written before: 2\n");
  EXPECT_EQ(reader_.newest_tid(), 1);
  const Finished timeless = ctl({"pub", "copy", "--stdin", "--times"}, "{\"x\": 1}\n");
  EXPECT_TRUE(contains(timeless.err, "no time_ns")) << timeless.err;
  const Finished missing = ctl({"pub", "cpy", "x=1"});
  EXPECT_TRUE(contains(missing.err, "is it 'copy'?")) << missing.err;
}

TEST_F(Pub, WritesNoFasterThanItIsTold) {
  const Time before = WallClock::now();
  output({"pub", "copy", "x=1", "--rate", "20", "--count", "3"});
  EXPECT_GE(reader_.read_newest()->info.time - before, std::chrono::milliseconds(100));
}

TEST_F(Pub, WritesUntilCtrlC) {
  Running running(argv({"pub", "copy", "x=1", "--rate", "200"}), environment());
  ASSERT_EQ(reader_.wait_for_tid(3, kNever), WaitStatus::ready);
  running.signal(SIGINT);
  EXPECT_TRUE(contains(running.rest(), "samples written, up to tid "));
  EXPECT_EQ(running.status(), 0);
}

TEST_F(Pub, TypesAreFoundAndShown) {
  const auto bytes =
      session_.create_raw({"bytes", 0, ""}, TypeInfo{"Raw", 8, 8, {}}, depth_of(4)).value();
  EXPECT_EQ(output({"find", "P*"}), "pose\ncopy\n");
  EXPECT_EQ(json({"find", "Raw"})["streams"][0]["stream"], bytes.id().str());
  const Finished none = ctl({"find", "Post"});
  EXPECT_EQ(none.exit_status, 1);
  EXPECT_EQ(none.err,
            "dssmctl: find: no stream carries the type 'Post'; there are 'Posture', 'Raw'\n");
  const std::vector<std::string> shown = lines_of(output({"show", "Posture"}));
  ASSERT_EQ(shown.size(), 4u);
  EXPECT_EQ(shown[0],
            "'Posture' (16 bytes, aligned to 8): " + writer_.id().str() + ", " + copy_.id().str());
  EXPECT_EQ(words_of(shown[3])[0], "y");
  EXPECT_TRUE(contains(output({"show", "Raw"}), "not described"));
  const Json pose = json({"show", "Posture"});
  EXPECT_EQ(pose["definitions"].size(), 1u);
  EXPECT_EQ(pose["definitions"][0]["fields"][1]["offset_bytes"], 8);
  EXPECT_EQ(ctl({"show", "Post"}).exit_status, 1);
}

}  // namespace
}  // namespace dssm::test
