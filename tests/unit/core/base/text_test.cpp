// SPDX-License-Identifier: Apache-2.0
#include "core/base/text.hpp"

#include <gtest/gtest.h>

namespace dssm {
namespace {

TEST(TextTest, ReplacesWhatWouldChangeTheDisplay) {
  EXPECT_EQ(printable("a\xc2\x9b"
                      "31mb"),
            "a?31mb")
      << "C1: a terminal's CSI";
  EXPECT_EQ(printable("a\x9b"
                      "31m"),
            "a?31m")
      << "the same for terminals of 8 bits";
  EXPECT_EQ(printable("pc1\xe2\x80\xae"
                      "2cp"),
            "pc1?2cp")
      << "right to left";
  EXPECT_EQ(printable("a\xe2\x80\xa8"
                      "b\xe2\x81\xa6\xd8\x9c"),
            "a?b??");
  EXPECT_EQ(printable("\xf0\x9f\xa4\x96 \xe2\x82"), "\xf0\x9f\xa4\x96 ??");
  EXPECT_EQ(printable("a\nb\x7f\tc é"), "a?b??c é");
  EXPECT_EQ(in_quotes("a\n"), "'a?'");
  EXPECT_TRUE(has_control("a\x1f"));
  EXPECT_FALSE(has_control("a b~\xc3\xa9"));
}

TEST(TextTest, WritesHexadecimalDigits) {
  EXPECT_EQ(hex(std::string_view("\x00\xff\x10", 3)), "00ff10");
  EXPECT_EQ(hex(std::uint64_t{0x12ab}), "00000000000012ab");
  EXPECT_EQ(hex(std::string_view()), "");
}

TEST(TextTest, TakesOnlyHostNamesThatFitIntoStreamNames) {
  EXPECT_TRUE(check_host_name("pc1"));
  EXPECT_TRUE(check_host_name("A-9"));
  EXPECT_TRUE(check_host_name(std::string(31, 'x')));
  EXPECT_FALSE(check_host_name(""));
  EXPECT_FALSE(check_host_name(std::string(32, 'x')));
  EXPECT_FALSE(check_host_name("pc1.local"));
  EXPECT_FALSE(check_host_name("pc 1"));
  EXPECT_FALSE(check_host_name("pc@1"));
}

}  // namespace
}  // namespace dssm
