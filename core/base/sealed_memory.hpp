// SPDX-License-Identifier: Apache-2.0
//
// Memory that processes share by descriptor: files of memfd_create(2) with seals on their size, so
// that no process can shrink one while others have it mapped (which would kill them by SIGBUS).
#pragma once

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/types.h>

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <string>
#include <string_view>
#include <utility>

#include "core/base/unique_fd.hpp"

namespace dssm {

inline constexpr int kSizeSeals = F_SEAL_SHRINK | F_SEAL_GROW | F_SEAL_SEAL;

// A new memory file of `bytes` zeros, readable and writable through the returned descriptor.
//   name   shown as "/memfd:NAME" in /proc; dssmd recognizes its own files by it
//   mode   of the inode: who may open the file again through /proc. 0400: only its creator (and
//          root), and only for reading
Result<UniqueFd> create_sealed_memory(const std::string& name, std::uint64_t bytes, mode_t mode,
                                      int seals = kSizeSeals);

// What the system maps at once: 4 KiB, or up to 64 KiB on some ARM systems.
std::size_t system_page_bytes() noexcept;

// Whether `fd` is a memory file with all of `seals`.
bool has_seals(int fd, int seals) noexcept;

// A second descriptor of a memory file of mode 0400 that cannot be mapped or made writable. Only
// for the user who created the file.
Result<UniqueFd> reopen_read_only(int fd);

// The reverse, for a daemon that has only read-only descriptors left of a file that it created.
Result<UniqueFd> reopen_read_write(int fd);

// A shared mapping from the start of a file, or none. Unmapped by the destructor.
class SharedMapping {
 public:
  // protection: PROT_READ, or PROT_READ | PROT_WRITE. The caller has checked that the file has
  // `bytes` bytes. Does not keep `fd`.
  static Result<SharedMapping> map(int fd, std::size_t bytes, int protection);

  // Maps all of a sealed memory file, to read and write, after a check that it is one of `bytes`
  // bytes. `what` names the content in the failure: "bell".
  //   fails  protocol (another kind of file), os errors
  static Result<SharedMapping> map_sealed_untrusted(int fd, std::size_t bytes,
                                                    std::string_view what);

  // Maps the first `bytes` bytes, a multiple of system_page_bytes(), to read and write, and a page
  // of this process's own, zeroed, from end() on. Does not keep `fd`.
  static Result<SharedMapping> map_before_private_page(int fd, std::size_t bytes);

  SharedMapping() = default;
  SharedMapping(SharedMapping&& other) noexcept
      : base_(std::exchange(other.base_, nullptr)),
        bytes_(other.bytes_),
        private_bytes_(other.private_bytes_) {}
  SharedMapping& operator=(SharedMapping&& other) noexcept {
    std::swap(base_, other.base_);
    std::swap(bytes_, other.bytes_);
    std::swap(private_bytes_, other.private_bytes_);
    return *this;
  }
  ~SharedMapping();

  std::byte* base() const noexcept { return base_; }
  std::byte* end() const noexcept { return base_ + bytes_; }
  template <class T>
  T& as() const noexcept {
    return *reinterpret_cast<T*>(base_);
  }

 private:
  std::byte* base_ = nullptr;
  std::size_t bytes_ = 0;
  std::size_t private_bytes_ = 0;  // from end() on
};

}  // namespace dssm
