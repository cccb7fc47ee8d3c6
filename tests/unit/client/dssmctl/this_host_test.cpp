// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/this_host.hpp"

#include <gtest/gtest.h>
#include <unistd.h>

#include <array>
#include <fstream>

#include "tests/support/daemon_process.hpp"

namespace dssm::ctl {
namespace {

struct ThisHost : testing::Test {
  ~ThisHost() override { test::remove_tree(folder_); }

  Result<std::string> name_by(const std::string& config) {
    std::ofstream(path_) << config;
    return this_host_name(path_);
  }

  std::string folder_ = test::make_temp_dir();
  std::string path_ = folder_ + "/dssmd.conf";
};

TEST_F(ThisHost, IsCalledAsItsConfigurationSays) {
  EXPECT_EQ(name_by("# name = \"pc1\"\npeers = [\"pc3\"]\nname = \"pc2\"  # here\n").value(),
            "pc2");
}

TEST_F(ThisHost, IsCalledAsTheMachineWithoutTheKeyOrTheFile) {
  std::array<char, 256> machine{};
  ASSERT_EQ(::gethostname(machine.data(), machine.size() - 1), 0);
  const std::string name(machine.data());
  const std::string first = name.substr(0, name.find('.'));
  const Result<std::string> without_file = this_host_name(path_);
  const Result<std::string> without_key = name_by("#name = \"pc2\"\n");
  if (!without_file) GTEST_SKIP() << without_file.error().message;
  EXPECT_EQ(*without_file, first);
  EXPECT_EQ(without_key.value(), first);
}

TEST_F(ThisHost, HasNoNameWhenItsConfigurationIsWrong) {
  for (const char* config : {"name = 5", "name = \"pc_2\"", "name = \"\"", "name = "}) {
    const Result<std::string> name = name_by(config);
    ASSERT_FALSE(name) << config;
    EXPECT_NE(name.error().message.find(path_), std::string::npos) << name.error().message;
    EXPECT_NE(name.error().message.find("--host"), std::string::npos) << name.error().message;
  }
}

TEST_F(ThisHost, HasOneIdForEachName) {
  const Result<std::string> id = this_host_id("pc2");
  if (!id) GTEST_SKIP() << id.error().message;
  EXPECT_EQ(id->size(), 32U);
  EXPECT_EQ(id->find_first_not_of("0123456789abcdef"), std::string::npos);
  EXPECT_EQ(*id, this_host_id("pc2").value());
  EXPECT_NE(*id, this_host_id("pc3").value());
}

}  // namespace
}  // namespace dssm::ctl
