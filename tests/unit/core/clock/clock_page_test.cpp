// SPDX-License-Identifier: Apache-2.0
#include "core/clock/clock_page.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <thread>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

class ClockPageTest : public testing::Test {
 protected:
  ClockPageTest() {
    char folder[] = "/tmp/dssm-page-XXXXXX";
    EXPECT_TRUE(::mkdtemp(folder));
    folder_ = folder;
  }
  ~ClockPageTest() override { std::filesystem::remove_all(folder_); }

  std::string path() const { return folder_ + "/clock"; }
  ClockPageWriter open() const { return ClockPageWriter::open(path()).value(); }
  const ClockPage& mapped(const ClockPageWriter& writer) const {
    const UniqueFd file = writer.for_reading().value();
    return **map_clock_page_untrusted(file.get());
  }

 private:
  std::string folder_;
};

// The bound is 100 us at second 50, grows by 50 us a second, and was at most 400 us since
// second 40.
ClockRecord record() {
  ClockRecord made;
  made.wall = Time(50s);
  made.mono = MonoClock::now();
  made.state.status = ClockStatus::synchronized;
  made.state.basis = ClockBasis::reference;
  made.state.bound = 100us;
  made.state.ageing = 50'000;
  made.state.stratum = 11;
  made.state.offset = -3us;
  made.state.root = {1us, 2us};
  made.earlier_from = Time(40s);
  made.earlier_bound = 400us;
  made.limit = 1500us;
  made.base = {MonoTime(7s), Time(8s), 9ns};
  made.reference = "pc1";
  return made;
}

TEST_F(ClockPageTest, SaysNothingUntilSomethingIsWritten) {
  const ClockPageWriter writer = open();
  EXPECT_EQ(error_at(writer.page(), WallClock::now()), std::nullopt);
  EXPECT_EQ(status_of(writer.page()), ClockStatus::unknown);
  EXPECT_FALSE(writer.has_history());
}

TEST_F(ClockPageTest, BringsARecordToReaders) {
  ClockPageWriter writer = open();
  writer.store(record());
  const ClockRecord read = load(mapped(writer));
  EXPECT_EQ(read.wall, record().wall);
  EXPECT_EQ(read.state.status, ClockStatus::synchronized);
  EXPECT_EQ(read.state.basis, ClockBasis::reference);
  EXPECT_EQ(read.state.bound, 100us);
  EXPECT_EQ(read.state.offset, -3us);
  EXPECT_EQ(read.state.root, (RootDistance{1us, 2us}));
  EXPECT_EQ(read.state.stratum, 11);
  EXPECT_EQ(read.base.mono, MonoTime(7s));
  EXPECT_EQ(read.base.wall, Time(8s));
  EXPECT_EQ(read.base.width, 9ns);
  EXPECT_EQ(read.reference, "pc1");
  EXPECT_EQ(status_of(writer.page()), ClockStatus::synchronized);
}

TEST_F(ClockPageTest, TheBoundGrowsWithTheSamplesTime) {
  ClockPageWriter writer = open();
  writer.store(record());
  EXPECT_EQ(error_at(writer.page(), Time(50s)), 100us);
  EXPECT_EQ(error_at(writer.page(), Time(52s)), 200us);
  EXPECT_EQ(error_at(writer.page(), Time(50s) + 1ns), 100us + 1ns) << "rounded up";
}

TEST_F(ClockPageTest, ATimeBeforeTheRecordHasTheGreatestBoundSince) {
  ClockPageWriter writer = open();
  writer.store(record());
  EXPECT_EQ(error_at(writer.page(), Time(50s) - 1ns), 400us);
  EXPECT_EQ(error_at(writer.page(), Time(40s)), 400us);
}

TEST_F(ClockPageTest, SaysNothingOfTimesThatItDoesNotReach) {
  ClockPageWriter writer = open();
  writer.store(record());
  EXPECT_EQ(error_at(writer.page(), Time(40s) - 1ns), std::nullopt);
  EXPECT_EQ(error_at(writer.page(), Time(50s) + kLongestUse), 275us);
  EXPECT_EQ(error_at(writer.page(), Time(50s) + kLongestUse + 1ns), std::nullopt)
      << "dssmd is gone, or the time is none of this clock";
  EXPECT_EQ(error_at(writer.page(), Time::max()), std::nullopt);
  EXPECT_EQ(error_at(writer.page(), Time::min()), std::nullopt);
}

TEST_F(ClockPageTest, WithoutABoundAllIsUnknown) {
  ClockPageWriter writer = open();
  ClockRecord none = record();
  none.state.bound = kUnknownClockError;
  none.earlier_from = none.wall;
  writer.store(none);
  EXPECT_EQ(error_at(writer.page(), Time(50s)), kUnknownClockError);
  EXPECT_EQ(error_at(writer.page(), Time(49s)), std::nullopt);
}

TEST_F(ClockPageTest, OutlivesItsDssmdForTheNextOne) {
  {
    ClockPageWriter writer = open();
    writer.store(record());
  }
  const ClockPageWriter next = open();
  EXPECT_TRUE(next.has_history());
  EXPECT_EQ(load(next.page()).base.wall, Time(8s));
}

TEST_F(ClockPageTest, OneOfAnotherBootIsReplacedAndStaysWithWhoHasIt) {
  ClockPageWriter writer = open();
  writer.store(record());
  const ClockPage& old = mapped(writer);
  {
    std::fstream file(path(), std::ios::in | std::ios::out | std::ios::binary);
    file.seekp(offsetof(ClockPage, boot_id));
    file << "another boot";
  }
  const ClockPageWriter next = open();
  EXPECT_FALSE(next.has_history());
  EXPECT_EQ(error_at(next.page(), Time(50s)), std::nullopt);
  EXPECT_EQ(error_at(old, Time(50s)), 100us);
}

TEST_F(ClockPageTest, AFileThatIsNoneIsNotMapped) {
  std::ofstream(path()) << "something else";
  const UniqueFd file(::open(path().c_str(), O_RDONLY | O_CLOEXEC));
  EXPECT_FALSE(map_clock_page_untrusted(file.get()));
  EXPECT_FALSE(open().has_history()) << "dssmd makes a new one in its place";
}

TEST_F(ClockPageTest, ReadersNeverSeeAMix) {
  ClockPageWriter writer = open();
  // Whole records say twice the bound that they say as earlier bound.
  const auto store = [&](std::int64_t number) {
    ClockRecord one = record();
    one.state.bound = Duration(2 * number);
    one.earlier_bound = Duration(number);
    writer.store(one);
  };
  store(1);
  std::atomic<bool> done = false;
  std::thread reader([&] {
    while (!done) {
      const ClockRecord read = load(writer.page());
      ASSERT_EQ(read.state.bound, 2 * read.earlier_bound);
    }
  });
  for (std::int64_t i = 1; i < 200'000; ++i) store(i);
  done = true;
  reader.join();
}

}  // namespace
}  // namespace dssm::clock
