// SPDX-License-Identifier: Apache-2.0
//
// Names of streams, descriptions of types and what counts as the same type, lengths of histories.
#include <gtest/gtest.h>

#include <dssm/describe.hpp>
#include <dssm/stream.hpp>

#include "core/base/text.hpp"

namespace dssm {

struct Point {
  double x, y;
};
DSSM_DESCRIBE(Point, x, y)

enum class Gear : std::uint8_t { park, drive };

struct Everything {
  Point pose;
  float speed[3];
  std::array<Point, 2> corners;
  std::int16_t grid[2][3];
  Gear gear;
  bool moving;
  char name[8];
};
DSSM_DESCRIBE(Everything, pose, speed, corners, grid, gear, moving, name)

struct Plain {
  int a;
};

struct Wide {
  std::uint8_t m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11, m12, m13, m14, m15, m16, m17, m18,
      m19, m20, m21, m22, m23, m24, m25, m26, m27, m28, m29, m30, m31, m32, m33, m34, m35, m36, m37,
      m38, m39, m40, m41, m42, m43, m44, m45, m46, m47, m48, m49, m50, m51, m52, m53, m54, m55, m56,
      m57, m58, m59, m60, m61, m62, m63;
};
DSSM_DESCRIBE(Wide, m0, m1, m2, m3, m4, m5, m6, m7, m8, m9, m10, m11, m12, m13, m14, m15, m16, m17,
              m18, m19, m20, m21, m22, m23, m24, m25, m26, m27, m28, m29, m30, m31, m32, m33, m34,
              m35, m36, m37, m38, m39, m40, m41, m42, m43, m44, m45, m46, m47, m48, m49, m50, m51,
              m52, m53, m54, m55, m56, m57, m58, m59, m60, m61, m62, m63)

namespace {

TEST(StreamId, ReadsEveryFormOfAName) {
  EXPECT_EQ(StreamId::parse("lidar").value(), (StreamId{"lidar", 0, ""}));
  EXPECT_EQ(StreamId::parse("lidar:7").value(), (StreamId{"lidar", 7, ""}));
  EXPECT_EQ(StreamId::parse("lidar@pc2").value(), (StreamId{"lidar", 0, "pc2"}));
  EXPECT_EQ(StreamId::parse("front lidar:1@pc2").value(), (StreamId{"front lidar", 1, "pc2"}));
  EXPECT_EQ(StreamId::parse("lidar:7@pc2").value().str(), "lidar:7@pc2");
}

TEST(StreamId, RefusesBadNamesWithAReason) {
  const std::pair<const char*, const char*> cases[] = {
      {"", "empty"},
      {":1", "empty"},
      {"a:", "is not an id"},
      {"a:x", "'x' after ':' is not an id"},
      {"a:-1", "ids start at 0"},
      {"a:99999999999", "is not an id"},
      {"a:1:2", "is not an id"},
      {"a@", "no host"},
      {"a\nb", "control character"},
      {"a\xff", "not UTF-8"},
      {"12345678901234567890123456789012", "32 bytes long; at most 31"},
      {"1234567890123456789012345678901:2147483647@a-host-with-a-long-name", "63"},
  };
  for (const auto& [text, why] : cases) {
    const Result<StreamId> id = StreamId::parse(text);
    ASSERT_FALSE(id) << text;
    EXPECT_EQ(id.error().code, Errc::invalid_argument);
    EXPECT_NE(id.error().message.find(why), std::string::npos) << id.error().message;
  }
  EXPECT_TRUE(StreamId::parse("1234567890123456789012345678901"));
}

TEST(TypeInfo, DescribesNestedStructsArraysEnumsAndText) {
  const TypeInfo type = type_of<Everything>();
  EXPECT_EQ(type.name, "Everything");
  EXPECT_EQ(type.payload_bytes, sizeof(Everything));
  EXPECT_EQ(type.alignment_bytes, alignof(Everything));
  const std::vector<Field> wanted = {
      {"pose.x", Scalar::float64, 0, 1, 8},
      {"pose.y", Scalar::float64, 8, 1, 8},
      {"speed", Scalar::float32, offsetof(Everything, speed), 3, 4},
      {"corners.x", Scalar::float64, offsetof(Everything, corners), 2, 16},
      {"corners.y", Scalar::float64, offsetof(Everything, corners) + 8, 2, 16},
      {"grid", Scalar::int16, offsetof(Everything, grid), 6, 2},
      {"gear", Scalar::uint8, offsetof(Everything, gear), 1, 1},
      {"moving", Scalar::boolean, offsetof(Everything, moving), 1, 1},
      {"name", Scalar::character, offsetof(Everything, name), 8, 1},
  };
  EXPECT_EQ(type.fields, wanted);
  EXPECT_TRUE(type.check());
}

TEST(TypeInfo, DescribesSixtyFourMembers) {
  const TypeInfo type = type_of<Wide>();
  ASSERT_EQ(type.fields.size(), 64u);
  EXPECT_EQ(type.fields[63], (Field{"m63", Scalar::uint8, 63, 1, 1}));
}

TEST(TypeInfo, NamesUndescribedTypesAsTheCompilerSpellsThem) {
  EXPECT_EQ(type_of<Plain>().name, "dssm::Plain");
  EXPECT_TRUE(type_of<Plain>().fields.empty());
  EXPECT_EQ(type_of<double>().name, "double");
  EXPECT_EQ(type_of<double>().fields.at(0).name, "value");
}

TEST(TypeInfo, NamesBothTypesWhenTheyDiffer) {
  const TypeInfo odometry{"Odometry", 40, 8, {}}, other{"Pose", 40, 8, {}}, bytes{"", 40, 1, {}};
  EXPECT_TRUE(odometry.check_usable_as(odometry));
  EXPECT_TRUE(odometry.check_usable_as(bytes)) << "bytes match every type of their size";
  EXPECT_TRUE(bytes.check_usable_as(odometry));
  for (const TypeInfo& wanted : {other, TypeInfo{"Odometry", 48, 8, {}},
                                 TypeInfo{"Odometry", 40, 4, {}}, TypeInfo{"", 48, 1, {}}}) {
    const Result<void> usable = odometry.check_usable_as(wanted);
    ASSERT_FALSE(usable);
    EXPECT_EQ(usable.error().code, Errc::type_mismatch);
    EXPECT_NE(usable.error().message.find(odometry.str()), std::string::npos);
    EXPECT_NE(usable.error().message.find(wanted.str()), std::string::npos);
  }
}

TEST(TypeInfo, NamesTheFirstFieldThatDiffers) {
  const Field x{"x", Scalar::float64, 0, 1, 8}, y{"y", Scalar::float64, 8, 1, 8};
  const TypeInfo pose{"Pose", 16, 8, {x, y}};
  const auto error = [&](const std::vector<Field>& fields) {
    const Result<void> usable = pose.check_usable_as({"Pose", 16, 8, fields});
    return usable ? "" : usable.error().message;
  };
  EXPECT_EQ(error({x, y}), "");
  EXPECT_EQ(error({}), "") << "not described: unknown";
  EXPECT_EQ(error({x, {"y", Scalar::float64, 8, 1, 0}}), "") << "one element has no stride";
  EXPECT_EQ(error({{"y", Scalar::float64, 0, 1, 8}, {"x", Scalar::float64, 8, 1, 8}}),
            "the stream carries 'Pose' (16 bytes, aligned to 8) { float64 x at 0; float64 y at 8; "
            "}, this program wants 'Pose' (16 bytes, aligned to 8) { float64 y at 0; float64 x at "
            "8; }: field 1 is 'float64 x at 0' in the stream and 'float64 y at 0' in this program; "
            "compile both sides with the same definition of the type");
  EXPECT_NE(error({x}).find("field 2 is 'float64 y at 8' in the stream and missing in"),
            std::string::npos);
  for (const Field& other :
       {Field{"y", Scalar::int64, 8, 1, 8}, Field{"y", Scalar::float32, 8, 2, 4},
        Field{"y", Scalar::float64, 0, 1, 8}}) {
    EXPECT_NE(error({x, other}).find("field 2"), std::string::npos);
  }
}

TEST(TypeInfo, ShowsTheFirstFieldsOfALongType) {
  EXPECT_TRUE(type_of<Wide>().description().ends_with("uint8 m15 at 15; and 48 more; }"))
      << type_of<Wide>().description();
}

TEST(TypeInfo, RefusesFieldsOutsideThePayload) {
  TypeInfo type{"T", 16, 8, {{"a", Scalar::float64, 8, 1, 8}}};
  EXPECT_TRUE(type.check());
  for (const Field& bad :
       {Field{"a", Scalar::float64, 9, 1, 8}, Field{"a", Scalar::float64, 0, 3, 8},
        Field{"a", Scalar::uint8, 0, UINT64_MAX, 8}, Field{"a", Scalar(99), 0, 1, 1},
        Field{"a", Scalar::uint8, 1, 2, UINT64_MAX}, Field{"a", Scalar::uint8, 0, 0, 1},
        Field{"\xff", Scalar::uint8, 0, 1, 1}}) {
    type.fields = {bad};
    EXPECT_FALSE(type.check());
  }
  EXPECT_FALSE((TypeInfo{"T", 16, 3, {}}.check()));
  EXPECT_FALSE((TypeInfo{"T", 16, 128, {}}.check()));
  EXPECT_FALSE((TypeInfo{"T", 0, 1, {}}.check()));
  EXPECT_FALSE((TypeInfo{std::string(128, 'x'), 16, 1, {}}.check()));
}

TEST(History, HoldsTwentyPercentMoreThanAskedFor) {
  using namespace std::chrono_literals;
  EXPECT_EQ(History::for_life(1s, 100ms).value().depth, 13u);
  EXPECT_EQ(History::for_life(5s, 5ms).value().depth, 1201u);
  EXPECT_EQ(History::for_life(100ms, 100ms).value().depth, 2u);
  EXPECT_EQ(History::for_life(1s, 0s).error().code, Errc::invalid_argument);
  EXPECT_EQ(History::for_life(1s, -1s).error().code, Errc::invalid_argument);
  EXPECT_EQ(History::for_life(0s, 1s).error().code, Errc::invalid_argument);
  EXPECT_EQ(History::for_life(1h, 1ns).error().code, Errc::limit_exceeded);
}

TEST(Utf8, DistinguishesWellFormedFromOtherText) {
  for (const char* good : {"", "a", "\u00e9", "\u65e5\u672c", "\U0001F916", "\u07ff\uffff"}) {
    EXPECT_TRUE(is_utf8(good)) << good;
  }
  for (const char* bad : {"\x80", "\xc3", "\xc0\x80", "\xe2\x82", "\xed\xa0\x80",
                          "\xf4\x90\x80\x80", "\xe0\x80\x80", "a\xff"}) {
    EXPECT_FALSE(is_utf8(bad));
  }
}

TEST(Result, ThrowsAtTheEdgeOnlyWhenAsked) {
  const Result<int> good = 3;
  EXPECT_EQ(good.value(), 3);
  const Result<int> bad = Error{Errc::not_found, "nothing there"}.context("open 'x'");
  EXPECT_FALSE(bad);
  try {
    bad.value();
    FAIL() << "value() of an error must throw";
  } catch (const BadResult& thrown) {
    EXPECT_STREQ(thrown.what(), "open 'x': nothing there");
    EXPECT_EQ(thrown.error().code, Errc::not_found);
  }
}

TEST(Time, DeadlinesDoNotOverflow) {
  EXPECT_EQ(deadline_in(Duration::max()), kNever);
  EXPECT_GT(deadline_in(std::chrono::hours(1)), MonoClock::now());
}

}  // namespace
}  // namespace dssm
