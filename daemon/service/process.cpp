// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/process.hpp"

#include <google/protobuf/stubs/logging.h>
#include <malloc.h>
#include <sys/resource.h>

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

}  // namespace dssm::daemon
