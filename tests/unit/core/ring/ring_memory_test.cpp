// SPDX-License-Identifier: Apache-2.0
//
// The memory behind a ring: what it refuses, and that the layout is the documented one.
#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>
#include <dssm/stream.hpp>
#include <fstream>
#include <iterator>
#include <string>

#include "core/base/sealed_memory.hpp"
#include "tests/unit/core/ring/test_ring.hpp"

namespace dssm::ring {
namespace {

// The numbers of docs/ring-layout.md, by hand.
TEST(Layout, HasItsDocumentedOffsets) {
  EXPECT_EQ(sizeof(RingHeader), 4096u);
  EXPECT_EQ(offsetof(RingHeader, magic), 0u);
  EXPECT_EQ(offsetof(RingHeader, layout_version), 8u);
  EXPECT_EQ(offsetof(RingHeader, alignment_bytes), 12u);
  EXPECT_EQ(offsetof(RingHeader, payload_bytes), 16u);
  EXPECT_EQ(offsetof(RingHeader, depth), 24u);
  EXPECT_EQ(offsetof(RingHeader, slot_bytes), 32u);
  EXPECT_EQ(offsetof(RingHeader, times_offset), 40u);
  EXPECT_EQ(offsetof(RingHeader, slots_offset), 48u);
  EXPECT_EQ(offsetof(RingHeader, total_bytes), 56u);
  EXPECT_EQ(offsetof(RingHeader, incarnation), 64u);
  EXPECT_EQ(offsetof(RingHeader, cycle_ns), 72u);
  EXPECT_EQ(offsetof(RingHeader, stream_id), 80u);
  EXPECT_EQ(offsetof(RingHeader, name), 88u);
  EXPECT_EQ(offsetof(RingHeader, host), 128u);
  EXPECT_EQ(offsetof(RingHeader, doorbell_armed), 448u);
  EXPECT_EQ(offsetof(RingHeader, lock), 4072u);
  EXPECT_EQ(offsetof(RingHeader, top), 512u);
  EXPECT_EQ(offsetof(RingHeader, run_start), 520u);
  EXPECT_EQ(offsetof(RingHeader, first), 528u);
  EXPECT_EQ(offsetof(RingHeader, publishers), 640u);
  EXPECT_EQ(offsetof(RingHeader, clock), 3200u);
  EXPECT_EQ(sizeof(RingHeader::clock), 200u);
  EXPECT_EQ(sizeof(RingHeader::publishers), 64u * 40);
  EXPECT_EQ(offsetof(PublisherCursor, publisher), 0u);
  EXPECT_EQ(offsetof(PublisherCursor, tid_end), 8u);
  EXPECT_EQ(offsetof(PublisherCursor, number_end), 16u);
  EXPECT_EQ(offsetof(PublisherCursor, earlier_tid_end), 24u);
  EXPECT_EQ(offsetof(PublisherCursor, earlier_number_end), 32u);
  EXPECT_EQ(sizeof(SlotHeader), 64u);
  EXPECT_EQ(offsetof(SlotHeader, sequence), 0u);
  EXPECT_EQ(offsetof(SlotHeader, payload_bytes), 8u);
  EXPECT_EQ(offsetof(SlotHeader, time_ns), 16u);
  EXPECT_EQ(offsetof(SlotHeader, clock_error_ns), 24u);
  EXPECT_EQ(offsetof(SlotHeader, run_start), 32u);
  EXPECT_EQ(offsetof(SlotHeader, run_parent), 40u);
  EXPECT_EQ(offsetof(SlotHeader, run_jump), 48u);
  EXPECT_EQ(offsetof(SlotHeader, run_level), 56u);
  EXPECT_EQ(kLayoutVersion, 8u) << "raise it with every incompatible change, and fix this test";
}

TEST(Layout, HasItsDocumentedVersion) {
  const char* root = std::getenv("DSSM_SOURCE_ROOT");  // NOLINT(concurrency-mt-unsafe)
  ASSERT_TRUE(root) << "run me through `meson test`";
  std::ifstream file(std::string(root) + "/docs/ring-layout.md");
  const std::string text{std::istreambuf_iterator<char>(file), {}};
  EXPECT_NE(text.find("layout_version, " + std::to_string(kLayoutVersion) + " |"),
            std::string::npos);
}

TEST(Geometry, RefusesWhatARingCannotBe) {
  EXPECT_EQ(Geometry::of(0, 10).error().code, Errc::invalid_argument);
  EXPECT_EQ(Geometry::of((64ULL << 20) + 1, 10).error().code, Errc::invalid_argument);
  EXPECT_EQ(Geometry::of(8, 1).error().code, Errc::invalid_argument);
  EXPECT_EQ(Geometry::of(8, (1ULL << 24) + 1).error().code, Errc::invalid_argument);
  EXPECT_TRUE(Geometry::of(64ULL << 20, 2));
  EXPECT_TRUE(Geometry::of(1, 1ULL << 24));
}

TEST(RingMemory, CannotBeMappedOrReopenedWritableByAReader) {
  const TestRing ring(64, 8);
  const UniqueFd reader = reopen_read_only(ring.fd.get()).value();
  EXPECT_EQ(::mmap(nullptr, 4096, PROT_READ | PROT_WRITE, MAP_SHARED, reader.get(), 0), MAP_FAILED);
  EXPECT_EQ(errno, EACCES);
  void* page = ::mmap(nullptr, 4096, PROT_READ, MAP_SHARED, reader.get(), 0);
  ASSERT_NE(page, MAP_FAILED);
  EXPECT_EQ(::mprotect(page, 4096, PROT_READ | PROT_WRITE), -1);
  EXPECT_EQ(errno, EACCES);
  ::munmap(page, 4096);
  EXPECT_EQ(::write(reader.get(), "x", 1), -1);
  struct stat file {};
  ASSERT_EQ(::fstat(reader.get(), &file), 0);
  EXPECT_EQ(file.st_mode & 07777, 0400u);
}

TEST(RingMemory, CannotChangeItsSize) {
  const TestRing ring(64, 8);
  EXPECT_EQ(::ftruncate(ring.fd.get(), 0), -1);
  EXPECT_EQ(::ftruncate(ring.fd.get(), 1 << 24), -1);
  EXPECT_EQ(::fcntl(ring.fd.get(), F_ADD_SEALS, F_SEAL_FUTURE_WRITE), -1);
}

TEST(RingMemory, IsWritableAgainForItsCreatorAfterARestart) {
  const TestRing ring(64, 8);
  const UniqueFd read_only = reopen_read_only(ring.fd.get()).value();
  const UniqueFd again = reopen_read_write(read_only.get()).value();
  EXPECT_TRUE(RingMapping::open_untrusted(again.get(), Access::read_write));
}

// Overwrites `bytes` of a ring's header and says what opening it then says.
std::string refusal(std::size_t offset, std::uint64_t value, std::size_t bytes) {
  const TestRing ring(64, 8);
  std::memcpy(ring.mapping->base() + offset, &value, bytes);
  const auto opened = RingMapping::open_untrusted(ring.fd.get(), Access::read_only);
  if (opened) return "accepted";
  EXPECT_EQ(opened.error().code, Errc::protocol);
  return opened.error().message;
}

TEST(RingMapping, RefusesAHeaderThatDoesNotFitTogether) {
  EXPECT_NE(refusal(0, 1, 8).find("DSSMRING"), std::string::npos);
  EXPECT_NE(refusal(8, 99, 4).find("layout version 99"), std::string::npos);
  EXPECT_NE(refusal(12, 3, 4).find("alignment"), std::string::npos);
  EXPECT_NE(refusal(16, 65 + 128, 8).find("geometry"), std::string::npos);
  EXPECT_NE(refusal(16, 0, 8).find("payload of 0"), std::string::npos);
  EXPECT_NE(refusal(24, 1 << 20, 8).find("geometry"), std::string::npos);
  EXPECT_NE(refusal(24, 1, 8).find("depth of 1"), std::string::npos);
  EXPECT_NE(refusal(32, 64, 8).find("geometry"), std::string::npos);
  EXPECT_NE(refusal(40, 1 << 30, 8).find("geometry"), std::string::npos);
  EXPECT_NE(refusal(48, ~0ULL, 8).find("geometry"), std::string::npos);
  EXPECT_NE(refusal(56, 4096, 8).find("geometry"), std::string::npos);
  EXPECT_NE(refusal(80, 0xffffffff, 4).find("ids start at 0"), std::string::npos);
  EXPECT_NE(refusal(88, 0, 8).find("name is empty"), std::string::npos);
}

TEST(RingMapping, RefusesFilesThatAreNoRings) {
  const UniqueFd empty(::memfd_create("x", MFD_CLOEXEC | MFD_ALLOW_SEALING));
  EXPECT_FALSE(RingMapping::open_untrusted(empty.get(), Access::read_only));
  const UniqueFd null(::open("/dev/null", O_RDWR | O_CLOEXEC));
  EXPECT_FALSE(RingMapping::open_untrusted(null.get(), Access::read_only));
  EXPECT_FALSE(Bell::open_untrusted(null.get()));
  const TestRing ring(64, 8);
  EXPECT_FALSE(Bell::open_untrusted(ring.fd.get()));
  EXPECT_FALSE(RingMapping::open_untrusted(ring.bell_fd.get(), Access::read_only));
}

TEST(RingMemory, TakesAllItsMemoryWhenReserved) {
  const TestRing ring(4096, 16);
  ASSERT_TRUE(reserve(ring.fd.get(), ring.mapping->geometry()));
  struct stat file {};
  ASSERT_EQ(::fstat(ring.fd.get(), &file), 0);
  EXPECT_GE(static_cast<std::uint64_t>(file.st_blocks) * 512, ring.mapping->geometry().total_bytes);
}

}  // namespace
}  // namespace dssm::ring
