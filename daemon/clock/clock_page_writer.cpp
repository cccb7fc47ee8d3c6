// SPDX-License-Identifier: Apache-2.0
#include "daemon/clock/clock_page_writer.hpp"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cstdio>
#include <utility>

namespace dssm::clock {
namespace {

// The page in the file, when it is one of this boot.
ClockPage* map_existing(const std::string& path, const std::string& boot) {
  const UniqueFd file(::open(path.c_str(), O_RDWR | O_CLOEXEC | O_NOFOLLOW));
  if (!file) return nullptr;
  const Result<ClockPage*> page = map_page_untrusted(file.get(), PROT_READ | PROT_WRITE);
  if (!page) return nullptr;
  if (!boot.empty() && boot.compare(0, boot.npos, (*page)->boot_id, boot.size()) == 0) return *page;
  ::munmap(*page, sizeof(ClockPage));
  return nullptr;
}

}  // namespace

Result<ClockPageWriter> ClockPageWriter::open(const std::string& path) {
  const std::string boot = boot_id();
  if (ClockPage* page = map_existing(path, boot)) return ClockPageWriter(path, page, true);
  // Beside the old one, and renamed when it is complete: programs that have the old one mapped keep
  // it.
  const std::string what = "create the clock page '" + path + "'";
  const std::string fresh = path + ".new";
  ::unlink(fresh.c_str());
  const UniqueFd file(::open(fresh.c_str(), O_RDWR | O_CREAT | O_EXCL | O_CLOEXEC, 0644));
  if (!file || ::ftruncate(file.get(), sizeof(ClockPage))) return os_error(what);
  void* memory =
      ::mmap(nullptr, sizeof(ClockPage), PROT_READ | PROT_WRITE, MAP_SHARED, file.get(), 0);
  if (memory == MAP_FAILED) return os_error(what);
  auto* page = static_cast<ClockPage*>(memory);
  ClockPageWriter writer(path, page, false);
  boot.copy(page->boot_id, sizeof page->boot_id - 1);
  writer.store({});
  page->layout_version = ClockPage::kLayoutVersion;
  page->magic = ClockPage::kMagic;
  if (::rename(fresh.c_str(), path.c_str())) return os_error(what);
  return writer;
}

ClockPageWriter::ClockPageWriter(ClockPageWriter&& other) noexcept
    : path_(std::move(other.path_)),
      page_(std::exchange(other.page_, nullptr)),
      has_history_(other.has_history_) {}

ClockPageWriter::~ClockPageWriter() {
  if (page_) ::munmap(page_, sizeof(ClockPage));
}

Result<UniqueFd> ClockPageWriter::for_reading() const {
  UniqueFd file(::open(path_.c_str(), O_RDONLY | O_CLOEXEC));
  if (!file) return os_error("open the clock page '" + path_ + "'");
  return file;
}

}  // namespace dssm::clock
