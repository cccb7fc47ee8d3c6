// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include <cstdlib>
#include <dssm/error.hpp>
#include <fstream>
#include <sstream>

namespace dssm {
namespace {

constexpr Errc kLast = Errc::system;

// The rows of the table of codes: "| `not_found` | when | yes: ... |".
std::string row_of(Errc code) {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");  // NOLINT(concurrency-mt-unsafe)
  std::ifstream file(std::string(root ? root : ".") + "/docs/errors.md");
  const std::string begin = "| `" + std::string(name_of(code)) + "` |";
  for (std::string line; std::getline(file, line);) {
    if (line.starts_with(begin)) return line;
  }
  return {};
}

TEST(Errc, IsRetryableAsDocumented) {
  for (int i = 0; i <= static_cast<int>(kLast); ++i) {
    const auto code = static_cast<Errc>(i);
    const std::string row = row_of(code);
    const auto end = row.rfind(" |"), begin = row.rfind("| ", end - 1);
    ASSERT_NE(begin, row.npos) << "no row for " << name_of(code);
    const std::string cell = row.substr(begin + 2, end - begin - 2);
    ASSERT_TRUE(cell.starts_with("yes") || cell.starts_with("no")) << row;
    EXPECT_EQ(is_retryable(code), cell.starts_with("yes")) << row;
  }
}

TEST(Errc, OfUnknownValueIsNotRetryable) {
  EXPECT_FALSE(is_retryable(static_cast<Errc>(99)));
  EXPECT_EQ(name_of(static_cast<Errc>(99)), "system");
}

}  // namespace
}  // namespace dssm
