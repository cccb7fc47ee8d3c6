// SPDX-License-Identifier: Apache-2.0
//
// Numbers, times and names as dssmctl reads and prints them.
#include "client/dssmctl/text.hpp"

#include <gtest/gtest.h>
#include <locale.h>

#include <array>
#include <cstdlib>
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

// Prints UTF-8 while it lives.
struct Utf8Locale {
  Utf8Locale() {
    EXPECT_TRUE(::setlocale(LC_CTYPE, "C.UTF-8"));
    use_locale();
  }
  ~Utf8Locale() {
    ::setlocale(LC_CTYPE, "C");
    use_locale();
  }
};

TEST(Text, PrintsUtf8WhereTheLocaleHasIt) {
  const Utf8Locale locale;
  EXPECT_EQ(escaped("\u00fcber \u30ab\u30e1\u30e9"), "\u00fcber \u30ab\u30e1\u30e9");
  EXPECT_EQ(columns_of("\u00fcber \u30ab\u30e1\u30e9"), 11U) << "wide characters take two";
  EXPECT_EQ(double_quoted("a\"\u00e9\\"), "\"a\\\"\u00e9\\\\\"");
  EXPECT_EQ(shortened("\u30ab\u30e1\u30e9", 4), "\u30ab\u2026");
  EXPECT_EQ(shortened("abc", 3), "abc");
}

TEST(Text, EscapesWhatDeceivesAlsoWhereTheLocaleHasUtf8) {
  const Utf8Locale locale;
  const std::pair<const char*, const char*> cases[] = {
      {"\u202egnp", "\\xe2\\x80\\xaegnp"},  // right-to-left override
      {"a\u200bb", "a\\xe2\\x80\\x8bb"},    // zero-width space
      {"e\u0301", "e\\xcc\\x81"},           // combining
      {"\u00ad", "\\xc2\\xad"},             // soft hyphen
      {"\xc2\x9b[31m", "\\xc2\\x9b[31m"},   // a control character of 8 bits
      {"\x1b[31m", "\\x1b[31m"},
      {"\xc3", "\\xc3"},                    // incomplete
      {"\xc0\x8a", "\\xc0\\x8a"},           // overlong
      {"\xed\xa0\x80", "\\xed\\xa0\\x80"},  // a surrogate
      {"\xff\u00e9", "\\xff\u00e9"},
  };
  for (const auto& [bytes, text] : cases) EXPECT_EQ(escaped(bytes), text);
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
  EXPECT_EQ(list_text({"a", "b", "c"}, 3), "a, b, c");
  EXPECT_EQ(list_text({"a", "b", "c"}, 1), "a, and 2 more");
}

TEST(Text, WritesSecondsExactlyOverTheWholeRange) {
  EXPECT_EQ(seconds_text(0), "0.000000000");
  EXPECT_EQ(seconds_text(1'700'000'000'123'456'789), "1700000000.123456789");
  EXPECT_EQ(seconds_text(-1), "-0.000000001");
  EXPECT_EQ(seconds_text(std::numeric_limits<std::int64_t>::min()), "-9223372036.854775808");
}

TEST(Text, ReadsSecondsExactly) {
  const auto ns = [](std::string_view text) { return to_ns(parse_duration(text).value()); };
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

TEST(Text, ReadsDurationsWithUnits) {
  EXPECT_EQ(parse_duration("25ns").value(), 25ns);
  EXPECT_EQ(parse_duration("1.5us").value(), 1500ns);
  EXPECT_EQ(parse_duration("-500ms").value(), -500ms);
  EXPECT_EQ(parse_duration("3s").value(), 3s);
  EXPECT_EQ(parse_duration("2min").value(), 120s);
  EXPECT_EQ(parse_duration("1.5h").value(), 90min);
  EXPECT_EQ(parse_duration("2d").value(), 48h);
  EXPECT_EQ(parse_duration("1e3ms").value(), 1s);
  EXPECT_EQ(parse_duration("36000000000000ns").value(), 10h);
}

TEST(Text, RefusesWhatIsNoDuration) {
  for (const char* text :
       {"", "-", ".", "1.2.3", "1x", "1 s", " 1", "nan", "inf", "1e", "--1", "s", "-ms"}) {
    const Result<Duration> result = parse_duration(text);
    ASSERT_FALSE(result) << text;
    EXPECT_EQ(result.error().code, Errc::invalid_argument) << text;
    EXPECT_NE(result.error().message.find("not a duration"), std::string::npos) << text;
  }
  for (const char* text :
       {"9223372036.854775808", "1e30", "99999999999999999999999", "200000d", "1e10h"}) {
    const Result<Duration> result = parse_duration(text);
    ASSERT_FALSE(result) << text;
    EXPECT_NE(result.error().message.find("292 years"), std::string::npos) << text;
  }
}

// 2026-11-27T08:00:00Z
constexpr std::int64_t kMorning = 1'795'766'400;
constexpr Time kNow = time_from_ns(kMorning * 1'000'000'000);

TEST(Text, ReadsMomentsInEveryForm) {
  ::setenv("TZ", "JST-9", 1);
  ::tzset();
  const auto at = [](std::string_view text) {
    const Result<Moment> moment = parse_moment(text, kNow);
    EXPECT_TRUE(moment) << text << ": " << moment.error().message;
    EXPECT_FALSE(moment->back) << text;
    return to_ns(moment->time - kNow.time_since_epoch());
  };
  EXPECT_EQ(at("now"), 0);
  EXPECT_EQ(at("1795766400.25"), 250'000'000);
  EXPECT_EQ(at("2026-11-27T08:00:00Z"), 0);
  EXPECT_EQ(at("2026-11-27 08:00Z"), 0);
  EXPECT_EQ(at("2026-11-27T08:00:00.1234567891Z"), 123'456'789);
  EXPECT_EQ(at("2026-11-27T09:30:00+01:30"), 0);
  EXPECT_EQ(at("2026-11-27T05:00:00-0300"), 0);
  EXPECT_EQ(at("2026-11-27T17:00:00"), 0) << "local time";
  EXPECT_EQ(at("2026-11-27"), -17 * 3600'000'000'000) << "local midnight";
  EXPECT_EQ(parse_moment("-3s", kNow)->back, -3s);
  EXPECT_EQ(parse_moment("-500ms", kNow)->back, -500ms);
  EXPECT_EQ(parse_moment("-1.5", kNow)->back, -1500ms);
  EXPECT_EQ(parse_moment("-0", kNow)->back, 0s);
  EXPECT_FALSE(parse_moment("+2s", kNow));
  EXPECT_EQ(parse_recorded_moment("+2s", kNow)->after_start, 2s);
  EXPECT_EQ(parse_recorded_moment("+0.5", kNow)->after_start, 500ms);
  EXPECT_EQ(parse_recorded_moment("-3s", kNow)->back, -3s);
  EXPECT_EQ(parse_recorded_moment("1795766400", kNow)->time, kNow);
  // Without a sign it may be meant from the beginning.
  EXPECT_TRUE(parse_recorded_moment("2s", kNow).error().message.ends_with("+2s"));
  for (const char* text : {"+", "+-2s", "++2s", "+soon"}) {
    EXPECT_FALSE(parse_recorded_moment(text, kNow)) << text;
  }
  ::unsetenv("TZ");
  ::tzset();
}

TEST(Text, RefusesWhatIsNoMoment) {
  for (const char* text :
       {"", "soon", "3s", "2026-13-01", "2026-02-30", "2026-1-1", "2026-11-27T", "2026-11-27T25:00",
        "2026-11-27T08", "2026-11-27T08:00:61Z", "2026-11-27T08:00:00.Z", "2026-11-27T08:00:00ZZ",
        "2026-11-27T08:00:00+9", "2026-11-27T08:00:00+25:00", "9999-01-01Z", "9999-01-01T00:00Z",
        "99999999999"}) {
    const Result<Moment> moment = parse_moment(text, kNow);
    ASSERT_FALSE(moment) << text;
    EXPECT_EQ(moment.error().code, Errc::invalid_argument) << text;
    EXPECT_TRUE(moment.error().message.starts_with("'")) << moment.error().message;
  }
}

TEST(Text, WritesMomentsAsTheyCanBeRead) {
  EXPECT_EQ(iso_text(kNow), "2026-11-27T08:00:00.000000000Z");
  EXPECT_EQ(iso_text(time_from_ns(-1)), "1969-12-31T23:59:59.999999999Z");
  for (const Time time : {Time::min(), Time::max(), kNow + 123456789ns}) {
    EXPECT_EQ(parse_moment(iso_text(time), kNow)->time, time) << iso_text(time);
  }
  EXPECT_EQ(time_text(kNow, false), "1795766400.000000000");
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
