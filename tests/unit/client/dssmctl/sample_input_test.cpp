// SPDX-License-Identifier: Apache-2.0
//
// Samples from text: what echo prints comes back as the same bytes, and what does not fit is
// refused with what is possible.
#include "client/dssmctl/sample_input.hpp"

#include <gtest/gtest.h>

#include <cstring>
#include <limits>
#include <sstream>

#include "client/dssmctl/fields.hpp"
#include "client/dssmctl/sample_printer.hpp"
#include "tests/unit/client/dssmctl/printed.hpp"

namespace dssm::ctl {
namespace {

// A field of each kind, text, an array, and an array of structs with two members.
TypeInfo type_of_all_kinds() {
  TypeInfo type{"All", 128, 8, {}};
  std::uint64_t offset = 0;
  for (int kind = static_cast<int>(Scalar::boolean); kind <= static_cast<int>(Scalar::float64);
       ++kind) {
    const auto scalar = static_cast<Scalar>(kind);
    type.fields.push_back({std::string(name_of(scalar)), scalar, offset, 1, 0});
    offset += 8;
  }
  type.fields.push_back({"text", Scalar::character, offset, 8, 1});
  type.fields.push_back({"v[0]", Scalar::int16, offset + 8, 1, 0});  // a name as an element's
  type.fields.push_back({"point.x", Scalar::float32, offset + 10, 2, 8});
  type.fields.push_back({"point.y", Scalar::int8, offset + 14, 2, 8});
  return type;
}

template <class T>
void put(std::vector<std::byte>& payload, std::size_t offset, T value) {
  std::memcpy(payload.data() + offset, &value, sizeof value);
}

std::vector<std::byte> extreme_payload() {
  std::vector<std::byte> payload(128);
  put(payload, 0, true);
  put(payload, 8, '"');
  put(payload, 16, std::numeric_limits<std::int8_t>::min());
  put(payload, 24, std::numeric_limits<std::uint8_t>::max());
  put(payload, 32, std::numeric_limits<std::int16_t>::min());
  put(payload, 40, std::numeric_limits<std::uint16_t>::max());
  put(payload, 48, std::numeric_limits<std::int32_t>::min());
  put(payload, 56, std::numeric_limits<std::uint32_t>::max());
  put(payload, 64, std::numeric_limits<std::int64_t>::min());
  put(payload, 72, std::numeric_limits<std::uint64_t>::max());
  put(payload, 80, 0.1F);
  put(payload, 88, 0.1);
  std::memcpy(payload.data() + 96, "a,\"\nb", 5);
  put(payload, 104, std::int16_t{-2});
  put(payload, 106, -1.5F), put(payload, 114, 1e-30F);
  put(payload, 110, std::int8_t{3}), put(payload, 118, std::int8_t{-4});
  return payload;
}

std::string echoed(const TypeInfo& type, std::span<const std::byte> payload, SampleForm form,
                   Duration clock_error = Duration(7), bool iso = false) {
  return printed([&](Output& out) {
    SamplePrinter printer(out, {.form = form, .full = true, .iso = iso}, {"s", 0, "pc1"},
                          readable_fields_untrusted(type));
    printer.begin();
    for (int i = 0; i < 2; ++i) {
      printer.sample({5, time_from_ns(1'500'000'000 + i), clock_error}, payload, {});
    }
  });
}

class SampleForms : public testing::TestWithParam<SampleForm> {};

TEST_P(SampleForms, ComeBackAsTheyWere) {
  const TypeInfo type = type_of_all_kinds();
  const std::vector<std::byte> payload = extreme_payload();
  ASSERT_FALSE(readable_fields_untrusted(type).empty());
  for (const bool iso : {false, true}) {
    std::istringstream text(echoed(type, payload, GetParam(), Duration(7), iso));
    SampleLines lines(type, text);
    for (int i = 0; i < 2; ++i) {
      const Result<std::optional<SampleInput>> sample = lines.next();
      ASSERT_TRUE(sample) << sample.error().message;
      ASSERT_TRUE(*sample);
      EXPECT_TRUE(std::ranges::equal((*sample)->payload(), payload)) << text.str();
      EXPECT_EQ((*sample)->time, time_from_ns(1'500'000'000 + i));
      EXPECT_EQ((*sample)->clock_error, Duration(7));
    }
    EXPECT_FALSE(lines.next().value());
  }
}

TEST_P(SampleForms, ComeBackAsTheyWereWithoutADescription) {
  const TypeInfo type{"", 128, 1, {}};
  const std::vector<std::byte> payload(17, std::byte{0xa5});
  std::istringstream text(echoed(type, payload, GetParam(), kUnknownClockError));
  const Result<std::optional<SampleInput>> sample = SampleLines(type, text).next();
  ASSERT_TRUE(sample && *sample) << sample.error().message;
  EXPECT_TRUE(std::ranges::equal((*sample)->payload(), payload));
  EXPECT_EQ((*sample)->clock_error, kForeignClockError);
}

INSTANTIATE_TEST_SUITE_P(All, SampleForms, testing::Values(SampleForm::json, SampleForm::csv));

TEST(SampleLines, TakesNestedObjectsAndColumnsInAnyOrder) {
  const TypeInfo type{"P",
                      24,
                      8,
                      {{"pose.x", Scalar::float64, 0, 1, 0},
                       {"pose.y", Scalar::float64, 8, 1, 0},
                       {"time_ns", Scalar::int64, 16, 1, 0}}};
  const auto values = [&](const std::string& text) {
    std::istringstream in(text);
    const Result<std::optional<SampleInput>> sample = SampleLines(type, in).next();
    if (!sample) return sample.error().message;
    EXPECT_FALSE((*sample)->time);
    std::string all;
    for (const Field& field : type.fields) all += field_text((*sample)->payload(), field, 9) + " ";
    return all;
  };
  EXPECT_EQ(values("\n{\"pose\": {\"x\": 1, \"y\": null}, \"time_ns\": 3}\n"), "1 nan 3 ");
  EXPECT_EQ(values("time_ns,pose.x\r\n4,2.5\r\n"), "2.5 0 4 ");
  EXPECT_EQ(values("pose.x,pose.y\n1\n"), "line 2: 1 cells, and the header line has 2");
  EXPECT_EQ(values("pose.z\n"),
            "line 1: column 1: no field 'pose.z'; there are 'pose.x', 'pose.y', "
            "'time_ns'");
  EXPECT_EQ(values("{\"pose.x\": 1}}\n"),
            "line 1: this is not a JSON object on one line, as {\"x\": 1}");
}

TEST(SampleLines, RefuseWhatCouldNotBePrinted) {
  const TypeInfo type{
      "P", 16, 8, {{"x", Scalar::float64, 0, 1, 0}, {"name", Scalar::character, 8, 8, 1}}};
  const auto result = [&](const std::string& text) {
    std::istringstream in(text);
    const Result<std::optional<SampleInput>> sample = SampleLines(type, in).next();
    return sample ? field_text((*sample)->payload(), type.fields[1], 9) : sample.error().message;
  };
  EXPECT_EQ(result("name\n\"\"\"a\"\"\"\n"), "\"\\\"a\\\"\"") << "text is not JSON";
  EXPECT_EQ(result("name\n[1]\n"), "\"[1]\"");
  EXPECT_EQ(
      result("x,name\n\"1\"2,a\n"),
      "line 2: a quote inside a quoted cell is written twice, and a comma comes after its end");
  EXPECT_EQ(result("x,name\n1,a\n\"2,b\n3,c\n").find("line"), std::string::npos);
  EXPECT_EQ(result("name\n\"a\nb\n"), "line 2: a cell begins with a quote, and has no end");
  const std::string echoed = "tid,time_ns,clock_error_ns,name\n1,";
  EXPECT_EQ(result(echoed + "99999999999999999999,1,a\n").find("line 2: "), 0u);
  EXPECT_EQ(result(echoed + "1,-1,a\n"),
            "line 2: clock_error_ns cannot be '-1': it is in nanoseconds, 0 or more");
  EXPECT_EQ(result(echoed + "1,9223372036854775808,a\n").find("line 2: clock_error_ns"), 0u);
  EXPECT_EQ(result("{\"time_ns\":1,\"clock_error_ns\":-5,\"fields\":{}}\n").find("line 1: clock"),
            0u);
  EXPECT_EQ(result("{\"time_ns\":18446744073709551615,\"fields\":{}}\n").find("line 1: "), 0u);
  const std::string deep(100'000, '[');
  EXPECT_EQ(result("{\"x\":" + deep + std::string(100'000, ']') + "}\n"),
            "line 1: this is not a JSON object on one line, as {\"x\": 1}");
  EXPECT_FALSE(SampleInput(type).set_text("x", deep));
}

TEST(SampleInput, SaysWhatAFieldTakes) {
  const TypeInfo type = type_of_all_kinds();
  const auto error = [&](const std::string& name, const std::string& text) {
    const Result<void> set = SampleInput(type).set_text(name, text);
    return set ? std::string() : set.error().message;
  };
  EXPECT_EQ(error("int8", "128"),
            "field 'int8' cannot be '128': it takes a whole number from -128 "
            "to 127");
  EXPECT_EQ(error("uint16", "-1"),
            "field 'uint16' cannot be '-1': it takes a whole number from 0 to "
            "65535");
  EXPECT_EQ(error("int32", "1.0"),
            "field 'int32' cannot be '1.0': it takes a whole number from "
            "-2147483648 to 2147483647");
  EXPECT_EQ(error("bool", "yes"), "field 'bool' cannot be 'yes': it takes true or false");
  EXPECT_EQ(error("float64", "1,5"),
            "field 'float64' cannot be '1,5': it takes a number (float64)");
  EXPECT_NE(error("float32", "1e300"), "");
  EXPECT_EQ(error("char", "ab"), "field 'char' cannot be 'ab': it takes one byte");
  EXPECT_EQ(error("text", "123456789"),
            "field 'text' cannot be '123456789': it takes text of up to 8 bytes");
  EXPECT_EQ(error("point.x", "1"),
            "field 'point.x' cannot be '1': it takes a JSON array of up to 2 "
            "values");
  EXPECT_EQ(error("point.x", "[1,2,3]"),
            "field 'point.x' cannot be '[1,2,3]': it takes an array of up to 2 values");
  EXPECT_EQ(error("point.x[2]", "1"), "no element 'point.x[2]': field 'point.x' has 2");
  EXPECT_EQ(error("point", "1"), "field 'point' has several members; set 'point.x', 'point.y'");
  EXPECT_EQ(error("text", "\"8 bytes.\""), "");
  EXPECT_EQ(error("v[0]", "-3"), "");
}

TEST(SampleInput, SetsOnlyTheBitsOfABitField) {
  const TypeInfo type{"Bits",
                      8,
                      8,
                      {{"low", Scalar::uint8, 0, 1, 1, 3, 0},
                       {"negative", Scalar::int8, 0, 1, 1, 5, 3},
                       {"bit", Scalar::boolean, 1, 1, 1, 1, 7},
                       {"all", Scalar::uint64, 0, 1, 8, 64, 0}}};
  SampleInput sample(type);
  ASSERT_TRUE(sample.set_text("all", "18446744073709551615"));
  ASSERT_TRUE(sample.set_text("low", "5"));
  ASSERT_TRUE(sample.set_text("negative", "-16"));
  ASSERT_TRUE(sample.set_text("bit", "false"));
  const auto value = [&](std::size_t field) {
    return field_text(sample.payload(), type.fields[field], 10);
  };
  EXPECT_EQ(value(0), "5");
  EXPECT_EQ(value(1), "-16");
  EXPECT_EQ(value(2), "false");
  EXPECT_EQ(value(3), "18446744073709518725") << "the others are as they were";
  const auto refusal = [&](const char* name, const char* text) {
    const Result<void> set = sample.set_text(name, text);
    return set ? "taken" : set.error().message;
  };
  EXPECT_EQ(refusal("low", "8"), "field 'low' cannot be '8': it takes a whole number from 0 to 7");
  EXPECT_EQ(refusal("negative", "16"),
            "field 'negative' cannot be '16': it takes a whole number from -16 to 15");
  EXPECT_EQ(refusal("negative", "-17"),
            "field 'negative' cannot be '-17': it takes a whole number from -16 to 15");
}

}  // namespace
}  // namespace dssm::ctl
