// SPDX-License-Identifier: Apache-2.0
#include "core/clock/playback_record.hpp"

#include <fcntl.h>
#include <gtest/gtest.h>
#include <sys/syscall.h>
#include <sys/wait.h>
#include <unistd.h>

#include <atomic>
#include <thread>

namespace dssm::clock {
namespace {

TEST(PlaybackRecord, StartsAsRealTime) {
  const UniqueFd fd = create_playback_clock().value();
  const auto record = PlaybackRecord::open_untrusted(fd.get()).value();
  EXPECT_EQ(record->load().at(1234.5), 1234.5);
}

TEST(PlaybackRun, FollowsSsmsFormula) {
  EXPECT_EQ((PlaybackRun{10, 2, false, 99}.at(5)), 20);
  EXPECT_EQ((PlaybackRun{10, 2, true, 99}.at(5)), 99);
  EXPECT_EQ((PlaybackRun{10, -1, false, 0}.at(4)), 6);
}

TEST(PlaybackSetting, ChangesAtItsTime) {
  const PlaybackSetting setting{{10, 2, false, 0}, 5, {0, 1, true, 7}};
  EXPECT_EQ(setting.at(4.9), 7);
  EXPECT_EQ(setting.at(5), 20);
}

// The old system's readers could see the speed of one setting with the offset of another.
TEST(PlaybackRecord, NeverShowsAMixOfTwoSettings) {
  const UniqueFd fd = create_playback_clock().value();
  const auto record = PlaybackRecord::open_untrusted(fd.get()).value();
  std::atomic<bool> done = false;
  record->update([](PlaybackSetting) { return PlaybackSetting{{0, 0, false, 0}}; });
  std::vector<std::thread> setters;
  for (int s = 0; s < 2; ++s) {
    setters.emplace_back([&] {
      for (int i = 1; i < 20'000; ++i) {
        record->update([](PlaybackSetting last) {
          const double next = last.run.offset_s + 1;
          return PlaybackSetting{{next, next, false, next}, next, {next, next, false, next}};
        });
      }
    });
  }
  std::thread reader([&] {
    while (!done) {
      const PlaybackSetting seen = record->load();
      ASSERT_EQ(seen.run.offset_s, seen.run.speed);
      ASSERT_EQ(seen.run.offset_s, seen.change_s);
      ASSERT_EQ(seen.run.offset_s, seen.before.paused_at_s);
    }
  });
  for (std::thread& setter : setters) setter.join();
  done = true;
  reader.join();
  EXPECT_EQ(record->load().run.offset_s, 2 * 19'999) << "an update was lost";
}

TEST(PlaybackRecord, SurvivesASetterThatDiesInside) {
  void* head = nullptr;
  std::size_t bytes = 0;
  if (::syscall(SYS_get_robust_list, 0, &head, &bytes) != 0) {
    GTEST_SKIP() << "this kernel knows no robust mutexes (qemu-user does not)";
  }
  const UniqueFd fd = create_playback_clock().value();
  const auto record = PlaybackRecord::open_untrusted(fd.get()).value();
  record->update([](PlaybackSetting) { return PlaybackSetting{{7, 1, false, 0}}; });
  const pid_t child = ::fork();
  if (child == 0) {
    record->update([](PlaybackSetting last) {
      ::_exit(0);
      return last;
    });
  }
  ::waitpid(child, nullptr, 0);
  EXPECT_EQ(record->load().run.offset_s, 7);
  EXPECT_TRUE(record->update([](PlaybackSetting last) {
    last.run.speed = 3;
    return last;
  }));
  EXPECT_EQ(record->load().run.speed, 3);
}

TEST(PlaybackRecord, RefusesOtherFiles) {
  const UniqueFd null(::open("/dev/null", O_RDWR | O_CLOEXEC));
  EXPECT_FALSE(PlaybackRecord::open_untrusted(null.get()));
}

}  // namespace
}  // namespace dssm::clock
