// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/sample_printer.hpp"

#include <gtest/gtest.h>

#include <cstring>

#include "tests/unit/client/dssmctl/printed.hpp"

namespace dssm::ctl {
namespace {

const StreamId kStream{"s", 1, "pc1"};

std::string print(SampleForm form, std::vector<Field> fields, std::span<const std::byte> payload,
                  SampleInfo info, bool full = false, std::uint64_t lost = 0, bool iso = false) {
  return printed([&](Output& out) {
    SamplePrinter printer(out, {form, full, iso}, kStream, std::move(fields));
    printer.begin();
    printer.sample(info, payload, {lost, 3});
  });
}

SampleInfo info_of(Duration clock_error = kUnknownClockError) {
  return {7, time_from_ns(1'500'000'000), clock_error};
}

TEST(CsvCell, QuotesAsRfc4180Says) {
  EXPECT_EQ(csv_cell("plain text"), "plain text");
  EXPECT_EQ(csv_cell(""), "");
  EXPECT_EQ(csv_cell("a,b"), "\"a,b\"");
  EXPECT_EQ(csv_cell("say \"hi\""), "\"say \"\"hi\"\"\"");
  EXPECT_EQ(csv_cell("two\nlines"), "\"two\nlines\"");
  EXPECT_EQ(csv_cell("two\rlines"), "\"two\rlines\"");
}

TEST(SamplePrinter, PrintsCsvWithAColumnPerElement) {
  std::byte payload[12] = {};
  std::memcpy(payload, "x,\"y\"", 5);
  payload[8] = std::byte{1};
  payload[10] = std::byte{2};
  const std::vector<Field> fields = {{"odd,name", Scalar::character, 0, 8, 1},
                                     {"v", Scalar::uint16, 8, 2, 2}};
  EXPECT_EQ(print(SampleForm::csv, fields, payload, info_of(Duration(3))),
            "tid,time_ns,clock_error_ns,\"odd,name\",v[0],v[1]\n"
            "7,1500000000,3,\"x,\"\"y\"\"\",1,2\n");
}

TEST(SamplePrinter, PrintsTimesAsIso8601) {
  const auto printed_as = [](SampleForm form) {
    return print(form, {}, {}, info_of(), false, 0, true);
  };
  EXPECT_EQ(printed_as(SampleForm::csv),
            "tid,time,clock_error_ns,payload_hex\n7,1970-01-01T00:00:01.500000000Z,,\n");
  EXPECT_NE(printed_as(SampleForm::text).find("time: 1970-01-01T00:00:01.500000000Z\n"),
            std::string::npos);
  EXPECT_NE(printed_as(SampleForm::json).find("\"time_ns\":1500000000"), std::string::npos);
}

TEST(SamplePrinter, LeavesAnUnknownClockErrorEmptyInCsvAndNullInJson) {
  const std::byte payload[1] = {std::byte{0xab}};
  EXPECT_EQ(print(SampleForm::csv, {}, payload, info_of()),
            "tid,time_ns,clock_error_ns,payload_hex\n7,1500000000,,ab\n");
  EXPECT_EQ(print(SampleForm::json, {}, payload, info_of(), false, 2),
            "{\"stream\":\"s:1@pc1\",\"tid\":7,\"time_ns\":1500000000,\"clock_error_ns\":null,"
            "\"lost\":2,\"restarts\":3,\"payload_bytes\":1,\"payload_hex\":\"ab\"}\n");
}

TEST(SamplePrinter, ShortensLongPayloadsByDefault) {
  const std::vector<std::byte> payload(200, std::byte{'.'});
  const std::string shortened = print(SampleForm::text, {}, payload, info_of());
  EXPECT_NE(shortened.find("... 136 bytes more"), std::string::npos) << shortened;
  EXPECT_EQ(shortened.find("00000040"), std::string::npos) << shortened;
  const std::string full = print(SampleForm::text, {}, payload, info_of(), true);
  EXPECT_EQ(full.find("more"), std::string::npos) << full;
  EXPECT_NE(full.find("000000c0"), std::string::npos) << full;
}

TEST(SamplePrinter, PrintsHowManySamplesAreMissing) {
  const std::byte payload[1] = {};
  EXPECT_TRUE(print(SampleForm::text, {}, payload, info_of(), false, 5).starts_with("# 5 samples"));
  EXPECT_TRUE(print(SampleForm::text, {}, payload, info_of()).starts_with("tid: 7\n"));
}

TEST(SamplePrinter, EscapesFieldNames) {
  const std::byte payload[1] = {};
  const std::string text =
      print(SampleForm::text, {{"\x1b[2J", Scalar::uint8, 0, 1, 1}}, payload, info_of());
  EXPECT_NE(text.find("\\x1b[2J: 0\n"), std::string::npos) << text;
}

}  // namespace
}  // namespace dssm::ctl
