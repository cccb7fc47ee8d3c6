// SPDX-License-Identifier: Apache-2.0
//
// The meta file: it keeps what it is given, survives being killed while its content is replaced,
// and is not believed when it comes from outside.
#include <fcntl.h>
#include <gtest/gtest.h>
#include <signal.h>
#include <sys/mman.h>
#include <sys/prctl.h>
#include <sys/ptrace.h>
#include <sys/stat.h>
#include <sys/wait.h>
#include <unistd.h>

#include <cstring>
#include <random>

#include "core/base/sealed_memory.hpp"
#include "core/ring/ring_memory.hpp"
#include "daemon/streams/memory_files.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

local::StreamMeta meta_with(const std::string& property) {
  local::StreamMeta meta;
  wire::to_message(StreamId{"odometry", 3, "pc1"}, *meta.mutable_id());
  wire::to_message(odometry_type(), *meta.mutable_type());
  meta.set_property(property);
  meta.set_creator_pid(42);
  meta.set_created_order(7);
  return meta;
}

std::uint64_t memory_of(int fd) {
  struct stat file {};
  EXPECT_EQ(::fstat(fd, &file), 0);
  return static_cast<std::uint64_t>(file.st_blocks) * 512;
}

// A sealed memory file of this user with any content: what a hostile program of this user could
// offer.
UniqueFd forged(const std::string& content, int seals = F_SEAL_SHRINK | F_SEAL_SEAL) {
  UniqueFd fd(::memfd_create("forged", MFD_CLOEXEC | MFD_ALLOW_SEALING));
  EXPECT_EQ(::pwrite(fd.get(), content.data(), content.size(), 0),
            static_cast<ssize_t>(content.size()));
  EXPECT_EQ(::fcntl(fd.get(), F_ADD_SEALS, seals), 0);
  return fd;
}

std::string header_bytes(const MetaHeader& header) {
  return std::string(reinterpret_cast<const char*>(&header), sizeof header);
}

// Whether a file of these bytes passes for a meta file with content.
Errc error_of(const std::string& content) {
  Result<MetaFile> opened = MetaFile::open_untrusted(forged(content));
  if (!opened) return opened.error().code;
  const Result<local::StreamMeta> read = opened->read_untrusted();
  EXPECT_FALSE(read);
  return read ? Errc::closed : read.error().code;
}

TEST(MetaFile, GivesBackWhatItWasCreatedWith) {
  const Result<MetaFile> file = MetaFile::create(meta_with("abc"), "test");
  ASSERT_TRUE(file) << file.error().message;
  const Result<local::StreamMeta> read = file->read_untrusted();
  ASSERT_TRUE(read) << read.error().message;
  EXPECT_EQ(read->SerializeAsString(), meta_with("abc").SerializeAsString());
}

TEST(MetaFile, GivesTheNewestContentAfterManyReplacementsAndKeepsItsMemorySmall) {
  Result<MetaFile> file = MetaFile::create(meta_with(""), "test");
  ASSERT_TRUE(file);
  const auto seed = std::random_device()();
  SCOPED_TRACE("seed " + std::to_string(seed));
  std::mt19937 random(seed);
  for (int round = 0; round < 500; ++round) {
    const std::string property(random() % 100'000, static_cast<char>('a' + round % 26));
    ASSERT_TRUE(file->replace(meta_with(property)));
    const Result<local::StreamMeta> read = file->read_untrusted();
    ASSERT_TRUE(read) << read.error().message;
    ASSERT_EQ(read->property(), property);
    ASSERT_LE(memory_of(file->fd()), property.size() + 4 * 4096) << "old content is not given back";
  }
}

TEST(MetaFile, CannotBeWrittenThroughTheDescriptorThatClientsGet) {
  const Result<MetaFile> file = MetaFile::create(meta_with(""), "test");
  ASSERT_TRUE(file);
  const Result<UniqueFd> for_clients = reopen_read_only(file->fd());
  ASSERT_TRUE(for_clients);
  EXPECT_EQ(::pwrite(for_clients->get(), "x", 1, 0), -1);
  struct stat inode {};
  ASSERT_EQ(::fstat(for_clients->get(), &inode), 0);
  EXPECT_EQ(inode.st_mode & 0777, 0400u) << "or a reader could open it anew for writing";
  EXPECT_EQ(::ftruncate(file->fd(), 0), -1) << "sealed against shrinking";
}

TEST(MetaFile, CanBeTakenBackFromADescriptorForReading) {
  std::vector<UniqueFd> kept;
  {
    const Result<MetaFile> file = MetaFile::create(meta_with("kept"), "test");
    ASSERT_TRUE(file);
    Result<UniqueFd> for_clients = reopen_read_only(file->fd());
    ASSERT_TRUE(for_clients);
    kept.push_back(*std::move(for_clients));
  }
  Result<MetaFile> again = MetaFile::open_untrusted(std::move(kept[0]));
  ASSERT_TRUE(again) << again.error().message;
  EXPECT_EQ(again->read_untrusted()->property(), "kept");
  ASSERT_TRUE(again->replace(meta_with("newer")));
  EXPECT_EQ(again->read_untrusted()->property(), "newer");
}

TEST(MetaFile, ReportsThatTheStreamWasRemovedOnceItIsMarked) {
  Result<MetaFile> file = MetaFile::create(meta_with("x"), "test");
  ASSERT_TRUE(file);
  ASSERT_TRUE(file->mark_removed());
  const Result<local::StreamMeta> read = file->read_untrusted();
  ASSERT_FALSE(read);
  EXPECT_EQ(read.error().code, Errc::not_found);
}

TEST(MetaFile, RefusesWhatIsNoMetaFile) {
  EXPECT_EQ(error_of(""), Errc::protocol);
  EXPECT_EQ(error_of("DSSMMETA"), Errc::protocol) << "shorter than its header";
  EXPECT_EQ(error_of(std::string(8192, '\0')), Errc::protocol) << "no magic";
  MetaHeader other_version;
  other_version.version = 2;
  EXPECT_EQ(error_of(header_bytes(other_version)), Errc::protocol);
}

TEST(MetaFile, RefusesAHeaderThatPointsOutsideOfTheFile) {
  const auto file_with = [](std::uint64_t offset, std::uint64_t length) {
    MetaHeader header;
    header.offset_bytes = offset;
    header.length_bytes = length;
    std::string content = header_bytes(header);
    content.resize(3 * 4096);
    return content;
  };
  EXPECT_EQ(error_of(file_with(4096, 8193)), Errc::protocol);
  EXPECT_EQ(error_of(file_with(16384, 1)), Errc::protocol);
  EXPECT_EQ(error_of(file_with(4096, UINT64_MAX)), Errc::protocol);
  EXPECT_EQ(error_of(file_with(UINT64_MAX - 4095, 8192)), Errc::protocol);
  EXPECT_EQ(error_of(file_with(0, 16)), Errc::protocol) << "on its own header";
  EXPECT_EQ(error_of(file_with(4097, 16)), Errc::protocol) << "not on a page";
  EXPECT_EQ(error_of(file_with(4096, 0)), Errc::protocol) << "half a mark of removal";
}

TEST(MetaFile, RefusesContentThatIsNoStreamMeta) {
  MetaHeader header;
  header.offset_bytes = 4096;
  header.length_bytes = 16;
  std::string content = header_bytes(header);
  content.resize(4096);
  content.append(16, '\xff');
  EXPECT_EQ(error_of(content), Errc::protocol);
}

TEST(MetaFile, RefusesAFileThatIsNotSealed) {
  MetaHeader header;
  EXPECT_FALSE(MetaFile::open_untrusted(forged(header_bytes(header), F_SEAL_SEAL)));
  UniqueFd pipe_end;
  int ends[2];
  ASSERT_EQ(::pipe2(ends, O_CLOEXEC), 0);
  pipe_end.reset(ends[0]);
  UniqueFd other(ends[1]);
  EXPECT_FALSE(MetaFile::open_untrusted(std::move(pipe_end)));
}

TEST(MetaFile, RefusesAFileOfAnotherUser) {
  if (::geteuid() != 0) GTEST_SKIP() << "only root can make a file of another user";
  UniqueFd fd = forged(header_bytes(MetaHeader{}));
  ASSERT_EQ(::fchown(fd.get(), 65534, 65534), 0);
  const Result<MetaFile> opened = MetaFile::open_untrusted(std::move(fd));
  ASSERT_FALSE(opened);
  EXPECT_EQ(opened.error().code, Errc::no_permission);
}

// A child replaces the content and is stopped after each of its system calls, which are all that
// changes the file; at each stop the file is what a `kill -9` there would leave.
TEST(MetaFile, HoldsTheOldOrTheNewContentWhereverItsWriterIsKilled) {
  const std::string old_property(5000, 'o'), new_property(9000, 'n');
  Result<MetaFile> file = MetaFile::create(meta_with(old_property), "test");
  ASSERT_TRUE(file);
  const pid_t child = ::fork();
  ASSERT_GE(child, 0);
  if (child == 0) {
    ::prctl(PR_SET_PDEATHSIG, SIGKILL);
    if (::ptrace(PTRACE_TRACEME, 0, nullptr, nullptr)) ::_exit(77);
    ::raise(SIGSTOP);
    ::_exit(file->replace(meta_with(new_property)) ? 0 : 1);
  }
  int stops = 0, olds = 0, news = 0, status = 0;
  for (;;) {
    ASSERT_EQ(::waitpid(child, &status, 0), child);
    if (WIFEXITED(status) || WIFSIGNALED(status)) break;
    const Result<local::StreamMeta> read = file->read_untrusted();
    ASSERT_TRUE(read) << "after " << stops << " stops: " << read.error().message;
    olds += read->property() == old_property;
    news += read->property() == new_property;
    ++stops;
    ASSERT_EQ(olds + news, stops) << "neither the old nor the new content";
    ASSERT_EQ(::ptrace(PTRACE_SYSCALL, child, nullptr, nullptr), 0);
  }
  if (WIFEXITED(status) && WEXITSTATUS(status) == 77) {
    GTEST_SKIP() << "this system does not let a test trace its own child";
  }
  ASSERT_TRUE(WIFEXITED(status) && WEXITSTATUS(status) == 0);
  EXPECT_GT(olds, 2) << "stopped before the header was replaced";
  EXPECT_GT(news, 0) << "stopped after the header was replaced";
}

// The same for a write that was cut short: any part of the new content, without the header.
TEST(MetaFile, HoldsTheOldContentWhenOnlyAPartOfTheNewOneWasWritten) {
  Result<MetaFile> file = MetaFile::create(meta_with("old"), "test");
  ASSERT_TRUE(file);
  const std::string next = meta_with(std::string(9000, 'n')).SerializeAsString();
  for (const std::size_t written : {std::size_t{1}, std::size_t{4096}, next.size()}) {
    ASSERT_EQ(::pwrite(file->fd(), next.data(), written, 8192), static_cast<ssize_t>(written));
    EXPECT_EQ(file->read_untrusted()->property(), "old");
  }
  ASSERT_TRUE(file->replace(meta_with("after")));
  EXPECT_EQ(file->read_untrusted()->property(), "after");
}

}  // namespace
}  // namespace dssm::daemon
