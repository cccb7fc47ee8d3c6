// SPDX-License-Identifier: Apache-2.0
#include "core/clock/error_cache.hpp"

#include <gtest/gtest.h>
#include <stdlib.h>

#include <filesystem>

namespace dssm::clock {
namespace {

using namespace std::chrono_literals;

class ErrorCacheTest : public testing::Test {
 protected:
  ErrorCacheTest() {
    record.wall = Time(50s);
    record.state.bound = 100us;
    record.state.ageing = 56'250;
    record.earlier_from = Time(40s);
    record.earlier_bound = 400us;
    writer.store(record);
  }
  ~ErrorCacheTest() override { std::filesystem::remove_all(folder); }

  static std::string make_folder() {
    char name[] = "/tmp/dssm-cache-XXXXXX";
    EXPECT_TRUE(::mkdtemp(name));
    return name;
  }
  std::optional<Duration> at(Time t) {
    Duration error{};
    return cache.find(&writer.page(), t, error) ? std::optional(error) : std::nullopt;
  }
  // As error_at() says, a little more at most.
  void expect_same(Time t) {
    const std::optional<Duration> found = at(t);
    const Duration exact = error_at(writer.page(), t).value();
    ASSERT_TRUE(found) << to_ns(t);
    EXPECT_GE(*found, exact) << to_ns(t);
    EXPECT_LE(*found - exact, 2ns) << to_ns(t);
  }

  const std::string folder = make_folder();
  ClockPageWriter writer = ClockPageWriter::open(folder + "/clock").value();
  ClockRecord record;
  ErrorCache cache;
};

TEST_F(ErrorCacheTest, SaysWhatThePageSays) {
  for (const Duration age :
       {0ns, 1ns, 999ns, 1'000'000ns, 1'000'000'001ns, Duration(kLongestUse)}) {
    expect_same(record.wall + age);
  }
}

TEST_F(ErrorCacheTest, SeesWhatThePageSaysAnew) {
  expect_same(Time(51s));
  record.wall = Time(51s);
  record.state.bound = 7us;
  writer.store(record);
  expect_same(Time(51s));
  EXPECT_EQ(at(Time(51s)), 7us);
  record.state.bound = kUnknownClockError;
  writer.store(record);
  EXPECT_EQ(at(Time(52s)), kUnknownClockError);
}

TEST_F(ErrorCacheTest, KnowsPagesApart) {
  EXPECT_EQ(at(Time(50s)), 100us);
  ClockPageWriter other = ClockPageWriter::open(folder + "/other").value();
  record.state.bound = 3us;
  other.store(record);
  Duration error{};
  EXPECT_TRUE(cache.find(&other.page(), Time(50s), error));
  EXPECT_EQ(error, 3us);
}

TEST_F(ErrorCacheTest, LeavesOtherTimesToTheWholePage) {
  EXPECT_EQ(at(Time(50s) - 1ns), std::nullopt);
  EXPECT_EQ(at(Time(50s) + kLongestUse + 1ns), std::nullopt);
  EXPECT_EQ(at(Time::min()), std::nullopt);
  EXPECT_EQ(at(Time::max()), std::nullopt);
  Duration error{};
  EXPECT_FALSE(cache.find(nullptr, Time(50s), error));
}

TEST_F(ErrorCacheTest, DoesNotOverflow) {
  record.state.bound = kUnknownClockError - 1ns;
  record.state.ageing = 1'000'000;
  writer.store(record);
  EXPECT_EQ(at(record.wall + kLongestUse), kUnknownClockError);
  record.state.bound = Duration::zero();
  writer.store(record);
  expect_same(record.wall + kLongestUse);
}

}  // namespace
}  // namespace dssm::clock
