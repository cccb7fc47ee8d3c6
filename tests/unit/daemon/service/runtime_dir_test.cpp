// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>
#include <sys/stat.h>

#include <filesystem>

#include "daemon/service/process.hpp"
#include "tests/support/daemon_process.hpp"

namespace dssm::daemon {
namespace {

TEST(RuntimeDir, CreatesTheFolderForAllToEnter) {
  const std::string dir = test::make_temp_dir(), path = dir + "/run";
  const mode_t old_mask = ::umask(077);
  const Result<RuntimeDir> opened = RuntimeDir::open(path);
  ::umask(old_mask);
  ASSERT_TRUE(opened) << opened.error().message;
  struct stat file {};
  ASSERT_EQ(::stat(path.c_str(), &file), 0);
  EXPECT_EQ(file.st_mode & 0777, 0755u);
  EXPECT_TRUE(std::filesystem::is_empty(path)) << "the lock is no file";
  test::remove_tree(dir);
}

TEST(RuntimeDir, BelongsToOneAtATime) {
  const std::string dir = test::make_temp_dir();
  {
    const Result<RuntimeDir> first = RuntimeDir::open(dir);
    ASSERT_TRUE(first);
    const Result<RuntimeDir> second = RuntimeDir::open(dir);
    ASSERT_FALSE(second);
    EXPECT_EQ(second.error().code, Errc::conflict);
    EXPECT_NE(second.error().message.find("another dssmd is running"), std::string::npos);
  }
  EXPECT_TRUE(RuntimeDir::open(dir));
  test::remove_tree(dir);
}

TEST(RuntimeDir, NamesTheFolderThatIsMissing) {
  const Result<RuntimeDir> opened = RuntimeDir::open("/nowhere/at/all");
  ASSERT_FALSE(opened);
  EXPECT_NE(opened.error().message.find("'/nowhere/at/all'"), std::string::npos);
}

}  // namespace
}  // namespace dssm::daemon
