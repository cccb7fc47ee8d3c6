// SPDX-License-Identifier: Apache-2.0
#include <gtest/gtest.h>

#include <dssm/result.hpp>
#include <memory>
#include <string>

namespace dssm {
namespace {

TEST(Result, ValueOrGivesTheFallbackOnlyForAnError) {
  const Result<int> three = 3;
  const Result<int> none = Error{Errc::not_found, "no number"};
  EXPECT_EQ(three.value_or(7), 3);
  EXPECT_EQ(none.value_or(7), 7);
  EXPECT_EQ(Result<std::string>(Error{Errc::not_found, ""}).value_or("none"), "none");
}

TEST(Result, ValueOrMovesOutOfATemporary) {
  EXPECT_EQ(*Result(std::make_unique<int>(3)).value_or(nullptr), 3);
  EXPECT_EQ(Result<std::unique_ptr<int>>(Error{}).value_or(nullptr), nullptr);
}

}  // namespace
}  // namespace dssm
