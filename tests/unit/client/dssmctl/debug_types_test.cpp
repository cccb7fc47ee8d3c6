// SPDX-License-Identifier: Apache-2.0
//
// What dssmctl reads from debug information: of programs in C and C++ that the build compiles with
// every kind of it (programs/), compared with what the compiler says of the same types.
#include "client/dssmctl/debug_types.hpp"

#include <fcntl.h>
#include <gmock/gmock.h>
#include <gtest/gtest.h>
#include <unistd.h>

#include <algorithm>
#include <cstddef>
#include <cstring>
#include <dssm/describe.hpp>
#include <fstream>
#include <iterator>
#include <random>

#include "tests/support/daemon_process.hpp"
#include "tests/unit/client/dssmctl/programs/samples.h"

#pragma GCC diagnostic ignored "-Winvalid-offsetof"  // none here is in a virtual base

namespace dssm::ctl {
namespace {

using test::built;
using testing::Contains;
using testing::ElementsAre;
using testing::HasSubstr;

std::string program(const std::string& name) { return built("tests/unit/" + name + ".so"); }

StreamInfo stream_of(std::uint64_t bytes, const std::string& name = "lidar") {
  StreamInfo stream;
  stream.id = {name, 0, "pc1"};
  stream.type.payload_bytes = bytes;
  return stream;
}

// The only type of that name in a file.
DebugType type_in(const std::string& path, const std::string& name) {
  const auto types = debug_types_untrusted(path, name, 0);
  EXPECT_TRUE(types) << types.error().message;
  if (!types || types->size() != 1) {
    ADD_FAILURE() << path << ": " << (types ? types->size() : 0) << " types '" << name << "'";
    return {};
  }
  return types->front();
}

Field field_of(const DebugType& type, const std::string& name) {
  const auto found = std::ranges::find(type.type.fields, name, &Field::name);
  if (found != type.type.fields.end()) return *found;
  ADD_FAILURE() << "no field '" << name << "' in " << type.type.description();
  return {};
}

std::string bytes_of(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(file), {}};
}

std::string message_of(const std::string& path, const std::string& name = "Spur_Odometry") {
  const auto types = debug_types_untrusted(path, name, sizeof(Spur_Odometry));
  return types ? "no error" : types.error().message;
}

class TypesOfProgram : public testing::TestWithParam<std::string> {};

TEST_P(TypesOfProgram, HaveTheFieldsThatTheCompilerLaysOut) {
  const DebugType odometry = type_in(program(GetParam()), "Spur_Odometry");
  const auto float64 = [](const char* name, std::size_t offset) {
    return Field{name, Scalar::float64, offset, 1, 8};
  };
  const TypeInfo expected{
      "Spur_Odometry",
      40,
      8,
      {float64("x", 0), float64("y", 8), float64("theta", 16), float64("v", 24), float64("w", 32)}};
  EXPECT_EQ(odometry.type, expected) << odometry.type.description();
  EXPECT_TRUE(odometry.left_out.empty());

  const DebugType all = type_in(program(GetParam()), "Everything");
  EXPECT_EQ(all.type.payload_bytes, sizeof(Everything));
  EXPECT_EQ(all.type.alignment_bytes, alignof(Everything));
  const auto expect = [&](const std::string& name, Scalar kind, std::size_t offset,
                          std::uint64_t count = 1, std::uint64_t stride = 0) {
    const Field wanted{name, kind, offset, count, stride > 0 ? stride : scalar_bytes(kind)};
    EXPECT_EQ(field_of(all, name), wanted) << name;
  };
  using E = Everything;
  expect("label", Scalar::character, offsetof(E, label), 12);
  expect("s8", Scalar::int8, offsetof(E, s8));
  expect("u8", Scalar::uint8, offsetof(E, u8));
  expect("flag", Scalar::boolean, offsetof(E, flag));
  expect("s16", Scalar::int16, offsetof(E, s16));
  expect("u16", Scalar::uint16, offsetof(E, u16));
  expect("s32", Scalar::int32, offsetof(E, s32));
  expect("u32", Scalar::uint32, offsetof(E, u32));
  expect("s64", Scalar::int64, offsetof(E, s64));
  expect("u64", Scalar::uint64, offsetof(E, u64));
  expect("f32", Scalar::float32, offsetof(E, f32));
  expect("f64", Scalar::float64, offsetof(E, f64));
  expect("grid", Scalar::int32, offsetof(E, grid), 6);
  expect("points.tag", Scalar::uint8, offsetof(E, points) + offsetof(Point, tag), 4, sizeof(Point));
  expect("points[3].position", Scalar::float32, offsetof(E, points) + 3 * sizeof(Point), 3);
  expect("one_point.position", Scalar::float32, offsetof(E, one_point), 3);
  expect("one_point.tag", Scalar::uint8, offsetof(E, one_point) + offsetof(Point, tag));
  expect("mode", Scalar::uint32, offsetof(E, mode));
  expect("value.as_integer", Scalar::uint32, offsetof(E, value));
  expect("value.as_float", Scalar::float32, offsetof(E, value));
  expect("value.as_bytes", Scalar::uint8, offsetof(E, value), 4);
  expect("first", Scalar::int16, offsetof(E, first));
  expect("second", Scalar::uint16, offsetof(E, second));
  EXPECT_THAT(all.left_out,
              ElementsAre("next (a pointer)", HasSubstr("precise (long double of 16")));
}

// The value that a bit field of a sample has by its description.
std::int64_t value_of(const Field& field, const void* sample) {
  std::uint64_t element = 0;
  std::memcpy(&element, static_cast<const std::byte*>(sample) + field.offset_bytes,
              scalar_bytes(field.kind));
  const bool is_signed = field.kind <= Scalar::int64 && field.kind != Scalar::boolean &&
                         (static_cast<int>(field.kind) - static_cast<int>(Scalar::int8)) % 2 == 0;
  const auto bits = static_cast<std::int64_t>(element << (64 - field.first_bit - field.bits));
  return is_signed
             ? bits >> (64 - field.bits)
             : static_cast<std::int64_t>(static_cast<std::uint64_t>(bits) >> (64 - field.bits));
}

TEST_P(TypesOfProgram, SayWhereBitFieldsAre) {
  const DebugType all = type_in(program(GetParam()), "Everything");
  const auto expect_alone = [&](const std::string& name, auto set, std::int64_t value, int bits) {
    const Field field = field_of(all, name);
    EXPECT_EQ(field.bits, bits) << name;
    for (const int others : {0x00, 0xff}) {
      alignas(Everything) std::byte memory[sizeof(Everything)];
      std::memset(memory, others, sizeof memory);
      set(*reinterpret_cast<Everything*>(memory));
      EXPECT_EQ(value_of(field, memory), value) << name;
    }
  };
  expect_alone(
      "low", [](Everything& e) { e.low = 5; }, 5, 3);
  expect_alone(
      "high", [](Everything& e) { e.high = 77; }, 77, 7);
  expect_alone(
      "negative", [](Everything& e) { e.negative = -9; }, -9, 5);
  expect_alone(
      "bit", [](Everything& e) { e.bit = true; }, 1, 1);
  expect_alone(
      "wide", [](Everything& e) { e.wide = 0x8123456789; }, 0x8123456789, 40);
  EXPECT_EQ(field_of(all, "bit").kind, Scalar::boolean);

  const DebugType packed = type_in(program(GetParam()), "Packed");
  EXPECT_EQ(packed.type.alignment_bytes, 1U);
  EXPECT_EQ(packed.type.payload_bytes, sizeof(Packed));
  static_assert(sizeof(Packed) == 16);  // that alone would allow an alignment of 8
  EXPECT_EQ(field_of(packed, "value").offset_bytes, 1U);
  Packed sample{};
  sample.across = 0x1abc;
  EXPECT_EQ(value_of(field_of(packed, "across"), &sample), 0x1abc);
  EXPECT_EQ(value_of(field_of(packed, "low"), &sample), 0);
}

INSTANTIATE_TEST_SUITE_P(AllKinds, TypesOfProgram,
                         testing::Values("c-dwarf5", "c-dwarf4", "c-dwarf3", "c-compressed",
                                         "c-type-units", "cpp-dwarf5", "cpp-dwarf4", "cpp-dwarf3",
                                         "cpp-compressed", "cpp-type-units"),
                         [](const auto& kind) {
                           std::string name = kind.param;
                           std::ranges::replace(name, '-', '_');
                           return name;
                         });

TEST(DebugTypes, OfCppHaveBasesAndMembersOfClasses) {
  for (const std::string name : {"cpp-dwarf5", "cpp-dwarf4", "cpp-type-units"}) {
    const DebugType scan = type_in(program(name), "nav::Scan");
    EXPECT_EQ(scan.type.name, "Scan");
    EXPECT_EQ(scan.full_name, "nav::Scan");
    EXPECT_EQ(scan.type.alignment_bytes, 8U);
    EXPECT_EQ(field_of(scan, "stamp"), (Field{"stamp", Scalar::int64, 8, 1, 8}));
    EXPECT_EQ(field_of(scan, "sequence"), (Field{"sequence", Scalar::uint16, 16, 1, 2}));
    EXPECT_EQ(field_of(scan, "ranges"), (Field{"ranges", Scalar::float64, 24, 4, 8}));
    EXPECT_EQ(field_of(scan, "corners.tag").count, 2U);
    EXPECT_EQ(field_of(scan, "corners[1].codes").count, 2U);
    EXPECT_EQ(field_of(scan, "quality").kind, Scalar::uint8);
    EXPECT_EQ(field_of(scan, "letter").kind, Scalar::uint32);
    EXPECT_EQ(field_of(scan, "named.inner").kind, Scalar::float32);
    const Field many = field_of(scan, "many");
    EXPECT_EQ(many.kind, Scalar::uint8);
    EXPECT_EQ(many.count, 3300U);
    EXPECT_THAT(scan.left_out, ElementsAre("many (as bytes: a type has at most 1024 fields)"));
    EXPECT_EQ(scan.type.fields.size(), 12U) << scan.type.description();

    EXPECT_EQ(type_in(program(name), "Aligned").type.alignment_bytes, 32U);
    const DebugType derived = type_in(program(name), "nav::Virtual");
    EXPECT_THAT(derived.left_out, ElementsAre("Shared (a virtual base class)"));
    EXPECT_EQ(field_of(derived, "own").offset_bytes, 8U);
    EXPECT_EQ(type_in(program(name), "Local").type.fields.size(), 3U);
    EXPECT_EQ(type_in(program(name), "double").type,
              (TypeInfo{"double", 8, 8, {{"value", Scalar::float64, 0, 1, 8}}}));
  }
}

TEST(DebugTypes, OfATypedefHaveBothNames) {
  for (const std::string name : {"PWSMotor", "_pws_motor"}) {
    const DebugType motor = type_in(program("c-dwarf5"), name);
    EXPECT_EQ(motor.type.name, name);
    EXPECT_EQ(motor.type.fields.size(), 4U);
  }
}

// --- which one it is

Result<DebugType> choice(const std::string& name, const StreamInfo& stream,
                         const std::string& type = "") {
  auto types = debug_types_untrusted(program(name), type, stream.type.payload_bytes);
  if (!types) return std::move(types).error();
  return choose_type(*std::move(types), stream, type, "program");
}

TEST(DebugTypes, ThatAStreamClassHasComeFirst) {
  const auto odometry = choice("cpp-dwarf5", stream_of(sizeof(Spur_Odometry)));
  ASSERT_TRUE(odometry) << odometry.error().message;
  EXPECT_EQ(odometry->type.name, "Spur_Odometry") << "and not nav::Other of the same size";
  EXPECT_TRUE(odometry->is_stream_type);
  const auto image = choice("cpp-dwarf5", stream_of(640 * 480 * 3));
  ASSERT_TRUE(image) << image.error().message;
  EXPECT_THAT(image->type.fields, ElementsAre(Field{"value", Scalar::uint8, 0, 640 * 480 * 3, 1}));
  const auto counter = choice("cpp-dwarf5", stream_of(4));
  ASSERT_TRUE(counter) << counter.error().message;
  EXPECT_THAT(counter->type.fields, ElementsAre(Field{"value", Scalar::int32, 0, 1, 4}));
}

TEST(DebugTypes, AreChosenByTheStreamsNameOrNotAtAll) {
  const auto only = choice("c-dwarf5", stream_of(sizeof(Spur_Odometry)));
  ASSERT_TRUE(only) << only.error().message;
  EXPECT_EQ(only->type.name, "Spur_Odometry");

  const auto several = choice("c-dwarf5", stream_of(16));
  ASSERT_FALSE(several);
  EXPECT_EQ(several.error().code, Errc::conflict);
  EXPECT_THAT(several.error().message, HasSubstr("'Bumpers', 'PWSMotor', 'Packed', 'Wheels'"));
  EXPECT_THAT(several.error().message, HasSubstr("--type"));

  const auto named = choice("c-dwarf5", stream_of(16, "pws_motor"));
  ASSERT_TRUE(named) << named.error().message;
  EXPECT_EQ(named->type.name, "PWSMotor");
  EXPECT_TRUE(choice("c-dwarf5", stream_of(16), "Wheels"));
}

TEST(DebugTypes, OfStreamsAreFoundBehindThousandsOfThatSize) {
  const auto wheels = choice("many-types-and-stream", stream_of(20));
  ASSERT_TRUE(wheels) << wheels.error().message;
  EXPECT_EQ(wheels->type.name, "Wheels");
}

TEST(DebugTypes, AreNotChosenOfMoreThanAreLookedAt) {
  const auto any = choice("many-types", stream_of(20, "type1000"));
  ASSERT_FALSE(any);
  EXPECT_EQ(any.error().code, Errc::conflict);
  EXPECT_THAT(any.error().message, HasSubstr("more than 4096 types in it have 20 bytes"));
  EXPECT_THAT(any.error().message, HasSubstr("--type"));
  EXPECT_TRUE(choice("many-types", stream_of(20), "Wheels"));
}

TEST(DebugTypes, OfAnotherSizeAreRefused) {
  const auto other = choice("c-dwarf5", stream_of(48), "Spur_Odometry");
  ASSERT_FALSE(other);
  EXPECT_EQ(other.error().code, Errc::type_mismatch);
  EXPECT_THAT(other.error().message, HasSubstr("40 bytes"));
  EXPECT_THAT(other.error().message, HasSubstr("48 bytes"));
  EXPECT_EQ(choice("c-dwarf5", stream_of(48), "Lidar").error().code, Errc::not_found);
  EXPECT_EQ(choice("c-dwarf5", stream_of(47)).error().code, Errc::not_found);
}

// --- files

TEST(DebugTypes, WithoutDebugInformationAskForIt) {
  EXPECT_THAT(message_of(program("cpp-plain")), HasSubstr("compile it with -g"));
  EXPECT_THAT(message_of(program("cpp-lines-only")), HasSubstr("(-g1)"));
}

TEST(DebugTypes, OfWhatIsNoProgramAreRefused) {
  const std::string folder = test::make_temp_dir();
  EXPECT_THAT(message_of(folder + "/none"), HasSubstr("/none"));
  EXPECT_EQ(debug_types_untrusted(folder + "/none", "A", 1).error().code, Errc::not_found);
  EXPECT_THAT(message_of(folder), HasSubstr("not an ELF file"));
  std::ofstream(folder + "/text") << "struct Odometry { double x; };\n";
  EXPECT_THAT(message_of(folder + "/text"), HasSubstr("not an ELF file"));

  std::string other = bytes_of(program("c-dwarf5"));
  other[18] = static_cast<char>(other[18] ^ 0x40);  // the machine
  std::ofstream(folder + "/other", std::ios::binary) << other;
  EXPECT_THAT(message_of(folder + "/other"), HasSubstr("another kind of machine"));
  test::remove_tree(folder);
}

TEST(DebugTypes, AreFoundInSeparateFiles) {
  const std::string folder = test::make_temp_dir();
  const std::string whole = program("cpp-dwarf5"), bare = folder + "/bare.so",
                    symbols = folder + "/bare.debug";
  const auto objcopy = [&](const std::vector<std::string>& arguments) {
    std::vector<std::string> argv = {"objcopy"};
    argv.insert(argv.end(), arguments.begin(), arguments.end());
    return test::run(argv).exit_status == 0;
  };
  if (!objcopy({"--only-keep-debug", whole, symbols})) {
    test::remove_tree(folder);
    GTEST_SKIP() << "objcopy is missing, or does not know programs of this machine";
  }
  ASSERT_TRUE(objcopy({"--strip-all", "--remove-section=.note.gnu.build-id", whole, bare}));
  EXPECT_THAT(message_of(bare), HasSubstr("no debug information"));
  EXPECT_EQ(type_in(symbols, "Spur_Odometry").type.fields.size(), 5U) << "the file itself";
  ASSERT_TRUE(objcopy({"--add-gnu-debuglink=" + symbols, bare}));
  EXPECT_EQ(type_in(bare, "Spur_Odometry").type.fields.size(), 5U) << "by its link";
  // As of a program that runs: through /proc, and after its file is gone.
  const int open = ::open(whole.c_str(), O_RDONLY | O_CLOEXEC);
  ASSERT_GE(open, 0);
  EXPECT_EQ(type_in("/proc/self/fd/" + std::to_string(open), "nav::Other").type.fields.size(), 1U);
  ::close(open);
  test::remove_tree(folder);
}

// A file may be damaged, or made to mislead: any answer will do that is none of a wrong size.
TEST(DebugTypes, OfDamagedFilesAreRefusedOrSane) {
  const std::string folder = test::make_temp_dir();
  const std::string good = bytes_of(program("cpp-dwarf4"));
  const auto seed = std::random_device{}();
  std::mt19937 random(seed);
  SCOPED_TRACE("seed " + std::to_string(seed));
  for (int round = 0; round < 300; ++round) {
    std::string bad = good;
    const bool cut = round % 3 == 0;
    if (cut) bad.resize(64 + random() % (bad.size() - 64));
    for (int i = 0; i < 1 << round % 10; ++i) {
      bad[20 + random() % (bad.size() - 20)] = static_cast<char>(random());
    }
    const std::string path = folder + "/bad";
    std::ofstream(path, std::ios::binary | std::ios::trunc) << bad;
    for (const std::string name : {"", "Scan", "Everything"}) {
      const auto types = debug_types_untrusted(path, name, sizeof(Spur_Odometry));
      if (!types) continue;
      for (const DebugType& type : *types) EXPECT_TRUE(type.type.check());
    }
  }
  test::remove_tree(folder);
}

}  // namespace
}  // namespace dssm::ctl
