// SPDX-License-Identifier: Apache-2.0
//
// dssmctl property get and set: bytes in, the same bytes out.
#include <fcntl.h>
#include <fmt/format.h>
#include <unistd.h>

#include <cerrno>

#include "client/dssmctl/open_stream.hpp"
#include "client/dssmctl/options.hpp"
#include "client/dssmctl/output.hpp"
#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl {
namespace {

// A descriptor; closed unless it is one of the standard ones.
class File {
 public:
  explicit File(int fd) : fd_(fd) {}
  File(const File&) = delete;
  File& operator=(const File&) = delete;
  ~File() {
    if (fd_ > STDERR_FILENO) ::close(fd_);
  }
  int fd() const { return fd_; }

 private:
  int fd_;
};

// The greatest property; a read of /dev/zero fails instead of filling the memory.
constexpr std::size_t kMaxPropertyBytes = 1U << 20;

Result<std::vector<std::byte>> read_all(const std::string& path) {
  const bool standard = path == "-";
  const std::string tried = fmt::format("read '{}'", standard ? "standard input" : path);
  const File file(standard ? STDIN_FILENO : ::open(path.c_str(), O_RDONLY | O_CLOEXEC));
  if (file.fd() < 0) return os_error(tried);
  std::vector<std::byte> bytes;
  constexpr std::size_t kStep = 64U << 10;
  while (true) {
    const std::size_t size = bytes.size();
    bytes.resize(size + kStep);
    const ssize_t got = ::read(file.fd(), bytes.data() + size, kStep);
    const int reason = errno;
    bytes.resize(size + (got > 0 ? static_cast<std::size_t>(got) : 0));
    if (got == 0) return bytes;
    if (got < 0 && reason != EINTR) return os_error(tried, reason);
    if (bytes.size() > kMaxPropertyBytes) {
      return Error{Errc::limit_exceeded, fmt::format("{}: longer than the {} a property may have",
                                                     tried, bytes_text(kMaxPropertyBytes))};
    }
  }
}

Result<void> write_all(const std::string& path, std::span<const std::byte> bytes) {
  const std::string tried = fmt::format("write '{}'", path);
  const File file(::open(path.c_str(), O_WRONLY | O_CREAT | O_TRUNC | O_CLOEXEC, 0666));
  if (file.fd() < 0) return os_error(tried);
  while (!bytes.empty()) {
    const ssize_t written = ::write(file.fd(), bytes.data(), bytes.size());
    if (written < 0 && errno != EINTR) return os_error(tried);
    if (written > 0) bytes = bytes.subspan(static_cast<std::size_t>(written));
  }
  return {};
}

}  // namespace

Result<void> run(const PropertyGetOptions& options, Output& out) {
  StreamId id = DSSM_TRY(StreamId::parse(options.stream));
  Session session = DSSM_TRY(connect(options));
  Result<std::vector<std::byte>> property = session.property(id);
  if (!property) return with_similar_names(std::move(property).error(), session, id);
  const bool to_file = options.file != "-";
  if (to_file) DSSM_TRY(write_all(options.file, *property));
  if (options.json) {
    Json json{{"stream", full_name(session, id)}, {"property_bytes", property->size()}};
    if (!to_file) json["property_hex"] = hex_text(*property);
    out.add(json_document(json));
  } else if (!to_file && out.terminal()) {
    out.add(hex_dump(*property, ""));
  } else if (!to_file) {
    out.add({reinterpret_cast<const char*>(property->data()), property->size()});
  }
  return {};
}

Result<void> run(const PropertySetOptions& options, Output& out) {
  StreamId id = DSSM_TRY(StreamId::parse(options.stream));
  const std::vector<std::byte> property = DSSM_TRY(read_all(options.file));
  Session session = DSSM_TRY(connect(options));
  if (Result<void> set = session.set_property(id, property); !set) {
    return with_similar_names(std::move(set).error(), session, id);
  }
  const std::string name = full_name(session, id);
  if (options.json) {
    out.add(json_document({{"stream", name}, {"property_bytes", property.size()}}));
  } else if (property.empty()) {
    out.add(fmt::format("{}: property removed\n", escaped(name)));
  } else {
    out.add(fmt::format("{}: property of {} set\n", escaped(name), bytes_text(property.size())));
  }
  return {};
}

}  // namespace dssm::ctl
