// SPDX-License-Identifier: Apache-2.0
//
// The folder of a recorder: names, quota, and the file that a killed recorder left; and the file
// that configures it.
#include "client/dssmctl/recording_folder.hpp"

#include <gtest/gtest.h>
#include <time.h>

#include <dssm/recording.hpp>
#include <fstream>
#include <set>

#include "client/dssmctl/config_words.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;
namespace fs = std::filesystem;

class RecordingFolderTest : public testing::Test {
 protected:
  RecordingFolderTest() = default;
  ~RecordingFolderTest() override { test::remove_tree(path_); }

  // Of so many bytes; `age` orders them.
  void add(const std::string& name, std::size_t bytes, Duration age) {
    std::ofstream(path_ / name) << std::string(bytes, 'x');
    fs::last_write_time(path_ / name, fs::file_time_type::clock::now() - age);
  }
  std::set<std::string> files() const {
    std::set<std::string> names;
    for (const auto& entry : fs::directory_iterator(path_)) names.insert(entry.path().filename());
    return names;
  }

  fs::path path_ = test::make_temp_dir();
};

TEST_F(RecordingFolderTest, NamesFilesByTimeAndTrigger) {
  const Time time = time_from_ns(1'795'791'000'999'999'999);
  const std::string name = incident_name(time, "low/battery ä.1");
  EXPECT_TRUE(name.starts_with("incident_2026_11_2")) << name;
  EXPECT_TRUE(name.ends_with("_low_battery___.1.mcap")) << name;
  EXPECT_EQ(incident_name(time, std::string(100, 'a')).size(), incident_name(time, "").size() + 64);
  EXPECT_TRUE(recording_name(time).starts_with("dssm_2026_11_2"));
}

TEST_F(RecordingFolderTest, DeletesTheOldestOfItsOwnFiles) {
  add("dssm_2026_11_27-12_00_00.mcap", 300, 3h);
  add("incident_2026_11_26-12_00_00_a.mcap", 300, 2h);  // by when it was written, not by its name
  add("dssm_2026_11_27-12_00_00_1.mcap", 300, 1h);
  add("dssm_drive.mcap", 300, 9h);
  add("incident.mcap", 300, 9h);
  add("dssm_2026_11_27-12_00_00.txt", 300, 9h);
  const std::set<std::string> others = {"dssm_drive.mcap", "incident.mcap",
                                        "dssm_2026_11_27-12_00_00.txt"};
  RecordingFolder folder(path_, 640);
  ASSERT_TRUE(folder.make_room(0));
  std::set<std::string> expected = others;
  expected.insert({"incident_2026_11_26-12_00_00_a.mcap", "dssm_2026_11_27-12_00_00_1.mcap"});
  EXPECT_EQ(files(), expected);
  // Little was written since; then enough.
  add("incident_2026_11_27-14_00_00_b.mcap", 300, 0h);
  static_cast<void>(folder.take_notices());
  ASSERT_TRUE(folder.make_room(9));
  EXPECT_EQ(files().size(), 6U);
  EXPECT_TRUE(folder.take_notices().empty());
  ASSERT_TRUE(folder.make_room(10));
  EXPECT_EQ(files().size(), 5U);
  const fs::path deleted = path_ / "incident_2026_11_26-12_00_00_a.mcap";
  EXPECT_FALSE(fs::exists(deleted));
  EXPECT_EQ(folder.take_notices(),
            std::vector<std::string>{"'" + deleted.string() + "' is deleted, because of --quota"});
}

TEST_F(RecordingFolderTest, NeverDeletesTheNewest) {
  add("dssm_2026_11_27-12_00_00.mcap", 300, 3h);
  add("dssm_2026_11_27-13_00_00.mcap", 300, 2h);
  ASSERT_TRUE(RecordingFolder(path_, 64).make_room(0));
  EXPECT_EQ(files(), std::set<std::string>{"dssm_2026_11_27-13_00_00.mcap"});
}

// As on a PC whose battery was flat, until chronyd sets the clock.
TEST_F(RecordingFolderTest, DeletesWhatWasThereFirstAlsoIfTheClockIsBehind) {
  add("dssm_2026_11_27-12_00_00.mcap", 300, 3h);
  add("dssm_2026_11_27-13_00_00.mcap", 300, 2h);
  RecordingFolder folder(path_, 900);
  ASSERT_TRUE(folder.make_room(0));
  EXPECT_EQ(files().size(), 2U);
  add("dssm_2020_01_01-00_00_00.mcap", 300, 50'000h);
  ASSERT_TRUE(folder.make_room(300));
  EXPECT_EQ(files(), (std::set<std::string>{"dssm_2026_11_27-13_00_00.mcap",
                                            "dssm_2020_01_01-00_00_00.mcap"}));
}

TEST_F(RecordingFolderTest, WithoutAQuotaDeletesNothingButNoticesThatTheFolderIsMissing) {
  add("dssm_2026_11_27-12_00_00.mcap", 300, 3h);
  add("dssm_2026_11_27-13_00_00.mcap", 300, 2h);
  ASSERT_TRUE(RecordingFolder(path_, 0).make_room(1'000'000));
  EXPECT_EQ(files().size(), 2U);
  const Result<void> missing = RecordingFolder(path_ / "no", 0).make_room(0);
  ASSERT_FALSE(missing);
  EXPECT_EQ(missing.error().code, Errc::not_found);
}

TEST_F(RecordingFolderTest, CompletesTheNewestFileIfItHasNoEnd) {
  const fs::path file = path_ / "incident_2026_11_27-12_00_00_a.mcap";
  {
    auto writer = RecordingWriter::create(file).value();
    ASSERT_TRUE(writer.add_trigger({"a", "", "pc1", time_from_ns(1)}));
    ASSERT_TRUE(writer.finish());
  }
  const RecordingFolder folder(path_, 0);
  EXPECT_EQ(folder.repair_newest().value(), fs::path());
  fs::resize_file(file, fs::file_size(file) - 10);
  EXPECT_EQ(folder.repair_newest().value(), file);
  EXPECT_TRUE(Recording::open(file).value().warnings().empty());
  EXPECT_EQ(Recording::open(file).value().triggers().size(), 1U);
}

// --- the configuration

class ConfigWords : public RecordingFolderTest {
 protected:
  Result<std::vector<std::string>> read(const std::string& text) const {
    std::ofstream(path_ / "record.conf") << text;
    return config_words(path_ / "record.conf");
  }
};

TEST_F(ConfigWords, AreTheOptionsOfItsKeys) {
  const auto words = read(
      "black_box = true\nfollow = false\nmax_file_size = \"2GiB\"\nbefore = 1.5\nafter = 10\n"
      "streams = [\"camera*\", \"b\"]\ntrigger = [\"a.b > 1\"]\n");
  ASSERT_TRUE(words) << words.error().message;
  std::vector<std::string> sorted = *words;
  std::ranges::sort(sorted);
  EXPECT_EQ(sorted, (std::vector<std::string>{"--after=10", "--before=1.5", "--black-box",
                                              "--max-file-size=2GiB", "--trigger=a.b > 1", "b",
                                              "camera*"}));
}

TEST_F(ConfigWords, FailWithTheFileAndTheLine) {
  const std::string file = path_ / "record.conf";
  for (const char* text : {"\nafter = = 1\n", "\n[table]\na = 1\n", "\nafter = 2026-11-27\n",
                           "\ntrigger = [[\"a\"]]\n", "\ntrigger = [true]\n"}) {
    const auto words = read(text);
    ASSERT_FALSE(words) << text;
    EXPECT_EQ(words.error().code, Errc::invalid_argument);
    EXPECT_TRUE(words.error().message.starts_with("configuration '" + file + "', line 2: "))
        << words.error().message;
  }
  EXPECT_EQ(config_words(path_ / "no").error().code, Errc::not_found);
}

}  // namespace
}  // namespace dssm::ctl
