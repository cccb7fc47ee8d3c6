// SPDX-License-Identifier: Apache-2.0
//
// The files below systemd/ that have to fit the code.
#include <gtest/gtest.h>

#include <cstdlib>
#include <fstream>
#include <regex>
#include <set>
#include <sstream>
#include <string>

#include "daemon/streams/descriptor_store.hpp"

namespace dssm::daemon {
namespace {

std::string source(const std::string& path) {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");
  std::ifstream file(std::string(root ? root : ".") + "/" + path);
  std::stringstream text;
  text << file.rdbuf();
  EXPECT_FALSE(text.str().empty()) << path;
  return text.str();
}

std::multiset<std::string> all_matches(const std::string& text, const std::string& pattern) {
  const std::regex regex(pattern);
  std::multiset<std::string> found;
  for (std::sregex_iterator at(text.begin(), text.end(), regex), end; at != end; ++at) {
    found.insert((*at)[1]);
  }
  return found;
}

TEST(Catalog, ExplainsEachMessageIdOnceAndNoOther) {
  const auto ids = all_matches(source("daemon/base/message_ids.hpp"), "\"([0-9a-f]{32})\"");
  EXPECT_FALSE(ids.empty());
  EXPECT_EQ(all_matches(source("systemd/dssmd.catalog"), "(?:^|\n)-- ([0-9a-f]{32})\n"), ids);
}

TEST(Catalog, HasASubjectAndATextInEachEntry) {
  const std::string catalog = source("systemd/dssmd.catalog");
  const std::size_t entries = all_matches(catalog, "\n(-- )").size();
  EXPECT_EQ(all_matches(catalog,
                        "\n(-- [0-9a-f]{32}\nSubject: [^\n]+\nDefined-By: DSSM\n"
                        "Documentation: [^\n]+\n\n[A-Za-z])")
                .size(),
            entries);
}

TEST(Unit, KeepsAsManyDescriptorsAsTheDaemonSends) {
  EXPECT_EQ(all_matches(source("systemd/dssmd.service"), "\nFileDescriptorStoreMax=([0-9]+)\n"),
            (std::multiset<std::string>{std::to_string(DescriptorStore::kMaxDescriptors)}));
}

// The key max_memory is half of the machine's memory by default; a dssmd that keeps to it must not
// be slowed down.
TEST(Unit, SlowsDssmdDownBeforeItIsKilledForItsMemory) {
  const auto percent = [unit = source("systemd/dssmd.service")](const std::string& name) {
    const auto found = all_matches(unit, "\n" + name + "=([0-9]+)%\n");
    EXPECT_EQ(found.size(), 1U) << name;
    return found.empty() ? 0 : std::stoi(*found.begin());
  };
  EXPECT_LT(50, percent("MemoryHigh"));
  EXPECT_LT(percent("MemoryHigh"), percent("MemoryMax"));
}

// Three characters and what stands between them, beside a few sockets' names.
TEST(DescriptorNames, FitIntoTheOneVariableThatSystemdHandsThemOverIn) {
  constexpr std::size_t kMaxArgStrlen = 131'072;  // of Linux, with the end mark
  constexpr std::size_t kForSockets = 2'048;
  EXPECT_LE(DescriptorStore::kMaxDescriptors * 4 + kForSockets + sizeof "LISTEN_FDNAMES=",
            kMaxArgStrlen);
}

}  // namespace
}  // namespace dssm::daemon
