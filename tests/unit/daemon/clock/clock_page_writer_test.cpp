// SPDX-License-Identifier: Apache-2.0
//
// The file of the clock page: what the next dssmd and other programs find in it.
#include "daemon/clock/clock_page_writer.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

class ClockPageWriterTest : public testing::Test {
 protected:
  ClockPageWriterTest() {
    char folder[] = "/tmp/dssm-page-XXXXXX";
    EXPECT_TRUE(::mkdtemp(folder));
    folder_ = folder;
  }
  ~ClockPageWriterTest() override { std::filesystem::remove_all(folder_); }

  std::string path() const { return folder_ + "/clock"; }
  ClockPageWriter open() const { return ClockPageWriter::open(path()).value(); }
  const ClockPage& mapped(const ClockPageWriter& writer) const {
    const UniqueFd file = writer.for_reading().value();
    return **map_clock_page_untrusted(file.get());
  }

 private:
  std::string folder_;
};

// The bound is 100 us at second 50, grows by 50 us a second, and was at most 400 us since second
// 40.
ClockPageState state() {
  ClockPageState made;
  made.wall = Time(50s);
  made.mono = MonoClock::now();
  made.clock.status = ClockStatus::synchronized;
  made.clock.bound = 100us;
  made.clock.ageing_ppb = 50'000;
  made.earlier_from = Time(40s);
  made.earlier_bound = 400us;
  made.clock.basis = ClockBasis::reference;
  made.clock.stratum = 11;
  made.clock.offset = -3us;
  made.clock.root = {1us, 2us};
  made.limit = 1500us;
  made.base_mono = MonoTime(7s);
  made.base_wall = Time(8s);
  made.base_width = 9ns;
  std::string("pc1").copy(made.reference, ClockPageState::kMaxReferenceBytes);
  return made;
}

TEST_F(ClockPageWriterTest, ANewPageStatesNothing) {
  const ClockPageWriter writer = open();
  EXPECT_EQ(clock_error_at(writer.page(), WallClock::now()), std::nullopt);
  EXPECT_EQ(status_of(writer.page()), ClockStatus::unknown);
  EXPECT_FALSE(writer.has_history());
}

TEST_F(ClockPageWriterTest, BringsAStateToReaders) {
  ClockPageWriter writer = open();
  writer.store(state());
  ClockPageState read;
  EXPECT_NE(mapped(writer).state.load(read), 0u);
  EXPECT_EQ(read.wall, state().wall);
  EXPECT_EQ(read.clock, state().clock);
  EXPECT_EQ(read.limit, 1500us);
  EXPECT_EQ(read.base_mono, MonoTime(7s));
  EXPECT_EQ(read.base_wall, Time(8s));
  EXPECT_EQ(read.base_width, 9ns);
  EXPECT_STREQ(read.reference, "pc1");
  EXPECT_EQ(status_of(mapped(writer)), ClockStatus::synchronized);
}

TEST_F(ClockPageWriterTest, ThePageOutlivesItsDssmdForTheNextOne) {
  {
    ClockPageWriter writer = open();
    writer.store(state());
  }
  const ClockPageWriter next = open();
  EXPECT_TRUE(next.has_history());
  ClockPageState read;
  next.page().state.load(read);
  EXPECT_EQ(read.base_wall, Time(8s));
}

TEST_F(ClockPageWriterTest, APageOfAnotherBootIsReplacedAndStaysMapped) {
  ClockPageWriter writer = open();
  writer.store(state());
  const ClockPage& old = mapped(writer);
  {
    std::fstream file(path(), std::ios::in | std::ios::out | std::ios::binary);
    file.seekp(offsetof(ClockPage, boot_id));
    file << "another boot";
  }
  const ClockPageWriter next = open();
  EXPECT_FALSE(next.has_history());
  EXPECT_EQ(clock_error_at(next.page(), Time(50s)), std::nullopt);
  EXPECT_EQ(clock_error_at(old, Time(50s)), 100us);
}

TEST_F(ClockPageWriterTest, AnotherFileIsNotMappedAndIsReplaced) {
  std::ofstream(path()) << "something else";
  const UniqueFd file(::open(path().c_str(), O_RDONLY | O_CLOEXEC));
  EXPECT_FALSE(map_clock_page_untrusted(file.get()));
  EXPECT_FALSE(open().has_history());
}

}  // namespace
}  // namespace dssm::clock
