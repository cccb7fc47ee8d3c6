// SPDX-License-Identifier: Apache-2.0
//
// The memory files that dssmd creates and takes back: how they are checked, and the meta file of a
// stream, which holds what its ring does not.
#pragma once

#include <cstddef>
#include <cstdint>
#include <dssm/result.hpp>
#include <string>
#include <string_view>

#include "core/base/unique_fd.hpp"
#include "local.pb.h"

namespace dssm::daemon {

// Whether `fd` is a memfd that dssmd's own user created and that carries all of `seals` (F_SEAL_*).
// Only root and programs of that same user can make such a file. `what` names it in the failure:
// "ring".
//   fails  protocol (not a sealed memory file), no_permission (another user's)
Result<void> check_own_memory_file(int fd, int seals, std::string_view what);

// The name that a memory file was created with, which nobody can change; empty for other files.
std::string memory_file_name(int fd);

// What dssmd uses a descriptor for, by the name of its file alone: not checked.
enum class DescriptorKind : unsigned char { other, ring, bell, meta, doorbell, playback_clock };
DescriptorKind kind_of_untrusted(int fd);

// Whether close() of it waits for nobody, whoever opened it: a memory file or an eventfd. Waits for
// nobody itself.
bool closes_at_once(int fd);

// Whether both are the same file.
bool same_file(int fd, int other_fd) noexcept;

// A second descriptor of the same open file, close-on-exec.
Result<UniqueFd> duplicate(int fd);

// The meta file: all that dssmd knows about a stream and that is not in its ring, in a memfd beside
// it: type with fields, property, creator, place in the list. With ring, bell and this file alone a
// new dssmd brings a stream back. Only dssmd writes it; clients hold a descriptor for reading, only
// to offer it back. It is read with pread() and never mapped: a wrong size is an error, not a
// signal.
//
// Layout, little endian; the pages not named are holes:
//
//   off size field     unit   meaning
//     0    8 magic     -      "DSSMMETA"
//     8    4 version   -      1
//    12    4 reserved  -      zero
//    16    8 offset    bytes  of the content, a multiple of 4096; 0: the stream was removed
//    24    8 length    bytes  of the content, a protobuf message dssm.local.StreamMeta; 0: removed
//
// Replacing the content must survive `kill -9` at any instruction. So the new content goes to pages
// that the current one does not use; then the header is replaced by one write of 32 bytes inside
// one page, which the kernel copies without handling signals in between; then the old pages are
// freed. A reader gets the old content before the header changes, the new one afterwards. (Loss of
// power does not matter: the file is memory.)
//
// The file is sealed against shrinking and further seals, its mode is 0400: a descriptor for
// reading cannot be turned into one for writing but by dssmd's own user.
struct MetaHeader {
  static constexpr std::uint64_t kMagic = 0x4154454d4d535344;  // "DSSMMETA"
  static constexpr std::uint32_t kVersion = 1;
  std::uint64_t magic = kMagic;
  std::uint32_t version = kVersion;
  std::uint32_t reserved = 0;
  std::uint64_t offset_bytes = 0;
  std::uint64_t length_bytes = 0;
};
static_assert(offsetof(MetaHeader, offset_bytes) == 16 && sizeof(MetaHeader) == 32);

// Owns a read-write descriptor.
class MetaFile {
 public:
  // Creates one that holds `meta`.
  //   label  RingIdentity::label() of the stream's ring
  static Result<MetaFile> create(const local::StreamMeta& meta, const std::string& label);

  // Opens one that an earlier run of dssmd created; `fd` may be for reading only. Fails with
  // `protocol` when it is not a meta file, no_permission when another user created it.
  static Result<MetaFile> open_untrusted(UniqueFd fd);

  // The content. Fails with `protocol` when it is not in order, not_found when the stream was
  // removed.
  Result<local::StreamMeta> read_untrusted() const;

  // Replaces the content by `meta`, at once for all readers.
  Result<void> replace(const local::StreamMeta& meta);

  // Marks the stream as removed for ever: no offer restores it.
  Result<void> mark_removed();

  int fd() const noexcept { return fd_.get(); }

 private:
  explicit MetaFile(UniqueFd fd) : fd_(std::move(fd)) {}
  Result<void> write_header(const MetaHeader& header);

  UniqueFd fd_;
};

}  // namespace dssm::daemon
