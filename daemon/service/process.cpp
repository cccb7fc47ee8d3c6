// SPDX-License-Identifier: Apache-2.0
#include "daemon/service/process.hpp"

#include <google/protobuf/stubs/logging.h>
#include <signal.h>
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

}  // namespace dssm::daemon
