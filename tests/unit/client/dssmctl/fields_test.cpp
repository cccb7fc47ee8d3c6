// SPDX-License-Identifier: Apache-2.0
//
// Fields of all kinds by name, in full, shortened, and of samples that are shorter than their type.
#include "client/dssmctl/fields.hpp"

#include <gtest/gtest.h>

#include <cmath>
#include <cstring>
#include <dssm/describe.hpp>
#include <limits>

namespace dssm::ctl {
namespace {

struct Point {
  double x;
  float y[2];
};
DSSM_DESCRIBE(Point, x, y)

struct Everything {
  bool yes;
  char letter;
  std::int8_t i8;
  std::uint8_t u8;
  std::int16_t i16;
  std::uint16_t u16;
  std::int32_t i32;
  std::uint32_t u32;
  std::int64_t i64;
  std::uint64_t u64;
  float f32;
  double f64;
  char text[8];
  Point point;
  Point points[2];
};
DSSM_DESCRIBE(Everything, yes, letter, i8, u8, i16, u16, i32, u32, i64, u64, f32, f64, text, point,
              points)

Everything example() {
  Everything value{};
  value.yes = true;
  value.letter = '\'';
  value.i8 = -128;
  value.u8 = 255;
  value.i16 = -32768;
  value.u16 = 65535;
  value.i32 = std::numeric_limits<std::int32_t>::min();
  value.u32 = std::numeric_limits<std::uint32_t>::max();
  value.i64 = std::numeric_limits<std::int64_t>::min();
  value.u64 = std::numeric_limits<std::uint64_t>::max();
  value.f32 = 0.1F;
  value.f64 = 0.1;
  std::memcpy(value.text, "a\"b\0cd", 6);
  value.point = {1.5, {2.5F, 3.5F}};
  value.points[0] = {10, {11, 12}};
  value.points[1] = {20, {21, 22}};
  return value;
}

class FieldsOfEverything : public testing::Test {
 protected:
  std::string text(const std::string& name, std::size_t shown = 100) const {
    return field_text(payload(), field(name), shown);
  }
  std::string json(const std::string& name) const {
    return json_text(field_json(payload(), field(name)));
  }
  const Field& field(const std::string& name) const {
    for (const Field& candidate : fields_) {
      if (candidate.name == name) return candidate;
    }
    ADD_FAILURE() << "no field " << name;
    return fields_.front();
  }
  std::span<const std::byte> payload() const {
    return std::as_bytes(std::span(&value_, 1)).first(payload_bytes_);
  }

  Everything value_ = example();
  std::size_t payload_bytes_ = sizeof value_;
  std::vector<Field> fields_ = readable_fields_untrusted(type_of<Everything>());
};

TEST_F(FieldsOfEverything, AreReadByKind) {
  EXPECT_EQ(text("yes"), "true");
  EXPECT_EQ(text("letter"), "'''");
  EXPECT_EQ(text("i8"), "-128");
  EXPECT_EQ(text("u8"), "255");
  EXPECT_EQ(text("i16"), "-32768");
  EXPECT_EQ(text("u16"), "65535");
  EXPECT_EQ(text("i32"), "-2147483648");
  EXPECT_EQ(text("u32"), "4294967295");
  EXPECT_EQ(text("i64"), "-9223372036854775808");
  EXPECT_EQ(text("u64"), "18446744073709551615");
  EXPECT_EQ(text("f32"), "0.1");
  EXPECT_EQ(text("f64"), "0.1");
  EXPECT_EQ(text("text"), "\"a\\\"b\"");
  EXPECT_EQ(text("point.x"), "1.5");
  EXPECT_EQ(text("point.y"), "[2.5, 3.5]");
}

TEST_F(FieldsOfEverything, FollowTheStrideOfArraysOfStructs) {
  EXPECT_EQ(text("points.x"), "[10, 20]");
  EXPECT_EQ(text("points[0].y"), "[11, 12]");
  EXPECT_EQ(text("points[1].y"), "[21, 22]");
}

TEST_F(FieldsOfEverything, AreExactInJson) {
  EXPECT_EQ(json("i64"), "-9223372036854775808");
  EXPECT_EQ(json("u64"), "18446744073709551615");
  EXPECT_EQ(json("yes"), "true");
  EXPECT_EQ(json("text"), "\"a\\\"b\"");
  EXPECT_EQ(json("points.x"), "[10.0,20.0]");
  EXPECT_EQ(json("f64"), "0.1");
}

TEST_F(FieldsOfEverything, AreNullInJsonWhenTheyAreNoNumber) {
  value_.f64 = std::nan("");
  value_.point.y[0] = std::numeric_limits<float>::infinity();
  EXPECT_EQ(json("f64"), "null");
  EXPECT_EQ(json("point.y"), "[null,3.5]");
  EXPECT_EQ(text("f64"), "nan");
}

TEST_F(FieldsOfEverything, ShowBytesThatAreNoUtf8Harmlessly) {
  std::memcpy(value_.text, "\x1b\xff", 3);
  EXPECT_EQ(text("text"), "\"\\x1b\\xff\"");
  EXPECT_EQ(json("text"), "\"\\u001b\\ufffd\"");
}

TEST_F(FieldsOfEverything, AreWhatAShorterSampleHas) {
  payload_bytes_ = offsetof(Everything, points[1]) + 7;  // not all of points[1].x
  EXPECT_EQ(text("points.x"), "[10]");
  EXPECT_EQ(json("points.x"), "[10.0]");
  EXPECT_EQ(element_text(payload(), field("points.x"), 1), "");
  EXPECT_EQ(text("point.x"), "1.5");
  payload_bytes_ = offsetof(Everything, text) + 2;
  EXPECT_EQ(text("text"), "\"a\\\"\"");
  EXPECT_EQ(text("point.x"), "-");
  EXPECT_EQ(json("point.x"), "null");
  EXPECT_EQ(element_text(payload(), field("point.x"), 0), "");
  payload_bytes_ = 0;
  EXPECT_EQ(text("yes"), "-");
  EXPECT_EQ(text("text"), "\"\"");
  EXPECT_EQ(json("points.x"), "[]");
}

TEST_F(FieldsOfEverything, AreNumbersForConditions) {
  EXPECT_EQ(element_number(payload(), field("yes"), 0), 1);
  EXPECT_EQ(element_number(payload(), field("point.x"), 0), 1.5);
  EXPECT_EQ(element_number(payload(), field("points.x"), 0), 10);
  EXPECT_EQ(element_number(payload(), field("points.x"), 1000), std::nullopt);
  payload_bytes_ = offsetof(Everything, points[1]) + 7;  // not all of points[1].x
  EXPECT_EQ(element_number(payload(), field("points.x"), 1), std::nullopt);
}

TEST_F(FieldsOfEverything, TakeAnyByteForABool) {
  std::memset(&value_.yes, 0x40, 1);
  EXPECT_EQ(text("yes"), "true");
}

TEST_F(FieldsOfEverything, AreShortenedOnRequest) {
  std::memcpy(value_.text, "abcdefgh", 8);  // without a zero byte at its end
  EXPECT_EQ(text("text", 5), "\"abcde\" ... 3 more");
  EXPECT_EQ(text("points.x", 1), "[10, ... 1 more]");
}

TEST_F(FieldsOfEverything, AreSelectedByNameWithAllThatIsInside) {
  const auto names = [&](const std::vector<std::string>& wanted) {
    std::vector<std::string> found;
    const std::vector<Field> selected = select_fields(fields_, wanted).value();
    for (const Field& field : selected) found.push_back(field.name);
    return found;
  };
  using Names = std::vector<std::string>;
  EXPECT_EQ(names({"i8"}), Names{"i8"});
  EXPECT_EQ(names({"point"}), (Names{"point.x", "point.y"}));
  EXPECT_EQ(names({"points"}), (Names{"points.x", "points[0].y", "points[1].y"}));
  EXPECT_EQ(names({"f64", "yes"}), (Names{"yes", "f64"}));  // in the payload's order
  EXPECT_EQ(names({}).size(), fields_.size());
}

TEST_F(FieldsOfEverything, AreNamedWhenAnUnknownOneIsAskedFor) {
  const auto selected = select_fields(fields_, {"poin"});
  ASSERT_FALSE(selected);
  EXPECT_EQ(selected.error().code, Errc::invalid_argument);
  EXPECT_NE(selected.error().message.find("'poin'"), std::string::npos);
  EXPECT_NE(selected.error().message.find("'point.x'"), std::string::npos);
}

// What a hostile or broken description may say of a payload of 16 bytes.
TEST(ReadableFields, RefusesWhatDoesNotLieInThePayload) {
  constexpr std::uint64_t kHuge = std::numeric_limits<std::uint64_t>::max();
  const Field bad[] = {
      {"behind", Scalar::float64, 16, 1, 8},
      {"across", Scalar::float64, 9, 1, 8},
      {"far", Scalar::uint8, kHuge, 1, 1},
      {"too many", Scalar::uint8, 0, 17, 1},
      {"overflow", Scalar::float64, 8, kHuge, 8},
      {"overflow too", Scalar::float64, 0, 2, kHuge},
      {"endless", Scalar::uint8, 0, kHuge, 0},
      {"overlapping", Scalar::float64, 0, 2, 4},
      {"none", Scalar::uint8, 0, 0, 1},
      {"no kind", static_cast<Scalar>(0), 0, 1, 1},
      {"no kind either", static_cast<Scalar>(99), 0, 1, 1},
  };
  const Field good{"good", Scalar::float64, 8, 1, 0};
  const TypeInfo fine{"T", 16, 8, {good}};
  EXPECT_EQ(readable_fields_untrusted(fine).size(), 1U);
  for (const Field& field : bad) {
    const TypeInfo type{"T", 16, 8, {good, field}};
    EXPECT_TRUE(readable_fields_untrusted(type).empty()) << field.name;
  }
}

TEST(ReadableFields, TakesArraysThatFillThePayload) {
  const TypeInfo type{
      "T", 16, 8, {{"all", Scalar::uint16, 0, 8, 2}, {"odd", Scalar::uint8, 0, 2, 15}}};
  EXPECT_EQ(readable_fields_untrusted(type).size(), 2U);
}

struct Bits {
  std::uint32_t low : 3;
  std::int32_t negative : 5;
  std::uint64_t wide : 40;
};

TEST(Fields, OfBitsAreTheirNumbers) {
  Bits bits{};
  bits.low = 5;
  bits.negative = -9;
  bits.wide = 0xfedcba9876;
  const auto payload = std::as_bytes(std::span(&bits, 1));
  const auto text = [&](const Field& field) {
    const TypeInfo type{"Bits", sizeof bits, 8, {field}};
    const std::vector<Field> readable = readable_fields_untrusted(type);
    return readable.empty() ? "refused" : field_text(payload, readable.front(), 10);
  };
  EXPECT_EQ(text({"low", Scalar::uint8, 0, 1, 1, 3, 0}), "5");
  EXPECT_EQ(text({"negative", Scalar::int8, 0, 1, 1, 5, 3}), "-9");
  EXPECT_EQ(text({"wide", Scalar::uint64, 0, 1, 8, 40, 8}), "1094624909430");
  EXPECT_EQ(text({"all", Scalar::uint64, 0, 1, 8, 64, 0}),
            text({"all", Scalar::uint64, 0, 1, 8, 0, 0}));
  EXPECT_EQ(text({"bit", Scalar::boolean, 0, 1, 1, 1, 2}), "true");
  EXPECT_EQ(text({"bit", Scalar::boolean, 0, 1, 1, 1, 1}), "false");
  EXPECT_EQ(text({"beyond", Scalar::uint8, 0, 1, 1, 3, 6}), "refused");
  EXPECT_FALSE((TypeInfo{"Bits", 8, 8, {{"beyond", Scalar::uint8, 0, 1, 1, 3, 6}}}).check());
  EXPECT_FALSE((TypeInfo{"Bits", 8, 8, {{"float", Scalar::float32, 0, 1, 4, 3, 0}}}).check());
}

}  // namespace
}  // namespace dssm::ctl
