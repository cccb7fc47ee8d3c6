// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/process.hpp"

#include <fcntl.h>
#include <google/protobuf/stubs/logging.h>
#include <malloc.h>
#include <sys/file.h>
#include <sys/resource.h>
#include <sys/stat.h>

#include <cerrno>

namespace dssm::daemon {

void raise_descriptor_limit() noexcept {
  rlimit limit{};
  if (::getrlimit(RLIMIT_NOFILE, &limit)) return;
  limit.rlim_cur = limit.rlim_max;
  ::setrlimit(RLIMIT_NOFILE, &limit);  // without it dssmd works, with fewer streams
}

void ignore_broken_pipes() noexcept { ::signal(SIGPIPE, SIG_IGN); }

void silence_protobuf() noexcept { google::protobuf::SetLogHandler(nullptr); }

// Pieces up to 4 MiB, which samples that wait for a slow network need often, are kept: page faults
// cost as much as copying.
void return_large_memory() noexcept {
  ::mallopt(M_MMAP_THRESHOLD, 4 << 20);  // NOLINT(concurrency-mt-unsafe): no other thread yet
  ::mallopt(M_TRIM_THRESHOLD, 8 << 20);  // NOLINT(concurrency-mt-unsafe): as above
}

BlockedSignals::BlockedSignals() noexcept {
  sigset_t requests;
  ::sigemptyset(&requests);
  for (const int number : {SIGINT, SIGTERM, SIGHUP}) ::sigaddset(&requests, number);
  ::pthread_sigmask(SIG_BLOCK, &requests, &before_);
}

void BlockedSignals::deliver() noexcept { ::pthread_sigmask(SIG_SETMASK, &before_, nullptr); }

// --- the runtime folder

Result<RuntimeDir> RuntimeDir::open(const std::string& path) {
  const std::string what = "use the runtime folder '" + path + "'";
  if (::mkdir(path.c_str(), 0755) == 0) {
    // The umask may have taken more than others' write permission.
    if (::chmod(path.c_str(), 0755)) return os_error(what);
  } else if (errno != EEXIST) {
    Error error = os_error(what + ": create it");
    error.message += "; create it first or choose another one with --runtime-dir";
    return error;
  }
  UniqueFd lock(::open(path.c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC));
  if (!lock) {
    Error error = os_error(what);
    error.message += "; choose another one with --runtime-dir";
    return error;
  }
  if (::flock(lock.get(), LOCK_EX | LOCK_NB)) {
    if (errno != EWOULDBLOCK) return os_error(what + ": lock it");
    return Error{Errc::conflict, what +
                                     ": another dssmd is running there already; stop it, or choose "
                                     "another folder with --runtime-dir"};
  }
  return RuntimeDir(path, std::move(lock));
}

}  // namespace dssm::daemon
