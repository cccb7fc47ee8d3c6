// SPDX-License-Identifier: Apache-2.0
//
// Arbitrary bytes as a stream's meta file, from which a dssmd that is started again restores the
// stream: the whole file, or what is behind a header in order. A stream that comes of it is used.
// An input's first byte chooses which.
#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <cstdlib>

#include "tests/fuzz/fuzzer.hpp"
#include "tests/unit/daemon/daemon_fixtures.hpp"

namespace dssm::daemon {
namespace {

constexpr std::uint64_t kContentOffset = 4096;

void write(int fd, std::span<const std::byte> bytes, std::uint64_t offset) {
  if (::pwrite(fd, bytes.data(), bytes.size(), static_cast<off_t>(offset)) !=
      static_cast<ssize_t>(bytes.size())) {
    std::abort();
  }
}

void run(std::span<const std::uint8_t> input) {
  if (input.empty()) return;
  const bool is_content = input[0] & 1;
  const auto bytes = std::as_bytes(input.subspan(1));
  const StreamId id{"a", 0, ""};
  const TypeInfo type{"T", 8, 8, {}};
  Registry before("pc1", kLimits);
  const auto stream = before.create(id, type, kHistory, 1).value().stream;
  OfferedFiles files = as_offer(stream->descriptors_for(Role::reader).value());
  {
    const UniqueFd meta(
        ::open(fmt::format("/proc/self/fd/{}", files.meta.get()).c_str(), O_RDWR | O_CLOEXEC));
    if (is_content) {
      write(meta.get(), bytes, kContentOffset);
      MetaHeader header;
      header.offset_bytes = kContentOffset;
      header.length_bytes = bytes.size();
      write(meta.get(), std::as_bytes(std::span(&header, 1)), 0);
    } else {
      write(meta.get(), bytes, 0);
    }
  }
  Registry registry("pc1", kLimits);
  const auto adopted = registry.adopt_stored_untrusted(std::move(files));
  if (!adopted) {
    if (adopted.error().message.empty() || !registry.streams().empty()) std::abort();
    return;
  }
  if ((*adopted)->id() != stream->id()) std::abort();
  static_cast<void>((*adopted)->info());
  if (!registry.set_property(id, "b") || (*adopted)->property().value() != "b") std::abort();
  if (!registry.remove(id)) std::abort();
}

}  // namespace
}  // namespace dssm::daemon

void dssm::fuzz::run_input(std::span<const std::uint8_t> input) { dssm::daemon::run(input); }
