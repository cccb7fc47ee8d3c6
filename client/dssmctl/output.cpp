// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/output.hpp"

#include <poll.h>
#include <unistd.h>

#include <cerrno>
#include <cstdlib>

namespace dssm::ctl {

Output::Output(int fd) : fd_(fd), terminal_(::isatty(fd) == 1) {
  // https://no-color.org: set and not empty
  const char* no_color = std::getenv("NO_COLOR");  // NOLINT(concurrency-mt-unsafe): one thread
  colour_ = terminal_ && (!no_color || !*no_color);
}

bool Output::flush() {
  std::string_view rest = pending_;
  while (!stopped_ && !rest.empty()) {
    const ssize_t written = ::write(fd_, rest.data(), rest.size());
    if (written >= 0) {
      rest.remove_prefix(static_cast<std::size_t>(written));
    } else if (errno == EAGAIN) {  // another program made our terminal or pipe non-blocking
      pollfd wanted{fd_, POLLOUT, 0};
      ::poll(&wanted, 1, -1);
    } else if (errno != EINTR) {
      if (errno != EPIPE) result_ = os_error("write to standard output");
      stopped_ = true;
    }
  }
  pending_.clear();
  return !stopped_;
}

bool Output::reader_ended() {
  pollfd state{fd_, 0, 0};
  if (::poll(&state, 1, 0) > 0 && (state.revents & POLLERR)) stopped_ = true;
  return stopped_;
}

std::string Output::bold(std::string_view text) const {
  return colour_ ? "\x1b[1m" + std::string(text) + "\x1b[0m" : std::string(text);
}

void print_error(std::string_view text) {
  Output err(STDERR_FILENO);
  err.add(text);
  err.flush();
}

}  // namespace dssm::ctl
