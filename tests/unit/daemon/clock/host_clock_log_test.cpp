// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/host_clock_log.hpp"

#include <gtest/gtest.h>

#include <vector>

namespace dssm::daemon {
namespace {

using namespace std::chrono_literals;

constexpr wire::HostId kFirst{1}, kSecond{2};
constexpr MonoTime kBegin{1000s};
constexpr const char* kReason = "they may be 2 ms apart";

class HostClockLogTest : public testing::Test, protected Logger {
 protected:
  void write(LogLevel level, std::string_view text, const LogFields& fields) noexcept override {
    EXPECT_FALSE(fields.message_id.empty());
    lines.push_back((level == LogLevel::warning ? "warning: " : "") + std::string(text));
  }
  Logger& logger() { return *this; }

  std::vector<std::string> lines;
  HostClockLog log{logger()};
};

TEST_F(HostClockLogTest, LogsWhenAClockBecomesBadAndWhenItIsGoodAgain) {
  log.update(kFirst, "pc1", "", kBegin);
  EXPECT_TRUE(lines.empty()) << "all is well";
  log.update(kFirst, "pc1", kReason, kBegin + 1s);
  log.update(kFirst, "pc1", kReason, kBegin + 2s);
  log.update(kFirst, "pc1", "", kBegin + 3s);
  log.update(kFirst, "pc1", "", kBegin + 4s);
  EXPECT_EQ(lines, (std::vector<std::string>{
                       "warning: the times of 'pc1''s samples are not good here: they may be 2 ms "
                       "apart",
                       "the times of 'pc1''s samples are good here again"}));
}

TEST_F(HostClockLogTest, LetsAHostComeUpFirst) {
  log.update(kFirst, "pc1", kReason, kBegin);
  log.update(kFirst, "pc1", kReason, kBegin + HostClockLog::kStartupDelay - 1s);
  EXPECT_TRUE(lines.empty());
  log.update(kFirst, "pc1", kReason, kBegin + HostClockLog::kStartupDelay);
  EXPECT_EQ(lines.size(), 1U);
}

TEST_F(HostClockLogTest, DistinguishesHostsAndForgetsThem) {
  log.update(kFirst, "pc1", "", kBegin);
  log.update(kSecond, "pc2", kReason, kBegin);
  EXPECT_TRUE(lines.empty());
  log.update(kFirst, "pc1", kReason, kBegin + 1s);
  log.forget(kFirst);
  log.update(kFirst, "pc1", kReason, kBegin + 2s);
  EXPECT_EQ(lines.size(), 1U) << "a host that comes back has just started";
  log.update(kFirst, "pc1", "", kBegin + 3s);
  EXPECT_EQ(lines.size(), 2U) << "it was logged as bad before it left";
  log.forget(kFirst);
  log.update(kFirst, "pc1", "", kBegin + 4s);
  EXPECT_EQ(lines.size(), 2U);
}

TEST_F(HostClockLogTest, KnowsWhatItWouldLog) {
  EXPECT_FALSE(log.is_changed(kFirst, true));
  log.update(kFirst, "pc1", "", kBegin);
  EXPECT_FALSE(log.is_changed(kFirst, true));
  EXPECT_TRUE(log.is_changed(kFirst, false));
  log.update(kFirst, "pc1", kReason, kBegin + 1s);
  EXPECT_FALSE(log.is_changed(kFirst, false));
  EXPECT_TRUE(log.is_changed(kFirst, true));
}

TEST_F(HostClockLogTest, IsNotFilledByAClockThatComesAndGoes) {
  for (int i = 0; i < 100; ++i) {
    log.update(kFirst, "pc1", i % 2 ? kReason : "", kBegin + i * 1s);
  }
  EXPECT_GE(lines.size(), 4U);
  EXPECT_LE(lines.size(), 6U);
  // What stays is told in the end.
  lines.clear();
  log.update(kFirst, "pc1", kReason, kBegin + 400s);
  log.update(kFirst, "pc1", "", kBegin + 500s);
  ASSERT_FALSE(lines.empty());
  EXPECT_TRUE(lines.back().ends_with("good here again"));
}

}  // namespace
}  // namespace dssm::daemon
