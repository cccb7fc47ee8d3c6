// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/pki_files.hpp"

#include <fcntl.h>
#include <fmt/format.h>
#include <pwd.h>
#include <stdlib.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <array>
#include <cerrno>
#include <charconv>
#include <filesystem>
#include <tuple>

#include "client/dssmctl/text.hpp"
#include "core/base/try.hpp"

namespace dssm::ctl::pki {
namespace {

constexpr std::size_t kMaxTextBytes = 1U << 20;
constexpr std::string_view kIssuedLine = "Issued ";
constexpr const char* kDaemonUser = "dssm";

// errno's error, with what a person can do about it.
Error file_error(const std::string& tried, int reason = errno) {
  Error error = os_error(tried, reason);
  if (reason == ENOENT) error.code = Errc::not_found;
  if (error.code == Errc::no_permission) error.message += "; run it as root, or with sudo";
  return error;
}

std::string folder_of(const std::string& path) {
  const std::string folder = std::filesystem::path(path).parent_path().string();
  return folder.empty() ? "." : folder;
}

Result<void> write_whole(int fd, std::string_view text, const std::string& tried) {
  while (!text.empty()) {
    const ssize_t written = ::write(fd, text.data(), text.size());
    if (written < 0 && errno != EINTR) return file_error(tried);
    if (written > 0) text.remove_prefix(static_cast<std::size_t>(written));
  }
  if (::fsync(fd)) return file_error(tried);
  return {};
}

// A new name or contents of a folder survives a loss of power only after this.
Result<void> sync_folder(const std::string& folder) {
  const UniqueFd fd(::open(folder.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!fd || ::fsync(fd.get())) return file_error(fmt::format("write to '{}'", folder));
  return {};
}

// A file beside `path` that becomes it at the end; removed if it does not.
class TemporaryFile {
 public:
  // Mode 0600, in a name that nothing had (O_EXCL): not a link that another user put there.
  static Result<TemporaryFile> create(const std::string& path, std::string_view text) {
    TemporaryFile file;
    file.tried_ = fmt::format("write '{}'", path);
    file.path_ = fmt::format("{}/.{}.XXXXXX", folder_of(path),
                             std::filesystem::path(path).filename().string());
    file.fd_.reset(::mkostemp(file.path_.data(), O_CLOEXEC));
    if (!file.fd_) return file_error(file.tried_);
    DSSM_TRY(write_whole(file.fd_.get(), text, file.tried_));
    return file;
  }
  TemporaryFile(TemporaryFile&&) = default;
  TemporaryFile& operator=(TemporaryFile&&) = delete;
  ~TemporaryFile() {
    if (fd_) ::unlink(path_.c_str());  // after a rename there is nothing of this name
  }

  int fd() const { return fd_.get(); }
  const std::string& path() const { return path_; }
  const std::string& tried() const { return tried_; }

 private:
  TemporaryFile() = default;
  UniqueFd fd_;
  std::string path_, tried_;
};

// Lets dssmd read the key, and not its group: programs of that group are not the host.
Result<void> give_to_daemon(const TemporaryFile& file) {
  if (::geteuid() != 0) return {};
  const passwd* dssm = ::getpwnam(kDaemonUser);  // NOLINT(concurrency-mt-unsafe): one thread
  if (!dssm) return {};
  if (::fchown(file.fd(), dssm->pw_uid, 0) || ::fsync(file.fd())) return file_error(file.tried());
  return {};
}

}  // namespace

std::string path_in(const std::string& folder, std::string_view name) {
  return (std::filesystem::path(folder) / name).string();
}

Result<std::string> read_text(const std::string& path) {
  const bool standard = path == "-";
  const std::string tried = standard ? "read standard input" : fmt::format("read '{}'", path);
  const UniqueFd file(standard ? -1 : ::open(path.c_str(), O_RDONLY | O_CLOEXEC));
  if (!standard && !file) return file_error(tried);
  std::string text;
  while (true) {
    char buffer[16'384];
    const ssize_t got = ::read(standard ? STDIN_FILENO : file.get(), buffer, sizeof buffer);
    if (got == 0) return text;
    if (got < 0 && errno != EINTR) return file_error(tried);
    if (got > 0) text.append(buffer, static_cast<std::size_t>(got));
    if (text.size() > kMaxTextBytes) {
      return Error{Errc::limit_exceeded, fmt::format("{}: it is longer than 1 MiB", tried)};
    }
  }
}

Result<Bundle> read_bundle(const std::string& path) {
  const std::string text = DSSM_TRY(read_text(path));
  return DSSM_TRY(parse_bundle_untrusted(text), fmt::format("read '{}'", path));
}

Result<Bundle> read_bundle_if_there(const std::string& path) {
  Result<Bundle> bundle = read_bundle(path);
  if (!bundle && bundle.error().code == Errc::not_found) return Bundle{};
  return bundle;
}

Result<Key> read_key(const std::string& path) {
  const std::string text = DSSM_TRY(read_text(path));
  return DSSM_TRY(parse_key(text), fmt::format("read '{}'", path));
}

Result<void> replace_file(const std::string& path, std::string_view text, mode_t mode) {
  struct stat there {};
  if (!::lstat(path.c_str(), &there) && !S_ISREG(there.st_mode)) {
    return Error{
        Errc::conflict,
        fmt::format("write '{}': it is not a file; remove it, or choose another name", path)};
  }
  const TemporaryFile file = DSSM_TRY(TemporaryFile::create(path, text));
  if (::fchmod(file.fd(), mode) || ::fsync(file.fd()) ||
      ::rename(file.path().c_str(), path.c_str())) {
    return file_error(file.tried());
  }
  return sync_folder(folder_of(path));
}

Result<bool> create_key_file(const std::string& path, const Key& key) {
  const TemporaryFile file = DSSM_TRY(TemporaryFile::create(path, pem_of(key)));
  DSSM_TRY(give_to_daemon(file));
  // Unlike rename(), link() replaces nothing: neither a key that another process has just made.
  if (::link(file.path().c_str(), path.c_str())) {
    if (errno == EEXIST) return false;
    return file_error(file.tried());
  }
  DSSM_TRY(sync_folder(folder_of(path)));
  return true;
}

Result<void> create_folder(const std::string& path) {
  std::error_code error;
  std::filesystem::create_directories(path, error);
  if (error) return file_error(fmt::format("create the folder '{}'", path), error.value());
  return {};
}

Result<UniqueFd> lock_folder(const std::string& path) {
  const std::string tried = fmt::format("open the folder '{}'", path);
  UniqueFd folder(::open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!folder) return file_error(tried);
  while (::flock(folder.get(), LOCK_EX)) {
    if (errno != EINTR) return file_error(tried);
  }
  return folder;
}

Result<void> store_issued(const std::string& ca, const Issued& issued, std::time_t now) {
  std::tm utc{};
  ::gmtime_r(&now, &utc);
  std::array<char, 32> time{};
  std::strftime(time.data(), time.size(), "%Y-%m-%d %H:%M:%S UTC", &utc);
  const std::string path =
      path_in(path_in(ca, kIssued), fmt::format("{}.pem", serial_of(issued.certificate)));
  // PEM allows a text before the block. The certificate itself has no time of issue.
  return replace_file(
      path,
      fmt::format("{}{}, {}, for {}\n{}", kIssuedLine, issued.place, time.data(),
                  identity_of(issued.certificate).str(), pem_of(issued.certificate)),
      0644);
}

Result<std::vector<Issued>> read_issued(const std::string& ca) {
  const std::string folder = path_in(ca, kIssued);
  std::vector<Issued> all;
  std::error_code error;
  std::filesystem::directory_iterator at(folder, error), end;
  for (; !error && at != end; at.increment(error)) {
    const std::string path = at->path().string();
    // Others are temporary files that a crash left.
    if (!path.ends_with(".pem")) continue;
    const std::string text = DSSM_TRY(read_text(path));
    const Bundle bundle = DSSM_TRY(parse_bundle_untrusted(text), fmt::format("read '{}'", path));
    if (bundle.certificates.empty()) continue;
    Issued issued{path, 0, bundle.certificates.front()};
    if (text.starts_with(kIssuedLine)) {
      std::from_chars(text.data() + kIssuedLine.size(), text.data() + text.size(), issued.place);
    }
    all.push_back(std::move(issued));
  }
  if (error) return file_error(fmt::format("read the folder '{}'", folder), error.value());
  std::sort(all.begin(), all.end(), [](const Issued& a, const Issued& b) {
    return std::tie(a.place, a.path) < std::tie(b.place, b.path);
  });
  return all;
}

bool is_serial(const Certificate& certificate, std::string_view text) {
  std::string digits;
  for (const char c : text) {
    if (c != ':') digits += c >= 'A' && c <= 'F' ? static_cast<char>(c - 'A' + 'a') : c;
  }
  return digits == serial_of(certificate);
}

}  // namespace dssm::ctl::pki
