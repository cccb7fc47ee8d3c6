// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/pki_files.hpp"

#include <gtest/gtest.h>
#include <pwd.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <filesystem>

#include "tests/support/daemon_process.hpp"

namespace dssm::ctl::pki {
namespace {

struct PkiFiles : testing::Test {
  PkiFiles() { ::umask(0); }
  ~PkiFiles() override {
    ::umask(022);
    test::remove_tree(folder_);
  }

  mode_t mode_of(const std::string& path) {
    struct stat status {};
    EXPECT_EQ(::lstat(path.c_str(), &status), 0);
    return status.st_mode & 07777;
  }
  std::size_t files() {
    const std::filesystem::directory_iterator begin(folder_), end;
    return static_cast<std::size_t>(std::distance(begin, end));
  }

  std::string folder_ = test::make_temp_dir();
  std::string path_ = folder_ + "/file";
};

TEST_F(PkiFiles, AreReplacedWholeWithTheModeAskedFor) {
  ::umask(077);
  EXPECT_TRUE(replace_file(path_, "old", 0644));
  EXPECT_EQ(mode_of(path_), 0644U);
  EXPECT_TRUE(replace_file(path_, "new", 0600));
  EXPECT_EQ(read_text(path_).value(), "new");
  EXPECT_EQ(mode_of(path_), 0600U);
  EXPECT_EQ(files(), 1U);  // nothing temporary is left
}

TEST_F(PkiFiles, DoNotReplaceWhatIsNotAFile) {
  ASSERT_EQ(::symlink("/dev/null", path_.c_str()), 0);
  const Result<void> replaced = replace_file(path_, "text", 0644);
  ASSERT_FALSE(replaced);
  EXPECT_EQ(replaced.error().code, Errc::conflict);
  EXPECT_FALSE(replace_file(folder_, "text", 0644));
  EXPECT_EQ(files(), 1U);
}

TEST_F(PkiFiles, AKeyThatIsThereIsKept) {
  const Key key = make_key().value();
  EXPECT_TRUE(create_key_file(path_, key).value());
  EXPECT_FALSE(create_key_file(path_, make_key().value()).value());
  EXPECT_EQ(read_text(path_).value(), pem_of(key));
  EXPECT_EQ(files(), 1U);
}

TEST_F(PkiFiles, AKeyIsReadableByItsOwnerAndDssmdOnly) {
  ASSERT_TRUE(create_key_file(path_, make_key().value()));
  const passwd* dssm = ::geteuid() == 0 ? ::getpwnam("dssm") : nullptr;
  EXPECT_EQ(mode_of(path_), 0600U);
  struct stat status {};
  ::lstat(path_.c_str(), &status);
  EXPECT_EQ(status.st_uid, dssm ? dssm->pw_uid : ::geteuid());
}

TEST_F(PkiFiles, NothingThatIsThereIsFollowedOrReplacedByAKey) {
  ASSERT_EQ(::symlink((folder_ + "/elsewhere").c_str(), path_.c_str()), 0);
  EXPECT_FALSE(create_key_file(path_, make_key().value()).value());
  EXPECT_FALSE(std::filesystem::exists(folder_ + "/elsewhere"));
}

TEST_F(PkiFiles, ReadingEndsAtAMebibyte) {
  const Result<std::string> text = read_text("/dev/zero");
  ASSERT_FALSE(text);
  EXPECT_EQ(text.error().code, Errc::limit_exceeded);
  EXPECT_EQ(read_text(path_).error().code, Errc::not_found);
}

TEST_F(PkiFiles, AFolderIsLockedByOneAtATime) {
  const UniqueFd lock = lock_folder(folder_).value();
  const UniqueFd other(::open(folder_.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  EXPECT_EQ(::flock(other.get(), LOCK_EX | LOCK_NB), -1);
  EXPECT_EQ(errno, EWOULDBLOCK);
}

TEST_F(PkiFiles, WhatWasIssuedIsInOrder) {
  const Authority ca = make_authority("truck", 0).value();
  const Key key = make_key().value();
  ASSERT_TRUE(create_folder(path_in(folder_, kIssued)));
  std::vector<std::string> serials(12);
  for (std::size_t i = 0; i < serials.size(); ++i) {  // 10 comes after 9, not after 1
    const Certificate certificate = issue(ca, {{Kind::program, "a", {}}, key}, 1).value();
    serials[i] = serial_of(certificate);
    ASSERT_TRUE(store_issued(folder_, {{}, i + 1, certificate}, 0));
  }
  const std::vector<Issued> all = read_issued(folder_).value();
  ASSERT_EQ(all.size(), serials.size());
  for (std::size_t i = 0; i < all.size(); ++i) {
    EXPECT_EQ(serial_of(all[i].certificate), serials[i]);
    EXPECT_EQ(all[i].place, i + 1);
  }
}

TEST_F(PkiFiles, ASerialNumberIsFoundAsOtherProgramsWriteIt) {
  const Authority ca = make_authority("truck", 0).value();
  const std::string serial = serial_of(ca.certificate);
  std::string written;
  for (std::size_t i = 0; i < serial.size(); i += 2) {
    written += (i ? ":" : "") + serial.substr(i, 2);
  }
  for (char& c : written) c = static_cast<char>(std::toupper(c));
  EXPECT_TRUE(is_serial(ca.certificate, serial));
  EXPECT_TRUE(is_serial(ca.certificate, written));
  EXPECT_FALSE(is_serial(ca.certificate, serial.substr(1)));
  EXPECT_FALSE(is_serial(ca.certificate, ""));
}

}  // namespace
}  // namespace dssm::ctl::pki
