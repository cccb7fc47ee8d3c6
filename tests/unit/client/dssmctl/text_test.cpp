// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/text.hpp"

#include <gtest/gtest.h>

#include <array>
#include <limits>

namespace dssm::ctl {
namespace {

using namespace std::chrono_literals;

TEST(Text, EscapesControlAndForeignBytesAsBashReadsThem) {
  EXPECT_EQ(escaped("plain name"), "plain name");
  EXPECT_EQ(escaped("a\nb\tc\rd"), "a\\nb\\tc\\rd");
  EXPECT_EQ(escaped("\x1b[31m"), "\\x1b[31m");
  EXPECT_EQ(escaped("caf\xc3\xa9\x7f"), "caf\\xc3\\xa9\\x7f");
  EXPECT_EQ(escaped("a\\b"), "a\\\\b");
}

TEST(Text, EscapesMessagesIntoOneLineButKeepsTheirBackslashes) {
  EXPECT_EQ(escaped_message("one\ntwo \\ \x1b"), "one\\ntwo \\ \\x1b");
}

TEST(Text, DrawsABarToTheScaleOfTheLimit) {
  EXPECT_EQ(bar_text(0ns, 1ms), "[          ]");
  EXPECT_EQ(bar_text(1ns, 1ms), "[#         ]");
  EXPECT_EQ(bar_text(300us, 1ms), "[###       ]");
  EXPECT_EQ(bar_text(301us, 1ms), "[####      ]");
  EXPECT_EQ(bar_text(1ms, 1ms), "[##########]");
  EXPECT_EQ(bar_text(1ms + 1ns, 1ms), "[##########>");
  EXPECT_EQ(bar_text(kUnknownClockError - 1ns, kUnknownClockError - 1ns), "[##########]");
  EXPECT_EQ(bar_text(0ns, 0ns), "[          ]");
  EXPECT_EQ(bar_text(1ns, 0ns), "[##########>");
  EXPECT_EQ(bar_text(kUnknownClockError, 1ms), "-");
}

TEST(Text, WritesDurationsWithThreeDigitsAndAUnit) {
  EXPECT_EQ(duration_text(0ns), "0 ns");
  EXPECT_EQ(duration_text(999ns), "999 ns");
  EXPECT_EQ(duration_text(1500ns), "1.50 us");
  EXPECT_EQ(duration_text(999'499ns), "999 us");
  EXPECT_EQ(duration_text(999'500ns), "1.00 ms");
  EXPECT_EQ(duration_text(25ms), "25.0 ms");
  EXPECT_EQ(duration_text(250ms), "250 ms");
  EXPECT_EQ(duration_text(1s), "1.00 s");
  EXPECT_EQ(duration_text(119s), "119 s");
  EXPECT_EQ(duration_text(125s), "2m05s");
  EXPECT_EQ(duration_text(2h + 5min + 59s), "2h05m");
  EXPECT_EQ(duration_text(49h), "2d01h");
  EXPECT_EQ(duration_text(-25ms), "-25.0 ms");
  EXPECT_EQ(duration_text(Duration::min()), "-" + duration_text(Duration::max()));
}

TEST(Text, WritesUnknownBounds) {
  EXPECT_EQ(bound_text(1500us), "1.50 ms");
  EXPECT_EQ(bound_text(kUnknownClockError), "unknown");
}

TEST(Text, WritesListsEscaped) {
  EXPECT_EQ(list_text({"pc2:13776", "10.0.0.2:13776"}), "pc2:13776, 10.0.0.2:13776");
  EXPECT_EQ(list_text({"\x1b[2J"}), "\\x1b[2J");
  EXPECT_EQ(list_text({}), "");
}

TEST(Text, WritesSecondsExactlyOverTheWholeRange) {
  EXPECT_EQ(seconds_text(0), "0.000000000");
  EXPECT_EQ(seconds_text(1'700'000'000'123'456'789), "1700000000.123456789");
  EXPECT_EQ(seconds_text(-1), "-0.000000001");
  EXPECT_EQ(seconds_text(std::numeric_limits<std::int64_t>::min()), "-9223372036.854775808");
}

TEST(Text, ReadsSecondsExactly) {
  const auto ns = [](std::string_view text) { return to_ns(parse_seconds(text).value()); };
  EXPECT_EQ(ns("1700000000.123456789"), 1'700'000'000'123'456'789);
  EXPECT_EQ(ns("0.025"), 25'000'000);
  EXPECT_EQ(ns(".5"), 500'000'000);
  EXPECT_EQ(ns("5."), 5'000'000'000);
  EXPECT_EQ(ns("-1.5"), -1'500'000'000);
  EXPECT_EQ(ns("+2"), 2'000'000'000);
  EXPECT_EQ(ns("0.0000000019"), 1);  // finer digits are cut off
  EXPECT_EQ(ns("2.5e-3"), 2'500'000);
  EXPECT_EQ(ns("9223372036.854775807"), std::numeric_limits<std::int64_t>::max());
}

TEST(Text, RefusesWhatIsNoNumberOfSeconds) {
  for (const char* text : {"", "-", ".", "1.2.3", "1s", " 1", "nan", "inf", "1e", "--1"}) {
    const Result<Duration> result = parse_seconds(text);
    ASSERT_FALSE(result) << text;
    EXPECT_EQ(result.error().code, Errc::invalid_argument) << text;
    EXPECT_NE(result.error().message.find("not a number of seconds"), std::string::npos) << text;
  }
  for (const char* text : {"9223372036.854775808", "1e30", "99999999999999999999999"}) {
    const Result<Duration> result = parse_seconds(text);
    ASSERT_FALSE(result) << text;
    EXPECT_NE(result.error().message.find("292 years"), std::string::npos) << text;
  }
}

TEST(Text, ReadsWholeNumbersInTheirRangeOnly) {
  EXPECT_EQ(parse_whole("2", 2, 5).value(), 2U);
  EXPECT_EQ(parse_whole("5", 2, 5).value(), 5U);
  for (const char* text : {"1", "6", "-1", "", "3x", "3.0", " 3", "99999999999999999999"}) {
    EXPECT_FALSE(parse_whole(text, 2, 5)) << text;
  }
  EXPECT_EQ(parse_whole("x", 2, 5).error().message, "'x' is not a whole number from 2 to 5");
}

TEST(Text, ReadsFiniteNumbersOnly) {
  EXPECT_EQ(parse_real("-1.5").value(), -1.5);
  EXPECT_EQ(parse_real("+2").value(), 2.0);
  for (const char* text : {"", "nan", "inf", "1e999", "1x"}) EXPECT_FALSE(parse_real(text)) << text;
}

TEST(Text, DumpsBytesInLinesOfSixteen) {
  std::array<std::byte, 18> bytes{};
  for (std::size_t i = 0; i < bytes.size(); ++i) bytes[i] = static_cast<std::byte>('a' + i);
  bytes[17] = std::byte{0x1b};
  EXPECT_EQ(hex_dump(bytes, "> "),
            "> 00000000  61 62 63 64 65 66 67 68  69 6a 6b 6c 6d 6e 6f 70  |abcdefghijklmnop|\n"
            "> 00000010  71 1b                                             |q.|\n");
  EXPECT_EQ(hex_text(std::span(bytes).first(2)), "6162");
}

TEST(Text, WritesAmountsWithTheirUnits) {
  EXPECT_EQ(bytes_text(1), "1 byte");
  EXPECT_EQ(bytes_text(9999), "9999 bytes");
  EXPECT_EQ(bytes_text(65536), "64.0 KiB");
  EXPECT_EQ(bytes_text(64ULL << 20), "64.0 MiB");
  EXPECT_EQ(bytes_text(3ULL << 40), "3.00 TiB");
  EXPECT_EQ(byte_rate_text(640), "640 B/s");
  EXPECT_EQ(byte_rate_text(1.5 * 1024 * 1024), "1.50 MiB/s");
}

TEST(Text, StaysAtTheEndsOfTimeWhereDifferencesOverflow) {
  EXPECT_EQ(saturating_sub(Time::max(), Time::min()), Duration::max());
  EXPECT_EQ(saturating_sub(Time::min(), Time::max()), Duration::min());
  EXPECT_EQ(saturating_sub(time_from_ns(5), time_from_ns(7)), Duration(-2));
  EXPECT_EQ(saturating_add(Time::min(), Duration(-1)), Time::min());
  EXPECT_EQ(saturating_add(Time::max(), Duration(1)), Time::max());
}

}  // namespace
}  // namespace dssm::ctl
