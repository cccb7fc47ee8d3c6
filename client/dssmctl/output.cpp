// SPDX-License-Identifier: Apache-2.0
#include "client/dssmctl/output.hpp"

#include <fmt/format.h>
#include <poll.h>
#include <signal.h>
#include <unistd.h>

#include <algorithm>
#include <atomic>
#include <cerrno>
#include <cstdlib>
#include <thread>

namespace dssm::ctl {
namespace {

std::atomic<bool> stop_mark{false};
static_assert(std::atomic<bool>::is_always_lock_free);  // or a handler may not touch it

void on_signal(int) { stop_mark.store(true, std::memory_order_relaxed); }

}  // namespace

void catch_stop_signals() {
  struct sigaction action {};
  action.sa_handler = on_signal;  // without SA_RESTART: waits end
  ::sigaction(SIGINT, &action, nullptr);
  ::sigaction(SIGTERM, &action, nullptr);
}

bool stop_requested() { return stop_mark.load(std::memory_order_relaxed); }

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

bool Output::must_stop() {
  pollfd state{fd_, 0, 0};
  if (::poll(&state, 1, 0) > 0 && (state.revents & POLLERR)) stopped_ = true;
  return stopped_ || stop_requested();
}

bool Output::sleep_until(MonoTime due) {
  while (!must_stop()) {
    const Duration rest = due - MonoClock::now();
    if (rest <= Duration::zero()) return true;
    std::this_thread::sleep_for(std::min(rest, kStopCheckPeriod));
  }
  return false;
}

std::string Output::bold(std::string_view text) const {
  return colour_ ? fmt::format("\x1b[1m{}\x1b[0m", text) : std::string(text);
}

void print_error(std::string_view text) {
  Output err(STDERR_FILENO);
  err.add(text);
  err.flush();
}

void Table::print(Output& out) const {
  std::vector<std::size_t> widths;
  for (std::size_t i = 0; i < columns_.size(); ++i) {
    std::size_t width = columns_[i].title.size();
    for (const auto& row : rows_) width = std::max(width, row[i].size());
    widths.push_back(width);
  }
  std::string line;
  const auto add_cell = [&](std::size_t i, const std::string& cell) {
    const std::size_t blanks = widths[i] - cell.size();
    if (i > 0) line += "  ";
    if (columns_[i].align == Align::right) line.append(blanks, ' ');
    line += cell;
    if (columns_[i].align == Align::left) line.append(blanks, ' ');
  };
  const auto end_line = [&] { line.erase(line.find_last_not_of(' ') + 1); };

  for (std::size_t i = 0; i < columns_.size(); ++i) add_cell(i, columns_[i].title);
  end_line();
  out.add(out.bold(line));
  out.add("\n");
  for (const auto& row : rows_) {
    line.clear();
    for (std::size_t i = 0; i < columns_.size(); ++i) add_cell(i, row[i]);
    end_line();
    out.add(line);
    out.add("\n");
  }
}

}  // namespace dssm::ctl
