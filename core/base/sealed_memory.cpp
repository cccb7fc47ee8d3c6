// SPDX-License-Identifier: Apache-2.0
#include "core/base/sealed_memory.hpp"

#include <fmt/format.h>
#include <sys/stat.h>
#include <unistd.h>

#include "core/base/try.hpp"

namespace dssm {
namespace {

// The magic links of /proc lead to the file itself.
Result<UniqueFd> reopen(int fd, int flags) {
  const std::string path = fmt::format("/proc/self/fd/{}", fd);
  UniqueFd reopened(::open(path.c_str(), flags | O_CLOEXEC));
  if (!reopened) return os_error("reopen the memory file '" + path + "'");
  return reopened;
}

}  // namespace

Result<UniqueFd> create_sealed_memory(const std::string& name, std::uint64_t bytes, mode_t mode,
                                      int seals) {
  UniqueFd fd(::memfd_create(name.c_str(), MFD_CLOEXEC | MFD_ALLOW_SEALING));
  if (!fd || ::ftruncate(fd.get(), static_cast<off_t>(bytes)) ||
      ::fcntl(fd.get(), F_ADD_SEALS, seals) || ::fchmod(fd.get(), mode)) {
    return os_error(fmt::format("create the memory file '{}' of {} bytes", name, bytes));
  }
  return fd;
}

std::size_t system_page_bytes() noexcept {
  return static_cast<std::size_t>(::sysconf(_SC_PAGESIZE));
}

bool has_seals(int fd, int seals) noexcept {
  // Only memfds and files of a tmpfs answer, and the latter carry no such seals.
  const int found = ::fcntl(fd, F_GET_SEALS);
  return found >= 0 && (found & seals) == seals;
}

Result<UniqueFd> reopen_read_only(int fd) { return reopen(fd, O_RDONLY); }

Result<UniqueFd> reopen_read_write(int fd) {
  if (::fchmod(fd, 0600)) return os_error("reopen a memory file for writing");
  Result<UniqueFd> writable = reopen(fd, O_RDWR);
  if (::fchmod(fd, 0400)) return os_error("protect a memory file");
  return writable;
}

Result<SharedMapping> SharedMapping::map(int fd, std::size_t bytes, int protection) {
  void* const base = ::mmap(nullptr, bytes, protection, MAP_SHARED, fd, 0);
  if (base == MAP_FAILED) return os_error(fmt::format("map {} bytes of a file", bytes));
  SharedMapping mapping;
  mapping.base_ = static_cast<std::byte*>(base);
  mapping.bytes_ = bytes;
  return mapping;
}

Result<SharedMapping> SharedMapping::map_before_private_page(int fd, std::size_t bytes) {
  constexpr int kProtection = PROT_READ | PROT_WRITE;
  SharedMapping mapping;
  mapping.private_bytes_ = system_page_bytes();
  void* const base = ::mmap(nullptr, bytes + mapping.private_bytes_, kProtection,
                            MAP_PRIVATE | MAP_ANONYMOUS, -1, 0);
  if (base == MAP_FAILED) return os_error(fmt::format("map {} bytes", bytes));
  mapping.base_ = static_cast<std::byte*>(base);
  mapping.bytes_ = bytes;
  if (::mmap(base, bytes, kProtection, MAP_SHARED | MAP_FIXED, fd, 0) == MAP_FAILED) {
    return os_error(fmt::format("map {} bytes of a file", bytes));
  }
  return mapping;
}

Result<SharedMapping> SharedMapping::map_sealed_untrusted(int fd, std::size_t bytes,
                                                          std::string_view what) {
  struct stat file {};
  if (!has_seals(fd, kSizeSeals) || ::fstat(fd, &file) ||
      file.st_size != static_cast<off_t>(bytes)) {
    return Error{
        Errc::protocol,
        fmt::format("this is not a {}: it is not a sealed memory file of {} bytes", what, bytes)};
  }
  return DSSM_TRY(map(fd, bytes, PROT_READ | PROT_WRITE), fmt::format("map a {}", what));
}

SharedMapping::~SharedMapping() {
  if (base_) ::munmap(base_, bytes_ + private_bytes_);
}

}  // namespace dssm
