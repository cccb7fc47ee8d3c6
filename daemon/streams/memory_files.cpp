// SPDX-License-Identifier: Apache-2.0
#include "daemon/streams/memory_files.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <string>

#include "core/base/sealed_memory.hpp"
#include "core/base/try.hpp"
#include "core/wire/local_protocol.hpp"

namespace dssm::daemon {
namespace {

constexpr int kMetaSeals = F_SEAL_SHRINK | F_SEAL_SEAL;
constexpr std::uint64_t kPage = 4096;

// No content that dssmd wrote is longer: it arrived in one frame, or in two that were shorter.
constexpr std::uint64_t kMaxContentBytes = 2 * wire::kMaxLocalRequestBytes;

constexpr std::uint64_t pages_up(std::uint64_t bytes) noexcept {
  return (bytes + kPage - 1) / kPage * kPage;
}

Error not_a_meta_file(const std::string& why) {
  return Error{Errc::protocol, "this is not a usable meta file: " + why};
}

Result<void> write_all(int fd, std::string_view bytes, std::uint64_t offset) {
  while (!bytes.empty()) {
    const ssize_t written = ::pwrite(fd, bytes.data(), bytes.size(), static_cast<off_t>(offset));
    if (written < 0) {
      if (errno == EINTR) continue;
      return os_error("write a stream's meta file");
    }
    bytes.remove_prefix(static_cast<std::size_t>(written));
    offset += static_cast<std::uint64_t>(written);
  }
  return {};
}

// What /proc shows of a descriptor.
std::string link_of(int fd) {
  char link[512];  // a memory file's name has at most 249 bytes
  const std::string path = "/proc/self/fd/" + std::to_string(fd);
  const ssize_t bytes = ::readlink(path.c_str(), link, sizeof link);
  return bytes < 0 ? std::string() : std::string(link, static_cast<std::size_t>(bytes));
}

// False when the file ends before.
bool read_all(int fd, char* to, std::size_t bytes, std::uint64_t offset) noexcept {
  while (bytes > 0) {
    const ssize_t got = ::pread(fd, to, bytes, static_cast<off_t>(offset));
    if (got < 0 && errno == EINTR) continue;
    if (got <= 0) return false;
    to += got;
    bytes -= static_cast<std::size_t>(got);
    offset += static_cast<std::uint64_t>(got);
  }
  return true;
}

Result<MetaHeader> read_header_untrusted(int fd) {
  MetaHeader header;
  if (!read_all(fd, reinterpret_cast<char*>(&header), sizeof header, 0)) {
    return not_a_meta_file("it is shorter than its header");
  }
  if (header.magic != MetaHeader::kMagic) {
    return not_a_meta_file("it does not begin with \"DSSMMETA\"");
  }
  if (header.version != MetaHeader::kVersion) {
    return not_a_meta_file(fmt::format("it has the version {}, this dssmd knows {}", header.version,
                                       MetaHeader::kVersion));
  }
  if (header.offset_bytes == 0 && header.length_bytes == 0) return header;
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("look at a stream's meta file");
  const auto file_bytes = static_cast<std::uint64_t>(file.st_size);
  if (header.offset_bytes < kPage || header.offset_bytes % kPage != 0 || header.length_bytes == 0 ||
      header.length_bytes > kMaxContentBytes || header.offset_bytes > file_bytes ||
      header.length_bytes > file_bytes - header.offset_bytes) {
    return not_a_meta_file("its header points outside of it");
  }
  return header;
}

}  // namespace

// --- any memory file

Result<void> check_own_memory_file(int fd, int seals, std::string_view what) {
  const std::string name = "the offered " + std::string(what);
  struct stat file {};
  if (::fstat(fd, &file)) return os_error("look at " + name);
  if (!has_seals(fd, seals)) {
    return Error{Errc::protocol, name + " is not a sealed memory file that dssmd created"};
  }
  if (file.st_uid != ::geteuid()) {
    return Error{
        Errc::no_permission,
        fmt::format("{} belongs to user {}, not to dssmd's user {}: dssmd did not create it", name,
                    file.st_uid, ::geteuid())};
  }
  return {};
}

std::string memory_file_name(int fd) {
  constexpr std::string_view kBefore = "/memfd:", kAfter = " (deleted)";
  const std::string link = link_of(fd);
  if (!link.starts_with(kBefore) || !link.ends_with(kAfter)) return {};
  return link.substr(kBefore.size(), link.size() - kBefore.size() - kAfter.size());
}

DescriptorKind kind_of_untrusted(int fd) {
  const std::string name = memory_file_name(fd);
  if (name.starts_with("dssm-ring:")) return DescriptorKind::ring;
  if (name.starts_with("dssm-bell:")) return DescriptorKind::bell;
  if (name.starts_with("dssm-meta:")) return DescriptorKind::meta;
  if (name == "dssm-playback-clock") return DescriptorKind::playback_clock;
  if (link_of(fd) == "anon_inode:[eventfd]") return DescriptorKind::doorbell;
  return DescriptorKind::other;
}

bool closes_at_once(int fd) {
  // Where a file system of a program is mounted, that program chooses the names of files, too; only
  // those in memory can have seals.
  return ::fcntl(fd, F_GET_SEALS) >= 0 || kind_of_untrusted(fd) == DescriptorKind::doorbell;
}

bool same_file(int fd, int other_fd) noexcept {
  struct stat one {
  }, other{};
  return ::fstat(fd, &one) == 0 && ::fstat(other_fd, &other) == 0 && one.st_dev == other.st_dev &&
         one.st_ino == other.st_ino;
}

Result<UniqueFd> duplicate(int fd) {
  UniqueFd copy(::fcntl(fd, F_DUPFD_CLOEXEC, 0));
  if (!copy) return os_error("duplicate a descriptor");
  return copy;
}

// --- meta files

Result<MetaFile> MetaFile::create(const local::StreamMeta& meta, const std::string& label) {
  MetaFile file(DSSM_TRY(create_sealed_memory("dssm-meta:" + label, 0, 0400, kMetaSeals)));
  DSSM_TRY(file.write_header(MetaHeader{}));
  DSSM_TRY(file.replace(meta));
  return file;
}

Result<MetaFile> MetaFile::open_untrusted(UniqueFd fd) {
  DSSM_TRY(check_own_memory_file(fd.get(), kMetaSeals, "meta file"));
  DSSM_TRY(read_header_untrusted(fd.get()));
  // One that was offered for writing might be shared with the process that offered it: take a new
  // one.
  return MetaFile(DSSM_TRY(reopen_read_write(fd.get())));
}

Result<local::StreamMeta> MetaFile::read_untrusted() const {
  const MetaHeader header = DSSM_TRY(read_header_untrusted(fd_.get()));
  if (header.length_bytes == 0) {
    return Error{Errc::not_found, "the stream was removed (dssmctl rm); create it again"};
  }
  std::string content(header.length_bytes, '\0');
  if (!read_all(fd_.get(), content.data(), content.size(), header.offset_bytes)) {
    return not_a_meta_file("its content cannot be read");
  }
  local::StreamMeta meta;
  if (!meta.ParseFromString(content)) return not_a_meta_file("its content is not a StreamMeta");
  return meta;
}

Result<void> MetaFile::replace(const local::StreamMeta& meta) {
  const std::string content = meta.SerializeAsString();
  const std::size_t bytes = content.size();
  if (bytes == 0 || bytes > kMaxContentBytes) {
    return Error{
        Errc::limit_exceeded,
        fmt::format(
            "a stream's description and property of {} bytes are too much for its meta file",
            bytes)};
  }
  const MetaHeader current = DSSM_TRY(read_header_untrusted(fd_.get()));
  const bool fits_before =
      current.offset_bytes == 0 || kPage + pages_up(bytes) <= current.offset_bytes;
  MetaHeader next;
  next.offset_bytes = fits_before ? kPage : current.offset_bytes + pages_up(current.length_bytes);
  next.length_bytes = bytes;
  DSSM_TRY(write_all(fd_.get(), content, next.offset_bytes));
  DSSM_TRY(write_header(next));
  if (current.offset_bytes > 0) {
    // Only gives memory back; without it everything is as correct.
    ::fallocate(fd_.get(), FALLOC_FL_PUNCH_HOLE | FALLOC_FL_KEEP_SIZE,
                static_cast<off_t>(current.offset_bytes),
                static_cast<off_t>(pages_up(current.length_bytes)));
  }
  return {};
}

Result<void> MetaFile::mark_removed() { return write_header(MetaHeader{}); }

Result<void> MetaFile::write_header(const MetaHeader& header) {
  const std::string_view bytes(reinterpret_cast<const char*>(&header), sizeof header);
  return write_all(fd_.get(), bytes, 0);
}

}  // namespace dssm::daemon
