// SPDX-License-Identifier: Apache-2.0
//
// By its schema, CDR must find each number of a payload where it is in memory.
#include "client/recording/ros2_schema.hpp"

#include <gtest/gtest.h>

#include <cstring>
#include <dssm/describe.hpp>
#include <map>
#include <random>
#include <regex>
#include <set>
#include <sstream>
#include <vector>
#ifdef DSSM_HAS_FASTCDR
#include <fastcdr/Cdr.h>

#include "tests/support/sanitized.hpp"
#endif

namespace dssm::recording {
namespace {

struct Point {
  float x;
  double y;
  char tag[3];
};
DSSM_DESCRIBE(Point, x, y, tag)
struct Flag {
  bool on;
  double since;
};
DSSM_DESCRIBE(Flag, on, since)
struct Scan {
  std::uint8_t kind;
  double fooBar;
  std::uint16_t n;
  float range[3];
  Flag flags[2];
  Point origin;
  Point points[2];
  std::int64_t t;
  bool ok;
  std::int16_t last;
};
DSSM_DESCRIBE(Scan, kind, fooBar, n, range, flags, origin, points, t, ok, last)

TEST(Ros2Schema, PadsAndRenames) {
  const Ros2Schema schema = ros2_schema(type_of<Scan>());
  EXPECT_EQ(schema.name, "dssm/msg/Scan");
  const std::string line(80, '=');
  EXPECT_EQ(schema.text,
            "uint8 kind\n"
            "uint8[7] pad\n"
            "float64 foobar  # fooBar\n"
            "uint16 n\n"
            "uint8[2] pad2\n"
            "float32[3] range\n"
            "dssm/ScanFlags[2] flags\n"
            "dssm/ScanOrigin origin\n"
            "dssm/ScanPoints[2] points\n"
            "int64 t\n"
            "bool ok\n"
            "uint8[1] pad3\n"
            "int16 last\n" +
                line +
                "\nMSG: dssm/ScanFlags\n"
                "bool on\n"
                "uint8[7] pad\n"
                "float64 since\n" +
                line +
                "\nMSG: dssm/ScanOrigin\n"
                "float32 x\n"
                "uint8[4] pad\n"
                "float64 y\n"
                "uint8[3] tag\n"
                "uint8[5] pad2\n" +
                line +
                "\nMSG: dssm/ScanPoints\n"
                "float32 x\n"
                "uint8[4] pad\n"
                "float64 y\n"
                "uint8[3] tag\n"
                "uint8[5] pad2\n");
}

// Fast CDR, with which programs of ROS 2 read, follows that definition through the payload.
TEST(Ros2Schema, IsHowFastCdrReadsThePayload) {
#ifdef DSSM_HAS_FASTCDR
  Scan scan{};
  scan.kind = 1;
  scan.fooBar = 2.5;
  scan.n = 3;
  scan.range[2] = 4.5F;
  scan.flags[1] = {true, 5.5};
  scan.origin = {6.5F, 7.5, "ab"};
  scan.points[1] = {8.5F, 9.5, "cd"};
  scan.t = -10;
  scan.ok = true;
  scan.last = -11;
  std::vector<char> message = {0, 1, 0, 0};
  message.resize(message.size() + sizeof scan);
  std::memcpy(message.data() + 4, &scan, sizeof scan);

  eprosima::fastcdr::FastBuffer buffer(message.data(), message.size());
  eprosima::fastcdr::Cdr cdr(buffer, eprosima::fastcdr::Cdr::LITTLE_ENDIANNESS,
                             eprosima::fastcdr::Cdr::DDS_CDR);
  cdr.read_encapsulation();
  const auto skip = [&](std::size_t bytes) {
    for (std::uint8_t byte = 0; bytes > 0; --bytes) cdr >> byte;
  };
  const auto next = [&]<class T>(T value) { return cdr >> value, value; };
  const auto expect_point = [&](const Point& point) {
    EXPECT_EQ(next(float()), point.x);
    skip(4);
    EXPECT_EQ(next(double()), point.y);
    for (const char c : point.tag) EXPECT_EQ(next(std::uint8_t()), c);
    skip(5);
  };
  EXPECT_EQ(next(std::uint8_t()), scan.kind);
  skip(7);
  EXPECT_EQ(next(double()), scan.fooBar);
  EXPECT_EQ(next(std::uint16_t()), scan.n);
  skip(2);
  for (const float range : scan.range) EXPECT_EQ(next(float()), range);
  for (const Flag& flag : scan.flags) {
    EXPECT_EQ(next(bool()), flag.on);
    skip(7);
    EXPECT_EQ(next(double()), flag.since);
  }
  expect_point(scan.origin);
  for (const Point& point : scan.points) expect_point(point);
  EXPECT_EQ(next(std::int64_t()), scan.t);
  EXPECT_EQ(next(bool()), scan.ok);
  skip(1);
  EXPECT_EQ(next(std::int16_t()), scan.last);
#else
  GTEST_SKIP() << "Debian's package libfastcdr-dev is not installed";
#endif
}

TEST(Ros2Schema, HasSequenceOfBytesForUndescribedTypes) {
  EXPECT_EQ(ros2_schema({"Blob", 40, 1, {}}).text, "uint8[] data\n");
}

// The numbers that CDR finds by a definition: (offset, size).
class Cdr {
 public:
  explicit Cdr(const std::string& text) {
    std::istringstream lines(text);
    std::string message;
    for (std::string line; std::getline(lines, line);) {
      if (line.starts_with("===")) continue;
      if (line.starts_with("#")) continue;
      if (line.starts_with("MSG: ")) {
        message = line.substr(5);
        continue;
      }
      static const std::regex kLine(
          R"(([a-z0-9]+|dssm/[A-Z][A-Za-z0-9]*)(\[(\d+)\])? ([a-z](_?[a-z0-9]+)*)(  # .*)?)");
      std::smatch match;
      EXPECT_TRUE(std::regex_match(line, match, kLine)) << line;
      if (match.empty()) continue;
      EXPECT_TRUE(names_[message].insert(match[4]).second) << line;
      messages_[message].push_back({match[1], match[3].matched ? std::stoul(match[3]) : 1U});
    }
    run("");
  }
  std::set<std::pair<std::uint64_t, std::uint64_t>> numbers;
  std::uint64_t end = 0;

 private:
  void run(const std::string& message) {
    ASSERT_TRUE(messages_.contains(message)) << message;
    for (const auto& [type, count] : messages_[message]) {
      const std::size_t digits = type.find_first_of("123456789");
      for (std::uint64_t i = 0; i < count; ++i) {
        if (type.starts_with("dssm/")) {
          run(type);
          continue;
        }
        const std::uint64_t size = type == "bool" ? 1 : std::stoul(type.substr(digits)) / 8;
        end = (end + size - 1) / size * size;
        if (size > 1) numbers.insert({end, size});
        end += size;
      }
    }
  }
  std::map<std::string, std::vector<std::pair<std::string, std::uint64_t>>> messages_;
  std::map<std::string, std::set<std::string>> names_;
};

TEST(Ros2Schema, FindsEachNumberOfRandomTypesWhereItIs) {
  std::mt19937 random(20);
  const char* const names[] = {"a", "b", "a.b", "a.c", "a.b.d", "X", "f_", "a[0].e", "a[1].e", "1"};
  std::size_t found_numbers = 0;
  for (int i = 0; i < (test::kIsSanitized ? 1000 : 5000); ++i) {
    TypeInfo type{"Random type", 200, 8, {}};
    std::set<std::pair<std::uint64_t, std::uint64_t>> numbers;
    for (std::size_t n = random() % 8 + 1; n > 0; --n) {
      Field field;
      field.name = names[random() % std::size(names)];
      field.kind = static_cast<Scalar>(1 + random() % 12);
      const std::uint64_t size = scalar_bytes(field.kind);
      field.offset_bytes = random() % 80;
      if (random() % 4 != 0) field.offset_bytes &= ~(size - 1);
      field.count = random() % 3 == 0 ? 1 + random() % 4 : 1;
      field.stride_bytes = random() % 2 == 0 ? size : 8 * (1 + random() % 3);
      if (field.count == 1) field.stride_bytes = size;
      for (std::uint64_t k = 0; k < field.count; ++k) {
        numbers.insert({field.offset_bytes + k * field.stride_bytes, size});
      }
      type.fields.push_back(field);
    }
    if (!type.check()) continue;
    const std::string text = ros2_schema(type).text;
    SCOPED_TRACE(type.description() + "\n" + text);
    const Cdr cdr(text);
    EXPECT_LE(cdr.end, type.payload_bytes);
    for (const auto& number : cdr.numbers) EXPECT_TRUE(numbers.contains(number)) << number.first;
    found_numbers += cdr.numbers.size();
    if (testing::Test::HasFailure()) break;
  }
  EXPECT_GT(found_numbers, test::kIsSanitized ? 1000U : 5000U);
}

TEST(Ros2Schema, HasTheBytesOfBitFields) {
  const TypeInfo type{"Bits",
                      4,
                      4,
                      {{"low", Scalar::uint8, 0, 1, 1, 3, 0},
                       {"high", Scalar::uint16, 0, 1, 2, 7, 3},
                       {"end", Scalar::uint16, 2, 1, 2}}};
  EXPECT_EQ(ros2_schema(type).text,
            "uint8[1] low  # low\n"
            "# high: in the same bytes as another field\n"
            "uint8[1] pad\n"
            "uint16 end\n");
}

}  // namespace
}  // namespace dssm::recording
